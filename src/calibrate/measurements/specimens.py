"""Curves of a specimen's test: what was measured in each of its states, one state after another."""

from __future__ import annotations

import re
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any, ClassVar, Self

import jax
import jax.numpy as jnp
import numpy as np

from calibrate.measurements.collection import Observations
from calibrate.measurements.observation import Block, Field
from calibrate.measurements.points import PointObservation
from calibrate.noise.protocol import Sites
from emulator.core.errors import InputError
from emulator.scenes.scene import Scene, all_nodes
from emulator.scenes.specimen import measured_states, states_in
from emulator.scenes.states import APPLIED, AXES, States

_APART = 1e3  # distance between the sites of two tests, whose errors do not correlate
_ROUND_OFF = 1e-6
_FEWEST_ALIKE, _DIGITS_ALIKE = 3, 9  # rows, and decimals, in which two tests are the same one


class SpecimenCurves(PointObservation):
    """Numbers (d, c), or (d,) without components, measured in the d states of a specimen.

    A kind computes them from all nodes in ``_measured``, and gives its columns.

    scene : the specimen; :class:`InputError` for another scene.
    curve_axis : the label of the x axis of :attr:`curves`.
    """

    scene: Scene

    place_field = Field("motion", ("stretch_x",), where=True)
    constants = {"stretch": "stretches"}
    curve_axis: ClassVar[str] = "way from the first state of each test, in stretch"
    positive = False
    at_rest: ClassVar[float] = 0.0
    """The number that is measured at rest."""
    usual_length: ClassVar[tuple[float, str]] = (0.1, "of stretch")
    """Way along a curve over which errors correlate in a first experiment file, and its unit."""

    def __post_init__(self) -> None:
        measured_states(self.scene)  # refuses what is no specimen
        self._derive(nodes=all_nodes(self.scene))

    @abstractmethod
    def _measured(self, u: jax.Array, theta: jax.Array) -> jax.Array:
        """Return the numbers (d, c) at the displacement (n, 3) mm of all nodes."""

    @cached_property
    def states(self) -> States:
        """The measured states."""
        return measured_states(self.scene)

    @property
    def _full_shape(self) -> tuple[int, ...]:
        count = len(self.states.free)
        return (count, len(self.components)) if self.components else (count,)

    @cached_property
    def stretches(self) -> np.ndarray:
        """The prescribed stretches of the states along x, y and z, (d, 3); NaN where free."""
        diagonals = np.diagonal(self.states.gradients, axis1=1, axis2=2)
        return np.where(self.states.free, np.nan, 1.0 + diagonals)

    @property
    def tests(self) -> Mapping[str, np.ndarray]:
        """The states (k,) of each test by its name; one without a name where none has any."""
        return self.states.protocols

    @cached_property
    def paths(self) -> np.ndarray:
        """The way of each state from the first of its test, and the test's place."""
        paths = np.zeros((len(self.states.free), 3))
        paths[:, 0] = self.states.paths
        for number, rows in enumerate(self.tests.values()):
            paths[rows, 1] = _APART * number
        return paths

    @property
    def sites(self) -> Sites:
        """The way along each test, so that errors correlate along its curve."""
        sites = Sites.of(self.paths, max(len(self.components), 1))
        return sites if self.entries is None else Sites(*(each[self.entries] for each in sites))

    @property
    def data_of_tests(self) -> Mapping[str, np.ndarray]:
        """The entries (k,) of the data of each test."""
        number = self.sites.positions[:, 1] / _APART
        return {test: np.flatnonzero(number == k) for k, test in enumerate(self.tests)}

    @property
    def curves(self) -> Mapping[str, tuple[np.ndarray, np.ndarray]]:
        """The curve of each test and component: x (k,) and the entries (k,) of the data."""
        names = self.components or (self.name,)
        every = np.arange(len(self.paths) * len(names))
        states, columns = np.divmod(every if self.entries is None else self.entries, len(names))
        found = {}
        for test, rows in self.tests.items():
            for c, name in enumerate(names):
                own = np.flatnonzero(np.isin(states, rows) & (columns == c))
                if len(own):
                    found[f"{test} {name}".strip()] = self.paths[states[own], 0], own
        return found

    def gripped(self, shares: np.ndarray) -> Self:
        """Return the observation with the stress that grips add.

        shares : the added stress of each state as a fraction of its homogeneous stress, (d, 3, 3).

        :class:`InputError` for an observation to which grips add nothing.
        """
        raise InputError(f"'{self.kind}' says nothing of a specimen's grips")

    def rows(self) -> tuple[str, np.ndarray]:
        """Return the numbers of the states."""
        return "state", np.arange(len(self.paths))

    def evaluate(self, displacement: jax.Array, theta: jax.Array) -> jax.Array:
        """Return the numbers (..., d, c), or (..., d) without components."""
        shape = "(d,c)" if self.components else "(d)"
        return jnp.vectorize(self._measured, signature=f"(k,i),(p)->{shape}")(displacement, theta)

    def check_motion(self, columns: Mapping[str, np.ndarray]) -> Self:
        """Return the observation if a table's columns of motion are its own states."""
        scene, expected = self.scene, self.states
        found = states_in(columns, tube=scene.tube, ordered=False)
        each = 1 if scene.tube is None else scene.tube.size
        if len(found.free) != each * len(expected.free):
            raise InputError(
                f"{len(found.free) // each} rows say how the specimen moves; scene '{scene.name}' "
                f"has {len(expected.free)} states"
            )
        apart = np.abs(found.gradients[::each] - expected.gradients).max(axis=(1, 2))
        pulled = np.abs(found.pulls[::each] - expected.pulls).max(axis=1)
        other = np.flatnonzero(
            (apart > _ROUND_OFF)
            | (pulled > _ROUND_OFF * np.abs(expected.pulls).max())
            | (found.free[::each] != expected.free).any(axis=1)
        )
        if len(other):
            raise InputError(
                f"row {other[0] + 1} moves otherwise than the state of scene '{scene.name}'"
            )
        return self

    def motion(self, also: Sequence[str] = ()) -> Block:
        """Return the columns of a data file that say how the specimen moves and is pulled.

        also : columns that are there even if they say nothing, of zeros or NaN.
        """
        if self.scene.tube is not None:
            arrays = self.scene.tube.motion(self.stretches)
        else:
            arrays = {f"stretch_{a}": self.stretches[:, k] for k, a in enumerate(AXES)}
            arrays |= {
                f"shear_{a}{b}": self.states.gradients[:, i, j]
                for i, a in enumerate(AXES)
                for j, b in enumerate(AXES)
                if i != j
            }
            pulls = np.where(self.states.free, self.states.pulls, np.nan)
            arrays |= {f"{APPLIED}_{a}": pulls[:, k] for k, a in enumerate(AXES)}
        kept = {w: x for w, x in arrays.items() if w in also or np.nan_to_num(x).any()}
        return [(Field(word, (word,)), x) for word, x in kept.items()]


class Components(SpecimenCurves):
    """Components (c) of what was measured in each of the d states of a specimen, not of a tube.

    A kind declares the ``pattern`` of the components' names, and ``such_as`` for errors.
    """

    components: tuple[str, ...]

    pattern: ClassVar[re.Pattern[str]]
    such_as: ClassVar[str]
    arguments = ("components",)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.scene.tube is not None:
            raise InputError(
                f"scene '{self.scene.name}' is a tube, which is measured by pressure and "
                "force_axial"
            )
        for component in self.components:
            if self.pattern.fullmatch(component) is None:
                raise InputError(f"{self.quantity} '{component}' is unknown; {self.such_as}")

    @classmethod
    def of(cls, scene: Scene, components: str | Sequence[str]) -> Self:
        """Return the observation of ``components``, as text joined by commas."""
        texts = components.split(",") if isinstance(components, str) else components
        return cls(scene, tuple(str(text) for text in texts))  # type: ignore[call-arg]


def gripped_observations(observe: Observations, shares: np.ndarray) -> Observations:
    """Return the observations of a specimen with the stress that its grips add.

    Arguments and errors are those of :meth:`SpecimenCurves.gripped`.
    """
    parts = {}
    for name, part in observe.parts.items():
        if not isinstance(part, SpecimenCurves):
            raise InputError(f"'{part.kind}' says nothing of a specimen's grips")
        parts[name] = part.gripped(shares)
    return replace(observe, parts=parts)


def check_tests(observed: Mapping[str, tuple[Any, np.ndarray]]) -> None:
    """Raise InputError if two tests of a specimen have the same motions and the same numbers.

    observed : each observation of a load state and its data, by name.
    """
    curves = [(part, y) for part, y in observed.values() if isinstance(part, SpecimenCurves)]
    seen: dict[bytes, str] = {}
    for test, rows in curves[0][0].tests.items() if curves else ():
        if len(rows) < _FEWEST_ALIKE:
            continue
        states = curves[0][0].states
        numbers = [y[rows].reshape(len(rows), -1) for _, y in curves]
        motion = [a[rows].reshape(len(rows), -1) for a in (states.gradients, states.pulls)]
        content = np.round(np.hstack([*motion, *numbers]), _DIGITS_ALIKE) + 0.0
        first = seen.setdefault(content.tobytes(), test)
        if first != test:
            raise InputError(
                f"tests '{first}' and '{test}' have the same {len(rows)} rows, which would count "
                "twice: leave one out"
            )
