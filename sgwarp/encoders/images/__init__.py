"""Image-level encoders: one vector for a whole image or crop."""
