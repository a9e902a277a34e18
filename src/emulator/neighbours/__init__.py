"""Neighbours: decks of other finite element programs, and laws and bodies in their forms."""
