"""The only place where torch meets warp: rasterization and lifting on tensors, and their float64 oracle."""
