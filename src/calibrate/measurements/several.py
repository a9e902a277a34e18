"""Several observations of one body, by name: in one load state, or in several."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from calibrate.measurements.protocol import Observation
from calibrate.state_names import split, states_of
from emulator.core.errors import InputError


@dataclass(frozen=True, eq=False)
class Observations:
    """Observations by name; one forward map serves them all.

    In a body with several load states each name says which one is meant, as in ``volume@diastole``
    (:mod:`calibrate.statistical_model.load_states`).
    """

    parts: Mapping[str, Observation]

    def __post_init__(self) -> None:
        object.__setattr__(self, "parts", MappingProxyType(dict(self.parts)))
        if not self.parts:
            raise InputError("nothing is observed; name one observation or more")
        for name in self.parts:
            if not isinstance(name, str) or not name or "/" in name:
                raise InputError(f"observation is called {name!r}; use a name without '/'")
        self.states  # noqa: B018 - names that contradict each other are refused here

    @cached_property
    def states(self) -> tuple[str, ...]:
        """The load states, (S,); one empty name where no observation names any."""
        return states_of(self.parts)

    @property
    def bases(self) -> tuple[str, ...]:
        """Names without their load states, each once."""
        return tuple(dict.fromkeys(split(name)[0] for name in self.parts))

    @cached_property
    def nodes(self) -> np.ndarray:
        """Nodes a forward map must return, (k,): the union of the parts', each once.

        The nodes of the largest part come first, in its order, so that its rows are a slice. The
        reverse derivative of a slice scatters nothing; for many theta at once, scattering would
        take most of the time.
        """
        parts = sorted((part.nodes for part in self.parts.values()), key=len, reverse=True)
        nodes, first = np.unique(np.concatenate(parts), return_index=True)
        return nodes[np.argsort(first)]

    @cached_property
    def _rows(self) -> dict[str, np.ndarray | slice]:
        order = np.argsort(self.nodes)
        rows = {
            name: order[np.searchsorted(self.nodes, part.nodes, sorter=order)]
            for name, part in self.parts.items()
        }
        return {
            name: slice(len(k)) if np.array_equal(k, np.arange(len(k))) else k
            for name, k in rows.items()
        }

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Shape of each part's data."""
        return {name: part.shape for name, part in self.parts.items()}

    def __call__(self, displacement: jax.Array, thetas: jax.Array) -> dict[str, jax.Array]:
        """Data of each part without noise.

        Parameters
        ----------
        displacement : (..., S, k, 3) mm, of ``nodes`` in every load state.
        thetas : (..., S, p), theta in every load state.
        """
        found: dict[str, jax.Array] = {}
        for names in self._alike:
            part, rows = self.parts[names[0]], self._rows[names[0]]
            where = [self.states.index(split(name)[1]) for name in names]
            if len(where) == 1:  # without a gather
                found[names[0]] = part(
                    displacement[..., where[0], rows, :], thetas[..., where[0], :]
                )
                continue
            at = np.array(where)
            values = part(displacement[..., at, :, :][..., rows, :], thetas[..., at, :])
            each = jnp.moveaxis(values, values.ndim - 1 - len(part.shape), 0)
            found |= dict(zip(names, each, strict=True))
        return {name: found[name] for name in self.parts}

    @cached_property
    def _alike(self) -> list[list[str]]:
        """Names of one and the same observation together: points of a curve are one program."""
        found: dict[int, list[str]] = {}
        for name, part in self.parts.items():
            found.setdefault(id(part), []).append(name)
        return list(found.values())

    def expand[T](self, values: Mapping[str, T], what: str) -> dict[str, tuple[str, T]]:
        """Values of the parts' names, from values by name or by name without its state.

        ``{"volume": v}`` gives ``v`` to the volume of every load state. Each value comes with the
        name it was given under; a part that ``values`` does not mention has none.

        Raises
        ------
        InputError
            A value without a part; the message begins with ``what``.
        """
        known = dict.fromkeys((*self.parts, *self.bases))
        for name in values:
            if name not in known:
                raise InputError(f"{what}: '{name}' is not observed; observed: {', '.join(known)}")
        found = {}
        for name in self.parts:
            source = name if name in values else split(name)[0]
            if source in values:
                found[name] = source, values[source]
        return found

    def name[T](self, values: T | Mapping[str, T], what: str) -> dict[str, T]:
        """``values`` by the parts' names, in their order; a bare value belongs to a single part.

        Raises
        ------
        InputError
            A part without a value, or a value without a part; the message begins with ``what``.
        """
        known = ", ".join(self.parts)
        if not isinstance(values, Mapping):
            if len(self.parts) > 1:
                raise InputError(f"{what}: give one for each of {known}, by name")
            return dict.fromkeys(self.parts, values)
        for name in (*values, *self.parts):
            if name not in self.parts:
                raise InputError(f"{what}: '{name}' is not observed; observed: {known}")
            if name not in values:
                raise InputError(f"{what}: nothing for '{name}'; observed: {known}")
        return {name: values[name] for name in self.parts}

    def to_json(self) -> dict[str, Any]:
        """The description of each part, by name."""
        return {name: part.to_json() for name, part in self.parts.items()}


def observations(observe: Observation | Mapping[str, Observation] | Observations) -> Observations:
    """Observations by name; a single one without a name gets its usual one."""
    if isinstance(observe, Observations):
        return observe
    return Observations(observe if isinstance(observe, Mapping) else {observe.names[0]: observe})
