"""Gaussians to pixels and back: the rasterizer, its gradients and its transpose."""
