"""Which points of a mesh share a volume change."""

from __future__ import annotations

from typing import Literal

from emulator.core.errors import InputError

Dilatation = Literal["pointwise", "mean", "patch"]
"""None, those of an element, or those of a patch of linear ones."""


def check_dilatation(dilatation: str, order: int) -> None:
    """Refuse an unknown ``dilatation``, or one that elements of ``order`` do not have."""
    if dilatation not in ("pointwise", "mean", "patch"):
        raise InputError(
            f"dilatation '{dilatation}'; use pointwise or mean, or patch on linear tetrahedra"
        )
    if dilatation == "mean" and order == 1:
        raise InputError(
            "mean dilatation on linear tetrahedra changes nothing, they have one point each; make "
            "the mesh quadratic, or write dilatation 'patch'"
        )
    if dilatation == "patch" and order == 2:
        raise InputError(
            "patch dilatation is for linear tetrahedra; on quadratic ones write dilatation 'mean'"
        )
