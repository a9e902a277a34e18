"""Mesh generators of the built-in scenes' bodies."""
