"""A room: points over frames, and surfaces of an image, as data."""

from calibrate.measurements.frames import along_normals, frame_data, spread_evenly
from calibrate.measurements.full_field import (
    FullField,
    field_data,
    read_amounts,
    read_curve,
    read_full_field,
    spread_points,
)

__all__ = [
    "FullField",
    "along_normals",
    "field_data",
    "frame_data",
    "read_amounts",
    "read_curve",
    "read_full_field",
    "spread_evenly",
    "spread_points",
]
