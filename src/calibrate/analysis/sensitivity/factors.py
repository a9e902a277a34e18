"""What is varied: independent parameters, each a point of the unit interval."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist

from calibrate.priors import Prior, bisect, bounds, dependence_of
from emulator.core.errors import InputError

_EDGE = 1e-9  # of the unit interval; beyond, a distribution without ends has infinite quantiles


@dataclass(frozen=True, eq=False)
class Factors:
    """Parameters by name, varied together where they form a group.

    names : of the parameters, (p,). groups : names of a group's parameters, by the group's name;
    a parameter of no group is one of its own.

    Raises
    ------
    InputError
        A group that names another's parameter, or an unknown one.
    """

    names: tuple[str, ...]
    groups: Mapping[str, Sequence[str]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        grouped = [name for group in self.groups.values() for name in group]
        for name in grouped:
            if name not in self.names:
                raise InputError(
                    f"group of parameters: '{name}' is none of {', '.join(self.names)}"
                )
            if grouped.count(name) > 1:
                raise InputError(f"group of parameters: '{name}' is in two groups")
        for group in self.groups:
            if group in self.names:
                raise InputError(f"group of parameters: '{group}' is a parameter's name")

    @cached_property
    def group_of(self) -> tuple[str, ...]:
        """The group each parameter is in, (p,); its own name where it is in none."""
        of = {name: group for group, members in self.groups.items() for name in members}
        return tuple(of.get(name, name) for name in self.names)

    @property
    def labels(self) -> tuple[str, ...]:
        """What is varied independently: groups, in the order of their first parameters."""
        return tuple(dict.fromkeys(self.group_of))

    @property
    def problem(self) -> dict[str, Any]:
        """SALib's description of the unit cube."""
        told: dict[str, Any] = {
            "num_vars": len(self.names),
            "names": list(self.names),
            "bounds": [[0.0, 1.0]] * len(self.names),
        }
        return told | {"groups": list(self.group_of)} if self.groups else told


def quantiles(prior: Prior, names: Sequence[str], points: jax.Array) -> jax.Array:
    """Theta (..., p) whose cumulative probabilities are ``points`` (..., p)."""
    inside = jnp.clip(points, _EDGE, 1.0 - _EDGE)
    columns = [_quantile(prior[name], inside[..., k]) for k, name in enumerate(names)]
    return jnp.stack(columns, axis=-1)


def densities(prior: Prior, names: Sequence[str], theta: jax.Array) -> jax.Array:
    """Density (..., p) of each parameter at ``theta`` (..., p): dx/dtheta of its point x."""
    columns = [jnp.exp(prior[name].log_prob(theta[..., k])) for k, name in enumerate(names)]
    return jnp.stack(columns, axis=-1)


def check_independent(prior: Prior) -> None:
    """Refuse a prior whose parameters depend on each other: its variance has no shares."""
    dependence = dependence_of(prior)
    if dependence is not None and np.any(dependence.correlation != np.eye(len(dependence.names))):
        raise InputError(
            f"sensitivity: the prior correlates {', '.join(dependence.names)}; shares of the "
            "variance are defined for independent parameters, e.g. --prior box"
        )


def _quantile(distribution: dist.Distribution, points: jax.Array) -> jax.Array:
    try:
        return distribution.icdf(points)
    except NotImplementedError:
        low, high = bounds(distribution)
        if not np.isfinite([low, high]).all():
            raise InputError(
                f"prior {type(distribution).__name__} has neither quantiles nor finite ends"
            ) from None
        return bisect(distribution.cdf, points, low, high)
