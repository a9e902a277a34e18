"""A room: hearts, organs and sheets from surfaces, label images and outlines, meshed by Gmsh.

:mod:`.surfaces` reads and cuts closed and open surfaces, :mod:`.remeshing` makes their triangles
even. :mod:`.heart` makes the walls of a left ventricle or of both, from :mod:`.joints` between
surfaces, :mod:`.wall`, which fills and measures what is between them, and :mod:`.checks`.
:mod:`.left_wall` cuts the left ventricle's part from both, :mod:`.solid` fills one
closed surface, and :mod:`.sheet` makes a body from outlines in a plane. :mod:`.images` reads the
labels of a segmentation, and :mod:`.segmentation` makes surfaces of them.

``__init__.pyi`` lists its exports, which are imported when first used.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
