"""Other ways to features of Gaussians, from the same scene, views and 2D maps as `lift`."""
