"""How far a prediction is from the truth, and whether to trust it."""
