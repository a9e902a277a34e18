from .heart import mesh_heart
from .sheet import mesh_sheet, regions_within
from .surfaces import Surface, read_surface
from .two_surfaces import mesh_wall

__all__ = [
    "Surface",
    "mesh_heart",
    "mesh_sheet",
    "mesh_wall",
    "read_surface",
    "regions_within",
]
