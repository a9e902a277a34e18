"""Loads by kind; ``LOADS`` is their registry.

A new kind is a frozen dataclass derived from :class:`Load` in a file of its own, named here.
"""

from emulator.scenes.loads.active_tension import ActiveTension
from emulator.scenes.loads.force import Force
from emulator.scenes.loads.gravity import Gravity, GravityVector
from emulator.scenes.loads.pressure import (
    KPA_PER_MMHG,
    CavityPressure,
    DeadPressure,
    FollowerPressure,
    PublishedPressure,
    SurfacePressure,
    ValvePressure,
)
from emulator.scenes.loads.prestress import Prestress
from emulator.scenes.loads.traction import Traction
from emulator.scenes.part import Load

LOADS: dict[str, type[Load]] = {
    load.kind: load
    for load in (
        Gravity,
        GravityVector,
        Traction,
        Force,
        CavityPressure,
        ValvePressure,
        FollowerPressure,
        DeadPressure,
        PublishedPressure,
        ActiveTension,
        Prestress,
    )
}

__all__ = [
    "KPA_PER_MMHG",
    "LOADS",
    "ActiveTension",
    "CavityPressure",
    "DeadPressure",
    "FollowerPressure",
    "Force",
    "Gravity",
    "GravityVector",
    "Load",
    "Prestress",
    "PublishedPressure",
    "SurfacePressure",
    "Traction",
    "ValvePressure",
]
