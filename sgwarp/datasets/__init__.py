"""Sources of scenes and labels."""
