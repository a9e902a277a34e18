"""Specimens: mechanical tests and tubes in homogeneous states, and the piece between its grips.

A room: the core reaches it by the registries of forward maps and observations, and by scene files.

What it exports is listed in ``__init__.pyi`` and imported when first used.
"""

import lazy_loader

from emulator.specimens.states import states as states  # the function, not its module

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
