"""Mobile robots."""
