"""Meshes, and their geometry without a material: sets, facets, volumes, fibres, bodies.

What it exports is listed in ``__init__.pyi`` and imported when first used.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
