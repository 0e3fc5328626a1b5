"""Pictures for people: color maps, overlays, legends."""
