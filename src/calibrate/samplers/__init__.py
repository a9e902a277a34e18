"""Samplers, one a file."""

from calibrate.samplers.nuts import NUTSOptions, nuts

__all__ = ["NUTSOptions", "nuts"]
