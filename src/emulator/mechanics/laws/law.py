"""What a hyperelastic law is to the rest of the project: a name, its parameters, one energy."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import jax


@dataclass(frozen=True)
class Law:
    """A hyperelastic law; stress and tangent follow by differentiation.

    Parameters
    ----------
    name : key in the registry.
    parameters : names, in the order ``energy`` takes them.
    energy : ``energy(strain, *parameters) -> W``, the strain energy density (kPa) of one point.
    fibres : whether the energy asks for ``strain.fibre``.
    """

    name: str
    parameters: tuple[str, ...]
    energy: Callable[..., jax.Array]
    fibres: bool = False
