"""Observations: what of a displacement field was measured, files of its data, and their units.

A kind of observation is a subclass of :class:`Observation`; the kinds are listed in
:data:`OBSERVATIONS`. :class:`Observations` holds several of one body by name.
"""

from calibrate.measurements.collection import (
    Observations,
    leave_out_missing,
    missing_values,
    observations,
)
from calibrate.measurements.displacements import (
    Landmarks,
    landmarks,
    length_between,
    nodal_displacements,
    spread_landmarks,
    spread_nodes,
)
from calibrate.measurements.klotz import Klotz, KlotzVolume
from calibrate.measurements.observation import Observation, Scalar
from calibrate.measurements.parameter import MeasuredParameter
from calibrate.measurements.points import DISPLACEMENT, DisplacementPoints, PointObservation
from calibrate.measurements.reaction import Reaction
from calibrate.measurements.registry import (
    OBSERVATIONS,
    observation_from_json,
    observations_from_json,
    parse_observation,
)
from calibrate.measurements.strain import segment_strains, strains
from calibrate.measurements.surface import (
    rigid_markers,
    spread_on_surface,
    surface_distances,
    surface_points,
)
from calibrate.measurements.volume import CavityVolume

__all__ = [
    "DISPLACEMENT",
    "OBSERVATIONS",
    "CavityVolume",
    "DisplacementPoints",
    "Klotz",
    "KlotzVolume",
    "Landmarks",
    "MeasuredParameter",
    "Observation",
    "Observations",
    "PointObservation",
    "Reaction",
    "Scalar",
    "landmarks",
    "leave_out_missing",
    "length_between",
    "missing_values",
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
