"""Hallucinators: whatever paints a goal into images, and how it is trained and judged."""
