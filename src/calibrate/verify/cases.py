"""The cases of ``calibrate verify`` by name; each returns rows of the table."""

from __future__ import annotations

from collections.abc import Callable

from calibrate.verify.consistency import (
    verify_barriers,
    verify_derivatives,
    verify_invariance,
    verify_patch,
)
from calibrate.verify.cook import verify_cook
from calibrate.verify.homogeneous import verify_homogeneous
from calibrate.verify.land import verify_beam, verify_ventricle
from calibrate.verify.row import Row
from calibrate.verify.sphere import verify_sphere

CASES: dict[str, Callable[[], list[Row]]] = {
    "patch": verify_patch,
    "invariance": verify_invariance,
    "derivatives": verify_derivatives,
    "barriers": verify_barriers,
    "homogeneous": verify_homogeneous,
    "sphere": verify_sphere,
    "cook": verify_cook,
    "land_beam": verify_beam,
    "land_ventricle": verify_ventricle,
}
