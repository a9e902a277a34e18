"""Verification of the mechanics: tables of measured value, reference, tolerance and source."""

from calibrate.verify.cases import CASES
from calibrate.verify.released import verify_published
from calibrate.verify.row import Row

__all__ = ["CASES", "Row", "verify_published"]
