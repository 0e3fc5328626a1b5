"""Pictures of a scene, and cameras to take them from."""
