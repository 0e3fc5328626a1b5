"""File formats: scenes (PLY), cameras (transforms.json, COLMAP), semantics."""
