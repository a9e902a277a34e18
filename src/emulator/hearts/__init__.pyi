from .heart import mesh_wall
from .sheet import mesh_sheet, regions_within
from .surfaces import Surface, read_surface

__all__ = [
    "Surface",
    "mesh_sheet",
    "mesh_wall",
    "read_surface",
    "regions_within",
]
