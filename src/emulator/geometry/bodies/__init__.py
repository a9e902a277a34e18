"""Bodies that the scenes are made of."""
