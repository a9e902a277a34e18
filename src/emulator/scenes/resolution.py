"""Sizes of a built-in scene's mesh: those asked for, or the defaults of the elements' order."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from emulator.core.errors import InputError


def resolved(sizes: Mapping[int, Mapping[str, Any]], order: int, **given: Any) -> dict[str, Any]:
    """``given`` sizes by name, and ``order``; one that is None is the default of that order.

    Quadratic elements, the default, are right to the tissue with fewer nodes
    (``studies/elements``); published models have linear ones.

    Parameters
    ----------
    sizes : defaults by order, 1 and 2.
    """
    if order not in sizes:
        raise InputError(f"order {order} of the elements; expected 1 (linear) or 2 (quadratic)")
    defaults = sizes[order]
    chosen = {name: defaults[name] if value is None else value for name, value in given.items()}
    return {**chosen, "order": order}
