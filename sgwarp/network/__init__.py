"""The 3D semantic network (paper, Sec. III-C)."""
