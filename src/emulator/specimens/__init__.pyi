from .gripped import GrippedSpecimen, learn_grips
from .grips import Grips, GripStresses
from .specimen import Specimen
from .states import states
from .tube import Tube

__all__ = [
    "GripStresses",
    "GrippedSpecimen",
    "Grips",
    "Specimen",
    "Tube",
    "learn_grips",
    "states",
]
