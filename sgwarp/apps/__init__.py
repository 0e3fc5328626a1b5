"""Applications of lifted scenes: instances and parts, editing, tracking through time."""
