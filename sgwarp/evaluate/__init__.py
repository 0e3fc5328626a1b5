"""Figures of merit: segmentation from one confusion matrix, localisation from hits."""
