r"""Parameters of a scene: names, units, bounds and scales.

Each theta has a position :math:`x \in [0, 1]^p` in the box,

.. math::
    x = \frac{\theta - \theta_\text{low}}{\theta_\text{high} - \theta_\text{low}}
    \quad\text{(uniform)}, \qquad
    x = \frac{\ln(\theta / \theta_\text{low})}{\ln(\theta_\text{high} / \theta_\text{low})}
    \quad\text{(log)}.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from functools import cached_property, partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.errors import InputError

_LARGEST_LOG_SD = 10.0  # a factor of 20 000 to each side
AT_LIMIT = 0.02  # share of a range within which its end is at a limit of nature
SHORT_OF = 0.999  # share of the way to such a limit that a range may go


@dataclass(frozen=True)
class LogNormal:
    """A prior of a parameter above zero.

    Parameters
    ----------
    median : its median, in the parameter's unit.
    log_sd : the sd of its logarithm, about its relative sd.
    source : where both are from, in words.
    """

    median: float
    log_sd: float
    source: str = field(default="", compare=False)

    def __post_init__(self) -> None:
        if not 0.0 < self.median < math.inf:
            raise InputError(f"median is {self.median:g}; it must be above 0 and finite")
        if not 0.0 < self.log_sd <= _LARGEST_LOG_SD:
            most = f"it must be above 0 and at most {_LARGEST_LOG_SD:g}"
            raise InputError(f"log_sd is {self.log_sd:g}; {most}")


@dataclass(frozen=True)
class Parameter:
    """One entry of theta.

    Parameters
    ----------
    name : the law's or the load's name for it.
    unit : as the law or the load expects it, e.g. ``kPa``; empty when dimensionless.
    low, high : its range.
    scale : ``log`` to sample equal ratios equally, else ``uniform``.
    prior : what is known of its value before any data; None where that is its range.
    """

    name: str
    unit: str
    low: float
    high: float
    scale: Literal["log", "uniform"] = "uniform"
    prior: LogNormal | None = None

    @classmethod
    def log_normal(
        cls, name: str, unit: str, prior: LogNormal, below: float = math.inf
    ) -> Parameter:
        """Return the parameter whose range is one sd of the prior's logarithm to each side.

        below : the limit below which its values stay by nature.
        """
        step = math.exp(prior.log_sd)
        most = prior.median + SHORT_OF * (below - prior.median)
        return cls(name, unit, prior.median / step, min(prior.median * step, most), "log", prior)

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
        """Return the position of ``value`` on the scale, 0 at ``low`` and 1 at ``high``."""
        if self.scale == "log":
            return jnp.log(value / self.low) / jnp.log(self.high / self.low)
        return (value - self.low) / (self.high - self.low)

    def from_unit(self, position: jax.Array) -> jax.Array:
        """Return the inverse of :meth:`to_unit`."""
        if self.scale == "log":
            return self.low * (self.high / self.low) ** position
        return self.low + (self.high - self.low) * position

    def rate(self, value: jax.Array) -> jax.Array:
        """Return the derivative of :meth:`from_unit` at the position of ``value``."""
        span = self.high - self.low
        return value * math.log(self.high / self.low) if self.scale == "log" else 0.0 * value + span

    def to_json(self) -> dict[str, Any]:
        """Return the arguments of the constructor but the prior as plain JSON."""
        return {name: value for name, value in asdict(self).items() if name != "prior"}


_SLACK = 1e-9  # round-off allowed, as a fraction of a range
_one_program = partial(jax.jit, static_argnums=0, inline=True)  # in place of one an operation


@dataclass(frozen=True)
class ParameterSpace:
    """The box that theta lies in, one side for each of the ``parameters`` in theta's order."""

    parameters: tuple[Parameter, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the entries of theta, in order."""
        return tuple(parameter.name for parameter in self.parameters)

    def __len__(self) -> int:
        return len(self.parameters)

    @cached_property
    def centre(self) -> jax.Array:
        """Theta in the middle of the box, on each parameter's scale, shape (p,)."""
        with jax.ensure_compile_time_eval():  # cached, so it must not be a tracer
            return self.from_unit(jnp.full(len(self.parameters), 0.5))

    @_one_program
    def to_unit(self, theta: jax.Array) -> jax.Array:
        """Return the position (..., p) of ``theta`` (..., p) in the box, 0 to 1 inside."""
        columns = [p.to_unit(theta[..., k]) for k, p in enumerate(self.parameters)]
        return jnp.stack(columns, axis=-1)

    @_one_program
    def from_unit(self, position: jax.Array) -> jax.Array:
        """Return the inverse of :meth:`to_unit`."""
        columns = [p.from_unit(position[..., k]) for k, p in enumerate(self.parameters)]
        return jnp.stack(columns, axis=-1)

    @_one_program
    def rates(self, theta: jax.Array) -> jax.Array:
        """Return the derivatives (..., p) of ``theta`` (..., p) in its position in the box."""
        columns = [p.rate(theta[..., k]) for k, p in enumerate(self.parameters)]
        return jnp.stack(columns, axis=-1)

    def contains(self, theta: jax.Array) -> jax.Array:
        """Return whether ``theta`` (..., p) lies in the box, (...) bool; NaN does not."""
        position = self.to_unit(theta)
        return jnp.all((position >= -_SLACK) & (position <= 1.0 + _SLACK), axis=-1)

    def theta(self, values: Mapping[str, float], owner: str) -> jax.Array:
        """Return theta (p,) from named values in the units of the parameters.

        Raises
        ------
        InputError
            An unknown, missing or out-of-range value; the message names ``owner``.
        """
        for name in values:
            if name not in self.names:
                raise InputError(
                    f"{owner} has no parameter '{name}'; it has {', '.join(self.names)}"
                )
        missing = [name for name in self.names if name not in values]
        if missing:
            raise InputError(f"{owner}: no value for parameter '{missing[0]}'")
        theta = jnp.array([float(values[name]) for name in self.names])
        self.check(theta, owner)
        return theta

    def check(self, theta: jax.Array, owner: str) -> None:
        """Raise :class:`InputError` unless every row of ``theta`` (..., p) is inside the box."""
        rows = np.atleast_2d(np.asarray(theta))
        if rows.shape[-1] != len(self.parameters):
            raise InputError(
                f"{owner}: theta has {rows.shape[-1]} values; "
                f"expected {len(self.parameters)}: {', '.join(self.names)}"
            )
        for k, parameter in enumerate(self.parameters):
            slack = _SLACK * (parameter.high - parameter.low)
            inside = (rows[:, k] >= parameter.low - slack) & (rows[:, k] <= parameter.high + slack)
            if not inside.all():
                value = rows[np.flatnonzero(~inside)[0], k]
                raise InputError(
                    f"parameter '{parameter.name}' is {value:g} {parameter.unit}; {owner} covers "
                    f"{parameter.low:g} to {parameter.high:g}"
                )
