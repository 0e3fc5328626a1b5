"""Instances and parts: masks that agree in nothing but the Gaussians they show, joined into objects."""
