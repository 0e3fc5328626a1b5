"""Measured on data with ground truth."""
