"""A room: hearts and sheets from surfaces and outlines, meshed by Gmsh.

:mod:`.surfaces` reads and cuts closed and open surfaces, :mod:`.remeshing` makes their triangles
even, :mod:`.wall` fills what is between surfaces and measures it. :mod:`.two_surfaces` makes a left
ventricle, :mod:`.heart` both ventricles, :mod:`.left_wall` the left one's part of both, and
:mod:`.sheet` a body from outlines in a plane.
"""
