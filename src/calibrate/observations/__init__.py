"""Observation operators: what of a displacement field was measured, one kind a file.

Each stands for one measurement; :class:`Observations` holds those made at once, by name. The kinds
are listed in :data:`OBSERVATIONS`.
"""

from calibrate.observations.klotz import Klotz, KlotzVolume
from calibrate.observations.landmarks import Landmarks, landmarks, spread_landmarks
from calibrate.observations.length import Length, length_between
from calibrate.observations.nodes import NodalDisplacements, nodal_displacements, spread_nodes
from calibrate.observations.parameter import MeasuredParameter
from calibrate.observations.points import DISPLACEMENT
from calibrate.observations.protocol import Field, Kind, Labels, Observation
from calibrate.observations.reaction import Reaction
from calibrate.observations.registry import (
    OBSERVATIONS,
    observation_from_json,
    observations_from_json,
    parse_observation,
)
from calibrate.observations.rigid_markers import RigidMarkers, rigid_markers
from calibrate.observations.scalar import Scalar
from calibrate.observations.segment_strain import SegmentStrain, segment_strains
from calibrate.observations.several import Observations, observations
from calibrate.observations.strain import Strain, strains
from calibrate.observations.surface import (
    SurfacePoints,
    spread_on_surface,
    surface_distances,
    surface_points,
)
from calibrate.observations.volume import CavityVolume

__all__ = [
    "DISPLACEMENT",
    "OBSERVATIONS",
    "CavityVolume",
    "Field",
    "Kind",
    "Klotz",
    "KlotzVolume",
    "Labels",
    "Landmarks",
    "Length",
    "MeasuredParameter",
    "NodalDisplacements",
    "Observation",
    "Observations",
    "Reaction",
    "RigidMarkers",
    "Scalar",
    "SegmentStrain",
    "Strain",
    "SurfacePoints",
    "landmarks",
    "length_between",
    "nodal_displacements",
    "observation_from_json",
    "observations",
    "observations_from_json",
    "parse_observation",
    "rigid_markers",
    "segment_strains",
    "spread_landmarks",
    "spread_nodes",
    "spread_on_surface",
    "strains",
    "surface_distances",
    "surface_points",
]
