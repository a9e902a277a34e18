"""Observations of one body by name, in one load state or in several, and their missing values.

Leaving a missing entry out is exact. With entries m missing and p present, the likelihood of what
was measured is the integral of p(y_p, y_m | theta) over y_m, which for independent noise drops the
factors of y_m, and for correlated Gaussian noise the rows and columns of its covariance. This
supposes that whether a value is missing does not depend on the value.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, partial
from types import MappingProxyType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from scipy.sparse import csr_array, eye_array, vstack

from calibrate.measurements.observation import Observation, check_values
from calibrate.measurements.points import PointObservation
from calibrate.measurements.words import names_of, to_json
from calibrate.noise.protocol import Sites
from calibrate.state_names import split, states_of
from emulator.core.errors import InputError
from emulator.surrogates.protocol import ForwardMap, Prediction

Data = dict[str, jax.Array]
PRESENT = "present"
"""The key in JSON of the entries that are not missing."""


@dataclass(frozen=True, eq=False)
class Observations:
    """Observations by name; one forward map serves them all.

    parts : the observations by name; those with one description become one object. In a body with
        several load states each name says which one is meant, as in ``volume@diastole``
        (:mod:`calibrate.statistical_model.load_states`).
    entries : of each part with missing values the positions (n,) in its raveled data that are not
        missing, ascending. Its data has shape (n,).
    """

    parts: Mapping[str, Observation]
    entries: Mapping[str, np.ndarray] = MappingProxyType({})

    def __post_init__(self) -> None:
        if not self.parts:
            raise InputError("nothing is observed; name one observation or more")
        for name in self.parts:
            if not isinstance(name, str) or not name or "/" in name:
                raise InputError(f"observation is called {name!r}; use a name without '/'")
        distinct: dict[str, Observation] = {}
        parts = {n: distinct.setdefault(json.dumps(to_json(p)), p) for n, p in self.parts.items()}
        object.__setattr__(self, "parts", MappingProxyType(parts))
        self.states  # noqa: B018 - names that contradict each other are refused here

    @cached_property
    def states(self) -> tuple[str, ...]:
        """Names of the load states, (S,); one empty name where no observation names any."""
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
        """Positions in ``nodes`` of each part's nodes."""
        position = {node: k for k, node in enumerate(self.nodes.tolist())}
        rows = {n: np.array([position[k] for k in p.nodes.tolist()]) for n, p in self.parts.items()}
        return {
            name: slice(len(k)) if np.array_equal(k, np.arange(len(k))) else k
            for name, k in rows.items()
        }

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Shape of each part's data."""
        return {
            name: self.entries[name].shape if name in self.entries else part.shape
            for name, part in self.parts.items()
        }

    def unravel(self, flat: jax.Array) -> Data:
        """Return flat data (m,), in the order of ``ravel_pytree``, by the parts' names."""
        return ravel_pytree({n: jnp.zeros(shape) for n, shape in self.shapes.items()})[1](flat)

    def only(self, names: Iterable[str]) -> Observations | None:
        """Return the observations of these names; None where there is none."""
        parts = {name: self.parts[name] for name in names}
        entries = {name: e for name, e in self.entries.items() if name in parts}
        return Observations(parts, entries) if parts else None

    def sites(self, name: str) -> Sites | None:
        """Return the position of each number of the data; None for what has no one position."""
        part = self.parts[name]
        if not isinstance(part, PointObservation):
            return None
        kept = self.entries.get(name, slice(None))
        return Sites(*(of[kept] for of in Sites.of(part.points, max(len(part.components), 1))))

    def filled(self, name: str, values: np.ndarray) -> np.ndarray:
        """Return ``values`` of the data called ``name`` with the missing ones, which are NaN."""
        if name not in self.entries:
            return np.asarray(values)
        filled = np.full(self.parts[name].shape, np.nan)
        filled.flat[self.entries[name]] = values
        return filled

    def check(self, name: str, values: np.ndarray) -> None:
        """Raise :class:`InputError` on data of a wrong shape or with impossible values.

        NaN marks a missing value and passes.
        """
        part, shape = self.parts[name], self.shapes[name]
        if values.shape != shape:
            missing = int(np.prod(part.shape) - np.prod(shape))
            gaps = f", as {missing} values are missing" if missing else ""
            raise InputError(
                f"data has shape {values.shape}; the observation expects {shape}{gaps} "
                f"({name}, {part.unit})"
            )
        check_values(part, name, self.filled(name, values))

    def __call__(self, displacement: jax.Array, thetas: jax.Array) -> dict[str, jax.Array]:
        """Return the data of each part without noise.

        displacement : the displacement of ``nodes`` in every load state, mm, (..., S, k, 3).
        thetas : theta in every load state, (..., S, p).
        """
        # One observation in several load states, as of a curve, is one program.
        groups: dict[Observation, list[str]] = {}
        for name, part in self.parts.items():
            groups.setdefault(part, []).append(name)
        data: dict[str, jax.Array] = {}
        for part, names in groups.items():
            rows = self._rows[names[0]]
            states = [self.states.index(split(name)[1]) for name in names]
            if len(states) == 1:  # one state needs no gather
                (state,) = states
                data[names[0]] = part(displacement[..., state, rows, :], thetas[..., state, :])
                continue
            index = np.array(states)
            values = part(displacement[..., index, :, :][..., rows, :], thetas[..., index, :])
            by_state = jnp.moveaxis(values, values.ndim - 1 - len(part.shape), 0)
            data |= dict(zip(names, by_state, strict=True))
        return {name: self._present(name, data[name]) for name in self.parts}

    def _present(self, name: str, values: jax.Array) -> jax.Array:
        """Return the entries of data (..., *shape) without gaps that are not missing."""
        if name not in self.entries:
            return values
        batch = values.shape[: values.ndim - len(self.parts[name].shape)]
        return values.reshape(*batch, -1)[..., self.entries[name]]

    @cached_property
    def decoding(self) -> Decoding:
        """The matrix by which a sum of modes is decoded at once, in place of all nodes."""
        groups = dict[Observation, list[str]]()
        for name, part in self.parts.items():
            groups.setdefault(part, []).append(name)
        columns = np.arange(3 * len(self.nodes)).reshape(-1, 3)
        blocks, rows, others = list[csr_array](), dict[str, np.ndarray](), list[str]()
        start = 0
        for part, names in groups.items():
            matrix = part.matrix
            if matrix is None:
                others += names
                continue
            entries = {n: self.entries.get(n, np.arange(matrix.shape[0])) for n in names}
            used = np.unique(np.concatenate(list(entries.values())))
            block = csr_array(matrix)[used].tocoo()
            places = block.row, columns[self._rows[names[0]]].ravel()[block.col]
            blocks.append(csr_array((block.data, places), (len(used), columns.size)))
            rows |= {n: start + np.searchsorted(used, e) for n, e in entries.items()}
            start += len(used)
        rest = self.only(others)
        if rest is not None:
            place = {int(node): k for k, node in enumerate(self.nodes)}
            seen = columns[[place[int(node)] for node in rest.nodes]].ravel()
            blocks.append(csr_array(eye_array(columns.size, format="csr")[seen]))
        return Decoding(csr_array(vstack(blocks)), rows, rest)

    def through(self, forward: ForwardMap) -> Callable[[jax.Array], tuple[Data, jax.Array]]:
        """Return a function of theta in every load state, (S, p): the data, and its validity ().

        The data of each part are without noise, and 0 where not valid.

        forward : the map of all nodes.
        """
        with jax.ensure_compile_time_eval():  # what is kept must not be traced, if a caller is
            by_map: dict[Observation, Callable[[jax.Array], jax.Array]] = {}
            for part in dict.fromkeys(self.parts.values()):
                if (function := part.through(forward)) is not None:
                    by_map[part] = function
            others = self.only(name for name, part in self.parts.items() if part not in by_map)
            seen = others._seen(forward.at(others.nodes)) if others is not None else None
        if seen is not None and not by_map:
            return seen
        states = () if others is None else others.states
        rows = np.array([self.states.index(state) for state in states], dtype=int)

        def data(thetas: jax.Array) -> tuple[Data, jax.Array]:
            values, valid = ({}, jnp.array(True)) if seen is None else seen(thetas[rows])
            for part, function in by_map.items():
                names = [name for name in self.parts if self.parts[name] is part]
                at = thetas[np.array([self.states.index(split(name)[1]) for name in names])]
                valid &= jnp.all(forward.scene.space.contains(at))
                numbers = jnp.where(valid, jax.vmap(function)(at), 0.0)
                values |= dict(zip(names, numbers, strict=True))
            return {name: values[name] for name in self.parts}, valid

        return data

    def _seen(self, forward: ForwardMap) -> Callable[[jax.Array], tuple[Data, jax.Array]]:
        """Return the function of :meth:`through` by the displacement of ``nodes``."""
        seen_through = getattr(forward, "seen_through", None)
        decode = None if seen_through is None else seen_through(self.decoding.matrix)
        if decode is not None:
            return partial(self._decoded, decode)

        def by_displacement(thetas: jax.Array) -> tuple[Data, jax.Array]:
            displacement, valid = in_every_state(forward, thetas)
            return self(jnp.where(valid, displacement, 0.0), thetas), valid

        return by_displacement

    def _decoded(
        self, decode: Callable[[jax.Array], tuple[jax.Array, jax.Array]], thetas: jax.Array
    ) -> tuple[Data, jax.Array]:
        """Return the function of :meth:`through` by what :attr:`decoding` asks for.

        decode : the function of theta (p,) to its matrix's product (r,) with the displacement.
        """
        values, valid = jax.vmap(decode)(thetas)
        valid = jnp.all(valid)
        values = jnp.where(valid, values, 0.0)
        _, rows, rest = self.decoding
        data: dict[str, jax.Array] = {}
        for name, index in rows.items():
            state, first = self.states.index(split(name)[1]), int(index[0])
            stop = first + len(index)
            in_a_row = np.array_equal(index, np.arange(first, stop))
            numbers = values[state, first:stop] if in_a_row else values[state, index]
            data[name] = numbers.reshape(self.shapes[name])
        if rest is not None:
            states = np.array([self.states.index(state) for state in rest.states])
            u = values[states, values.shape[1] - 3 * len(rest.nodes) :]
            data |= rest(u.reshape(len(states), -1, 3), thetas[states])
        return {name: data[name] for name in self.parts}, valid

    def expand[T](self, values: Mapping[str, T], what: str) -> dict[str, tuple[str, T]]:
        """Return values by the parts' names, from values by names with or without a load state.

        ``{"volume": v}`` gives ``v`` to the volume of every load state. Each value comes with the
        name it was given under; a part that ``values`` does not mention has none.

        :class:`InputError`, which begins with ``what``, for a value without a part.
        """
        known = dict.fromkeys((*self.parts, *self.bases))
        for name in values:
            if name not in known:
                raise InputError(f"{what}: '{name}' is not observed; observed: {', '.join(known)}")
        sources = {name: name if name in values else split(name)[0] for name in self.parts}
        return {n: (source, values[source]) for n, source in sources.items() if source in values}

    def name[T](self, values: T | Mapping[str, T], what: str) -> dict[str, T]:
        """Return ``values`` by the parts' names, in their order; a bare value is a single part's.

        :class:`InputError`, which begins with ``what``, for a part without a value and the other
        way round.
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
        """Return the description of each part, and which entries are not missing, by name."""
        present = {name: {PRESENT: entries.tolist()} for name, entries in self.entries.items()}
        return {name: to_json(part) | present.get(name, {}) for name, part in self.parts.items()}


class Decoding(NamedTuple):
    """The matrix from displacements to the data of linear observations, and the other observations.

    matrix : its product (r,) with the displacements (3 k,) has the data of linear observations, and
        after it the displacements of the nodes of the others.
    rows : the rows of each linear observation's data, by its name.
    others : the other observations; None where all are linear.
    """

    matrix: csr_array
    rows: Mapping[str, np.ndarray]
    others: Observations | None


def in_every_state(forward: ForwardMap, thetas: jax.Array) -> Prediction:
    """Return the displacement (S, k, 3) mm at ``thetas`` (S, p), valid where all are."""
    if len(thetas) == 1:
        displacement, valid = forward.evaluate(thetas[0])
        return Prediction(displacement[None], valid)
    displacement, valid = jax.vmap(forward.evaluate)(thetas)
    return Prediction(displacement, jnp.all(valid))


def observations(observe: Observation | Mapping[str, Observation] | Observations) -> Observations:
    """Return observations by name; a single one without a name gets its usual name."""
    if isinstance(observe, Observations):
        return observe
    return Observations(
        observe if isinstance(observe, Mapping) else {names_of(observe)[0]: observe}
    )


def leave_out_missing(
    observe: Observations, data: Mapping[str, np.ndarray]
) -> tuple[Observations, dict[str, np.ndarray]]:
    """Return observations and data without the entries that are NaN.

    :class:`InputError` for an observation of which every value is missing.
    """
    entries, present = dict(observe.entries), dict(data)
    for name, values in data.items():
        check_some(name, values)
        rows = np.flatnonzero(~np.isnan(values))
        if len(rows) < np.size(values):
            entries[name] = entries[name][rows] if name in entries else rows
            present[name] = np.ravel(values)[rows]
    complete = all(present[name] is values for name, values in data.items())
    return (observe if complete else replace(observe, entries=entries)), present


def check_some(name: str, values: np.ndarray) -> None:
    """Raise :class:`InputError` where every one of ``values`` is missing."""
    if np.isnan(values).all():
        raise InputError(f"data: every value of {name} is missing; give one, or leave {name} out")
