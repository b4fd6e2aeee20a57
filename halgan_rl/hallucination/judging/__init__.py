"""How far hallucinations are from the truth."""
