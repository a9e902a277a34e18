"""Verification of the mechanics: tables of measured value, reference, tolerance and source."""

from collections.abc import Callable

from emulator.verify.benchmark import Benchmark
from emulator.verify.consistency import (
    verify_barriers,
    verify_derivatives,
    verify_invariance,
    verify_patch,
)
from emulator.verify.homogeneous import verify_homogeneous
from emulator.verify.incompressible import verify_cook, verify_sphere
from emulator.verify.land import verify_beam, verify_contraction, verify_ventricle
from emulator.verify.released import verify_published

__all__ = ["CASES", "Benchmark", "verify_published"]

CASES: dict[str, Callable[[], list[Benchmark]]] = {
    "patch": verify_patch,
    "invariance": verify_invariance,
    "derivatives": verify_derivatives,
    "barriers": verify_barriers,
    "homogeneous": verify_homogeneous,
    "sphere": verify_sphere,
    "cook": verify_cook,
    "land_beam": verify_beam,
    "land_ventricle": verify_ventricle,
    "land_contraction": verify_contraction,
}
"""The cases of ``calibrate verify`` by name; each returns rows of the table."""
