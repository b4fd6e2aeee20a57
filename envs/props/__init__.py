"""Things in a room."""
