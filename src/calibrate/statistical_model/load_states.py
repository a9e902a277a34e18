r"""Load states: one body measured at several loads.

A pressure-volume curve is one body at several pressures. Its material is the same in every state,
its loads are not: parameters that the scene's loads take belong to a state, all others are shared.
With S states the model's unknowns determine S rows of theta,

.. math:: \theta_s = (m, \ell_s), \qquad s = 1, \dots, S,

with the material :math:`m` and the loads :math:`\ell_s`; each entry is either inferred or known.

Names say which state is meant (:mod:`calibrate.state_names`).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpyro.distributions as dist

from calibrate.priors import box_prior
from calibrate.state_names import in_state, split
from emulator.core.errors import InputError
from emulator.scenes.scene import Scene


@dataclass(frozen=True)
class LoadStates:
    """Where every entry of theta comes from, in every state. :func:`load_states` makes it.

    states : names of the states; one empty name where there is but one.
    entries : (S, p) of names of unknowns and of known values.
    """

    states: tuple[str, ...]
    entries: tuple[tuple[str | float, ...], ...]

    @property
    def unknowns(self) -> tuple[str, ...]:
        """Names of what is inferred: in theta's order, and within it in the states' order."""
        columns = zip(*self.entries, strict=True)
        return tuple(
            dict.fromkeys(entry for column in columns for entry in column if isinstance(entry, str))
        )

    def to_json(self) -> dict[str, list[str | float]]:
        """Each state's entries of theta: a name where it is inferred, else its known value."""
        return dict(zip(self.states, map(list, self.entries), strict=True))

    def thetas(self, values: Mapping[str, Any]) -> jax.Array:
        """Theta (..., S, p) from a value (...) of every unknown."""
        shape = jnp.broadcast_shapes(*(jnp.shape(values[name]) for name in self.unknowns))

        def entry(source: str | float) -> jax.Array:
            value = values[source] if isinstance(source, str) else source
            return jnp.broadcast_to(jnp.asarray(value, float), shape)

        rows = [jnp.stack([entry(e) for e in row], axis=-1) for row in self.entries]
        return jnp.stack(rows, axis=-2)


def load_states(
    scene: Scene,
    states: tuple[str, ...],
    prior: Mapping[str, dist.Distribution] | None = None,
    known: Mapping[str, float] | None = None,
) -> tuple[LoadStates, dict[str, dist.Distribution]]:
    """The states' entries of theta, and the prior of each unknown.

    Parameters
    ----------
    prior, known : distributions and known values by ``parameter`` or ``parameter@state``; a
        parameter of the loads that is named without a state is meant in every state that is not
        named. What neither names has the scene's box as its prior.

    Raises
    ------
    InputError
        A name that is no parameter or state, or one both known and with a prior.
    """
    given, known = dict(prior or {}), dict(known or {})
    by_state = _by_state(scene, states, (*given, *known))
    default = box_prior(scene)
    entries: list[list[str | float]] = []
    priors: dict[str, dist.Distribution] = {}
    for state in states:
        row: list[str | float] = []
        for parameter in scene.parameter_names:
            name = in_state(parameter, state) if parameter in by_state else parameter
            value, distribution = known.get(name), given.get(name)
            if value is None and distribution is None:
                value, distribution = known.get(parameter), given.get(parameter)
            if value is not None and distribution is not None:
                raise InputError(f"'{name}' is known and has a prior; give one of them")
            if value is not None:
                row.append(float(value))
                continue
            distribution = distribution or default[parameter]
            row.append(name)
            priors[name] = distribution
        entries.append(row)
    found = LoadStates(states, tuple(map(tuple, entries)))
    if not found.unknowns:
        raise InputError("every parameter is known; leave one to be inferred")
    return found, {name: priors[name] for name in found.unknowns}


def known_thetas(scene: Scene, states: tuple[str, ...], values: Mapping[str, float]) -> jax.Array:
    """Theta (S, p) of states in which ``values`` names every parameter.

    Raises
    ------
    InputError
        A name that is no parameter or state, a parameter without a value or outside its range.
    """
    by_state = _by_state(scene, states, tuple(values))
    rows = []
    for state in states:
        row = {}
        for parameter in scene.parameter_names:
            name = in_state(parameter, state) if parameter in by_state else parameter
            if (value := values.get(name, values.get(parameter))) is not None:
                row[parameter] = value
            elif name != parameter:
                raise InputError(f"scene '{scene.name}': no value for parameter '{name}'")
        rows.append(scene.theta(**row))
    return jnp.stack(rows)


def _by_state(scene: Scene, states: tuple[str, ...], names: Iterable[str]) -> set[str]:
    """Parameters that each state has for itself: the loads', and those ``names`` give a state."""
    found = set(scene.load_parameters) if states != ("",) else set()
    for name in names:
        parameter, state = split(name)
        if parameter not in scene.parameter_names:
            raise InputError(
                f"scene '{scene.name}' has no parameter '{parameter}'; "
                f"it has {', '.join(scene.parameter_names)}"
            )
        if state and state not in states:
            known = ", ".join(filter(None, states)) or "none; nothing is observed at a state"
            raise InputError(f"'{name}': load state '{state}' is unknown; known: {known}")
        if state:
            found.add(parameter)
    return found
