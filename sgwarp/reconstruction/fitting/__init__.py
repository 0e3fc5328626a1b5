"""Fitting Gaussians to photographs: starting points, model, loss, density control, checkpoints, report."""
