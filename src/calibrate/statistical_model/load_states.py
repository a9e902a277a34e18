r"""Load states: one body measured at several loads.

A pressure-volume curve is one body at several pressures. Its material is the same in every state,
its loads are not: parameters that the scene's loads take belong to a state, all others are shared.
With S states the model's unknowns determine S rows of theta,

.. math:: \theta_s = (m, \ell_s), \qquad s = 1, \dots, S,

with the material :math:`m` and the loads :math:`\ell_s`; each entry is either inferred or known.
Names say which state is meant, ``pressure@p8`` (:mod:`calibrate.state_names`).
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpyro.distributions as dist

from calibrate.priors import box_prior
from calibrate.state_names import in_state, split
from emulator.core.errors import InputError
from emulator.scenes.forward_problem import ForwardProblem


@dataclass(frozen=True)
class LoadStates:
    """The source of every entry of theta in every state. :func:`load_states` makes it.

    states : the names of the states; one empty name where there is but one.
    entries : the name of an unknown, or the known value, of each state and parameter, (S, p).
    """

    states: tuple[str, ...]
    entries: tuple[tuple[str | float, ...], ...]

    @property
    def unknowns(self) -> tuple[str, ...]:
        """Names of the unknowns, in theta's order, and within it in the states' order."""
        entries = (entry for column in zip(*self.entries, strict=True) for entry in column)
        return tuple(dict.fromkeys(entry for entry in entries if isinstance(entry, str)))

    def to_json(self) -> dict[str, list[str | float]]:
        """Return each state's entries of theta: a name where inferred, else the known value."""
        return dict(zip(self.states, map(list, self.entries), strict=True))

    def thetas(self, values: Mapping[str, Any]) -> jax.Array:
        """Return theta (..., S, p) from a value (...) of every unknown."""
        shape = jnp.broadcast_shapes(*(jnp.shape(values[name]) for name in self.unknowns))

        def entry(source: str | float) -> jax.Array:
            value = values[source] if isinstance(source, str) else source
            return jnp.broadcast_to(jnp.asarray(value, float), shape)

        rows = [jnp.stack([entry(e) for e in row], axis=-1) for row in self.entries]
        return jnp.stack(rows, axis=-2)

    def values(self, thetas: jax.Array) -> jax.Array:
        """Return the value (q,) of every unknown from theta (S, p): the inverse of :meth:`thetas`.

        Theta's known entries are not looked at.
        """
        places: dict[str | float, tuple[int, int]] = {}
        for k, row in enumerate(self.entries):
            for column, entry in enumerate(row):
                places.setdefault(entry, (k, column))
        return jnp.stack([thetas[places[name]] for name in self.unknowns])


def load_states(
    scene: ForwardProblem,
    states: tuple[str, ...],
    prior: Mapping[str, dist.Distribution] | None = None,
    known: Mapping[str, float] | None = None,
) -> tuple[LoadStates, dict[str, dist.Distribution]]:
    """Return the states' entries of theta, and the prior of each unknown.

    prior, known : distributions and known values by ``parameter`` or ``parameter@state``; a
        parameter of the loads that is named without a state is meant in every state that is not
        named. A parameter that neither names has the scene's box as its prior.

    :class:`InputError` for a name that is no parameter or state, or one both known and with a
    prior.
    """
    prior, box = prior or {}, box_prior(scene)
    result = LoadStates(states, _entries(scene, states, prior, known or {}))
    if not result.unknowns:
        raise InputError("every parameter is known; leave one to be inferred")
    priors = {
        name: prior.get(name, prior.get(base, box[base]))
        for name, base in ((name, split(name)[0]) for name in result.unknowns)
    }
    return result, priors


def boxed(
    states: LoadStates, prior: Collection[str] | None, bounded: Collection[str]
) -> frozenset[str]:
    """Return the unknowns whose prior is their parameter's range, which may be a guess.

    Parameters
    ----------
    prior : the names with a prior. bounded : the names whose range ends where nature does.

    :class:`InputError` for a bounded parameter that is not inferred.
    """
    bases = {name: split(name)[0] for name in states.unknowns}
    for name in bounded:
        if name not in (*bases, *bases.values()):
            inferred = ", ".join(states.unknowns)
            raise InputError(f"bounded: '{name}' is not inferred; inferred: {inferred}")
    named = {*(prior or ()), *bounded}
    return frozenset(name for name, base in bases.items() if not {name, base} & named)


def known_thetas(
    scene: ForwardProblem, states: tuple[str, ...], values: Mapping[str, float]
) -> jax.Array:
    """Return theta (S, p) of states in which ``values`` names every parameter.

    :class:`InputError` for a name that is no parameter or state, a parameter without a value or
    outside its range.
    """
    entries = _entries(scene, states, {}, values)
    if missing := [entry for row in entries for entry in row if isinstance(entry, str)]:
        raise InputError(f"scene '{scene.name}': no value for parameter '{missing[0]}'")
    rows = [dict(zip(scene.parameter_names, map(float, row), strict=True)) for row in entries]
    return jnp.stack([scene.theta(**row) for row in rows])


def _entries(
    scene: ForwardProblem,
    states: tuple[str, ...],
    prior: Collection[str],
    known: Mapping[str, float],
) -> tuple[tuple[str | float, ...], ...]:
    """Return the entries of :class:`LoadStates`."""
    by_state = set(scene.load_parameters) if states != ("",) else set()
    for name in (*prior, *known):
        parameter, state = split(name)
        if parameter not in scene.parameter_names:
            raise InputError(
                f"scene '{scene.name}' has no parameter '{parameter}'; "
                f"it has {', '.join(scene.parameter_names)}"
            )
        if state and state not in states:
            listed = ", ".join(filter(None, states)) or "none; nothing is observed at a state"
            raise InputError(f"'{name}': load state '{state}' is unknown; known: {listed}")
        if not math.isfinite(known.get(name, 0.0)):
            raise InputError(f"known: '{name}' is {known[name]}; give a finite number")
        if state:
            by_state.add(parameter)

    def entry(parameter: str, state: str) -> str | float:
        name = in_state(parameter, state) if parameter in by_state else parameter
        source = name if name in known or name in prior else parameter
        if source in known and source in prior:
            raise InputError(f"'{name}' is known and has a prior; give one of them")
        return float(known[source]) if source in known else name

    return tuple(tuple(entry(p, state) for p in scene.parameter_names) for state in states)
