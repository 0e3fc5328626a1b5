"""Files as bytes: bounded reading, atomic writing, images. Nothing here knows a scene type."""
