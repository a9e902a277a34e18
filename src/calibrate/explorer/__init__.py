"""A local page with a slider for every parameter: the body deforms live, by the cached emulator."""

from calibrate.explorer.server import Explorer, serve

__all__ = ["Explorer", "serve"]
