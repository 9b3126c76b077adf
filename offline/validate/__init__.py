"""The reduced against the full model on loads it has not seen."""
