"""The mesh of a built-in scene: its sizes, or the defaults of the order of its elements."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from emulator.core.errors import InputError


def resolved(sizes: Mapping[int, Mapping[str, Any]], order: int, **chosen: Any) -> dict[str, Any]:
    """Return sizes by name, and ``order``, with defaults in place of None.

    Quadratic elements, the default, are accurate with fewer nodes (``studies/elements``); published
    models have linear ones.

    Parameters
    ----------
    sizes : default sizes by the order of the elements, 1 and 2.
    order : order of the elements.
    chosen : the sizes by name, None for the default.
    """
    if order not in sizes:
        raise InputError(f"order {order} of the elements; expected 1 (linear) or 2 (quadratic)")
    defaults = sizes[order]
    return {
        **{name: defaults[name] if value is None else value for name, value in chosen.items()},
        "order": order,
    }
