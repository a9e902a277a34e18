"""A room: hearts and sheets from surfaces and outlines, meshed by Gmsh.

:mod:`.surfaces` reads and cuts closed and open surfaces, :mod:`.remeshing` makes their triangles
even, :mod:`.wall` fills what is between surfaces and measures it. :mod:`.two_surfaces` makes a left
ventricle, :mod:`.heart` both ventricles, :mod:`.left_wall` the left one's part of both, and
:mod:`.sheet` a body from outlines in a plane.

What it exports is listed in ``__init__.pyi`` and imported when first used.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
