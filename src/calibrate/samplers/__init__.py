"""Samplers, one a file."""

from calibrate.samplers.nuts import NUTSOptions, nuts

SAMPLERS = ("nuts",)

__all__ = ["SAMPLERS", "NUTSOptions", "nuts"]
