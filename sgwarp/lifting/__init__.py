"""2D semantics into the Gaussians, without training (paper, Sec. III-B)."""
