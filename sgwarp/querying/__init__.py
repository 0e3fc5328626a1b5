"""Text queries: scores, segmentation, localization, ensembles (paper, Sec. III-D)."""
