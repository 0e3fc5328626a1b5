"""What can be done with a scene that has semantics."""
