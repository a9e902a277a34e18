"""Verification of the mechanics: tables of measured value, reference, tolerance and source."""

from emulator.verify.benchmark import Benchmark
from emulator.verify.cases import CASES
from emulator.verify.released import verify_published

__all__ = ["CASES", "Benchmark", "verify_published"]
