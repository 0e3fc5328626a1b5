"""Sparse voxels and convolutions on them."""
