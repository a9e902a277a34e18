from . import generators as generators
from .discretisation import quadrature_points
from .facets import Cavity, enclosed_volume
from .fibres import wall_depth
from .io import Body
from .mesh import boundary_facets, signed_volumes
from .random_field import matern_modes
from .refinement import to_quadratic
from .side_by_side import Bodies

__all__ = [
    "Bodies",
    "Body",
    "Cavity",
    "boundary_facets",
    "enclosed_volume",
    "matern_modes",
    "quadrature_points",
    "signed_volumes",
    "to_quadratic",
    "wall_depth",
]
