"""Neighbours: other finite element programs, and the forms in which they take a law and a body."""
