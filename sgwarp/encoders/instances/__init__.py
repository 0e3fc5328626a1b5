"""Instance-level encoders: boxes or masks with labels."""
