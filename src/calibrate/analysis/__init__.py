"""Analyses of a model or posterior: the information in data, the sensitivity of predictions."""
