"""Observation operators: what of a displacement field was measured, one kind a file.

Each stands for one measurement; :class:`Observations` holds those made at once, by name. The kinds
are listed in :data:`OBSERVATIONS`.
"""

from calibrate.measurements.klotz import Klotz, KlotzVolume
from calibrate.measurements.landmarks import Landmarks, landmarks, spread_landmarks
from calibrate.measurements.length import Length, length_between
from calibrate.measurements.nodes import NodalDisplacements, nodal_displacements, spread_nodes
from calibrate.measurements.parameter import MeasuredParameter
from calibrate.measurements.points import DISPLACEMENT
from calibrate.measurements.protocol import Field, Kind, Labels, Observation
from calibrate.measurements.reaction import Reaction
from calibrate.measurements.registry import (
    OBSERVATIONS,
    observation_from_json,
    observations_from_json,
    parse_observation,
)
from calibrate.measurements.rigid_markers import RigidMarkers, rigid_markers
from calibrate.measurements.scalar import Scalar
from calibrate.measurements.segment_strain import SegmentStrain, segment_strains
from calibrate.measurements.several import Observations, observations
from calibrate.measurements.strain import Strain, strains
from calibrate.measurements.surface import (
    SurfacePoints,
    spread_on_surface,
    surface_distances,
    surface_points,
)
from calibrate.measurements.volume import CavityVolume

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
