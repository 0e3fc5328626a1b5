"""Sources of 2D semantics, one file each; `base` holds what they have in common."""
