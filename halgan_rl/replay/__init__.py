"""A replay storage that keeps each frame once."""
