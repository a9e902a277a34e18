"""Errors of predictions: against references, estimated without one, and warnings."""
