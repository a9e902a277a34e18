"""Newton's method with adaptive load steps: an iteration as a pure function of its state."""

from .iteration import Newton

__all__ = ["Newton"]
