"""The only place where torch meets Warp: kernels as functions on tensors."""
