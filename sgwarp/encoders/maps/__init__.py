"""Feature maps and label images that other tools have written."""
