"""Training of what stages read as weights."""
