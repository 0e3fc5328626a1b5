"""Pixel-level encoders: one vector per pixel."""
