"""Parameters of a scene: what may vary, between which bounds, on which scale."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import jax
import jax.numpy as jnp

from emulator.errors import InputError


@dataclass(frozen=True)
class Parameter:
    """One entry of theta.

    Parameters
    ----------
    name : as the law or the load calls it.
    unit : for people, e.g. ``kPa``; empty when dimensionless.
    low, high : range the scene is meant for.
    scale : ``log`` when equal ratios matter equally, else ``uniform``.
    """

    name: str
    unit: str
    low: float
    high: float
    scale: Literal["log", "uniform"] = "uniform"

    def __post_init__(self) -> None:
        if not -math.inf < self.low < self.high < math.inf:
            raise InputError(
                f"parameter '{self.name}': range [{self.low}, {self.high}] is empty or not finite"
            )
        if self.scale not in ("log", "uniform"):
            raise InputError(f"parameter '{self.name}': scale '{self.scale}'; use log or uniform")
        if self.scale == "log" and self.low <= 0.0:
            raise InputError(f"parameter '{self.name}': a log scale needs a lower bound above 0")

    def to_unit(self, value: jax.Array) -> jax.Array:
        """Position of ``value`` in the range, 0 at ``low`` and 1 at ``high``, on the scale."""
        if self.scale == "log":
            return jnp.log(value / self.low) / jnp.log(self.high / self.low)
        return (value - self.low) / (self.high - self.low)

    def from_unit(self, position: jax.Array) -> jax.Array:
        """Inverse of :meth:`to_unit`."""
        if self.scale == "log":
            return self.low * (self.high / self.low) ** position
        return self.low + (self.high - self.low) * position


def unit_sensitivities(
    parameters: Sequence[Parameter], theta: jax.Array, du_dtheta: jax.Array
) -> jax.Array:
    r"""Sensitivities in the unit box, from those in the parameters' own units.

    .. math:: \partial u / \partial x_k
        = (\partial u / \partial \theta_k)\, \mathrm{d}\theta_k / \mathrm{d}x_k

    Parameters
    ----------
    theta : (c, p). du_dtheta : (c, p, n, 3) mm a unit of each parameter.

    Returns
    -------
    (c, p, n, 3) mm.
    """
    rates = [
        jax.vmap(jax.grad(parameter.from_unit))(parameter.to_unit(theta[:, k]))
        for k, parameter in enumerate(parameters)
    ]
    return du_dtheta * jnp.stack(rates, axis=1)[:, :, None, None]
