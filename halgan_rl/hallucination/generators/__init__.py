"""Neural networks that paint goals."""
