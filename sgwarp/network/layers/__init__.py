"""Layers and networks on sparse voxels, with the conventions and parameter names of MinkowskiEngine."""
