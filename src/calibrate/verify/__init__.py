"""Verification: measured, reference, tolerance, source."""

from calibrate.verify.published import verify_published
from calibrate.verify.row import Row

__all__ = ["Row", "verify_published"]
