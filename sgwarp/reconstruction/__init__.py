"""Scenes from images: fitted by gradient descent or made from depth."""
