"""Mask generators, which cut an image into regions."""
