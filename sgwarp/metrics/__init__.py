"""Metrics: image quality, segmentation, localization."""
