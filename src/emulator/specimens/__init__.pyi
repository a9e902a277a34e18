from .gripped import GrippedSpecimen, learn_grips
from .grips import Grips, GripStresses
from .specimen import Specimen
from .states import AXES, States, states
from .tube import Tube

__all__ = [
    "AXES",
    "GripStresses",
    "GrippedSpecimen",
    "Grips",
    "Specimen",
    "States",
    "Tube",
    "learn_grips",
    "states",
]
