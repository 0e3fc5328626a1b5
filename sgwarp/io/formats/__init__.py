"""Scene formats besides PLY: SPZ, .splat, glTF, SOG. Every reader is NumPy and checks sizes before it allocates."""
