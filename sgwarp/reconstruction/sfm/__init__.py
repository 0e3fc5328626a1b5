"""Structure from motion through pycolmap: poses and points of photographs, and points of poses."""
