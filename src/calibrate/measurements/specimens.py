"""Curves of a specimen's test: what was measured in each of its states, one state after another."""

from __future__ import annotations

import re
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar, Self

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial import KDTree

from calibrate.measurements.collection import Observations
from calibrate.measurements.observation import Block, DataField, Observation, derive
from calibrate.measurements.points import PointObservation
from emulator.core.errors import InputError
from emulator.scenes.scene import all_nodes
from emulator.specimens.specimen import Specimen, require_specimen, states_in
from emulator.specimens.states import APPLIED, AXES, States
from emulator.viscosity.times import TIME

_APART = 1e3  # distance between the points of two tests, whose errors do not correlate
_ROUND_OFF = 1e-6
_FEWEST_ALIKE, _ALIKE = 3, 1e-4  # rows, and share of a range, in which two tests are the same one


class SpecimenCurves(PointObservation):
    """Numbers (d, c), or (d,) without components, measured in the d states of a specimen.

    A kind computes them from all nodes in ``_measured``, and gives its columns. It declares

    curve_axis : the label of the x axis of :meth:`curves`.
    at_rest : the number that is measured at rest.
    usual_length : the arc length of a curve over which errors correlate in a first experiment file,
        and its unit.

    and has

    scene : the specimen; :class:`InputError` for a scene.
    states : the measured states.
    points : the arc length of each state from the first of its test, and the test's position, so
        that errors correlate along a curve. With viscosity, a test's time adds, as a share of its
        whole time.
    along : the x axis of :meth:`curves`, (d,): the arc length, or the time in s.
    stretches : the prescribed stretches of the states along x, y and z, (d, 3); NaN where free.
    """

    scene: Specimen
    states: States
    stretches: np.ndarray
    along: np.ndarray

    place = ""
    row = "state"
    constants = {"stretch": "stretches"}
    curve_axis: ClassVar[str] = "way from the first state of each test, in stretch"
    at_rest: ClassVar[float] = 0.0
    usual_length: ClassVar[tuple[float, str]] = (0.1, "of stretch")

    def __post_init__(self) -> None:
        states = require_specimen(self.scene).measured
        points, times = np.zeros((len(states.free), 3)), self.scene.times
        points[:, 0] = along = states.paths
        for number, rows in enumerate(states.protocols.values()):
            points[rows, 1] = _APART * number
            if times is not None:
                points[rows, 0] += (times[rows] - times[rows[0]]) / (np.ptp(times[rows]) or 1.0)
        if times is not None:
            along = times
            derive(self, curve_axis="time in s")
        diagonals = np.diagonal(states.gradients, axis1=1, axis2=2)
        stretches = np.where(states.free, np.nan, 1.0 + diagonals)
        nodes = all_nodes(self.scene)
        derive(self, nodes=nodes, states=states, points=points)
        derive(self, stretches=stretches, along=along)

    @abstractmethod
    def _measured(self, u: jax.Array, theta: jax.Array) -> jax.Array:
        """Return the numbers (d, c) at the displacement (n, 3) mm of all nodes."""

    @property
    def row_names(self) -> list[str]:
        """The row of each state, and its test."""
        of = {
            k: test and f" of test {test}"
            for test, rows in self.states.protocols.items()
            for k in rows
        }
        return [f"in row {k + 1}{of[k]}" for k in range(len(self.points))]

    def comparable(self, numbers: np.ndarray) -> np.ndarray:
        """Return numbers (d, c) of the states in one measure, so that two tests can be compared."""
        return numbers

    def tests(self, entries: np.ndarray | None = None) -> dict[str, np.ndarray]:
        """Return the entries (k,) of the data of each test; one without a name where none has any.

        entries : the entries of the raveled data that are not missing, where some are.
        """
        states, _ = self._states_and_components(entries)
        tests = self.states.protocols
        return {test: np.flatnonzero(np.isin(states, rows)) for test, rows in tests.items()}

    def curves(self, entries: np.ndarray | None = None) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Return the curve of each test and component: x (k,) and the entries (k,) of the data.

        entries : as of :meth:`tests`.
        """
        states, components = self._states_and_components(entries)
        curves = {}
        for test, rows in self.tests(entries).items():
            for c, name in enumerate(self.components or (self.name,)):
                points = rows[components[rows] == c]
                if len(points):
                    curves[f"{test} {name}".strip()] = self.along[states[points]], points
        return curves

    def _states_and_components(self, entries: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        """Return the state and the component (n,) of each of the data."""
        rows = np.arange(int(np.prod(self.shape))) if entries is None else entries
        return np.divmod(rows, max(len(self.components), 1))

    def evaluate(self, displacement: jax.Array, theta: jax.Array) -> jax.Array:
        """Return the numbers (..., d, c), or (..., d) without components."""
        shape = "(d,c)" if self.components else "(d)"
        return jnp.vectorize(self._measured, signature=f"(k,i),(p)->{shape}")(displacement, theta)

    def check_motion(self, columns: Mapping[str, np.ndarray]) -> Self:
        """Return the observation if a table's columns of motion are its own states."""
        scene, expected = self.scene, self.states
        in_table = states_in(columns, tube=scene.tube, ordered=False)
        size = 1 if scene.tube is None else scene.tube.size
        if len(in_table.free) != size * len(expected.free):
            raise InputError(
                f"{len(in_table.free) // size} rows say how the specimen moves; scene "
                f"'{scene.name}' has {len(expected.free)} states"
            )
        apart = np.abs(in_table.gradients[::size] - expected.gradients).max(axis=(1, 2))
        pulled = np.abs(in_table.pulls[::size] - expected.pulls).max(axis=1)
        other = np.flatnonzero(
            (apart > _ROUND_OFF)
            | (pulled > _ROUND_OFF * np.abs(expected.pulls).max())
            | (in_table.free[::size] != expected.free).any(axis=1)
        )
        if len(other):
            raise InputError(
                f"row {other[0] + 1} moves otherwise than the state of scene '{scene.name}'"
            )
        return self

    @property
    def place_block(self) -> Block:
        """The columns of a data file that say how the specimen moves and is pulled.

        Columns of zeros or NaN are left out unless they are of a component's pull.
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
        kept = {w: x for w, x in arrays.items() if w in self._pulls or np.nan_to_num(x).any()}
        kept |= {} if self.scene.times is None else {TIME: self.scene.times}
        return [(DataField(word, (word,), where=True), x) for word, x in kept.items()]

    @property
    def _pulls(self) -> Sequence[str]:
        """The columns of prescribed stresses whose stretch is measured."""
        return ()


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
    def values_in(cls, *selection: Any) -> tuple[DataField, ...]:
        """Return a field for each component."""
        return tuple(DataField(component, (component,)) for component in selection[0])

    @classmethod
    def of(cls, scene: Specimen, components: str | Sequence[str]) -> Self:
        """Return the observation of ``components``, as text joined by commas."""
        texts = components.split(",") if isinstance(components, str) else components
        return cls(scene, tuple(str(text) for text in texts))  # type: ignore[call-arg]


def gripped_observations(observe: Observations, shares: np.ndarray) -> Observations:
    """Return the observations of a specimen with the stress that its grips add.

    shares : the added stress of each state as a fraction of its homogeneous stress, (d, 3, 3).

    :class:`InputError` for an observation without a method ``gripped``, to which they add nothing.
    """
    parts: dict[str, Observation] = {}
    for name, part in observe.parts.items():
        gripped = getattr(part, "gripped", None)
        if gripped is None:
            raise InputError(f"'{part.kind}' says nothing of a specimen's grips")
        parts[name] = gripped(shares)
    return replace(observe, parts=parts)


def check_tests(observed: Mapping[str, tuple[Any, np.ndarray]]) -> None:
    """Raise InputError if rows of a specimen's tests are there twice.

    The same measurement may come under two names, in two units or as two stresses, with other
    digits or without its last rows. Rows are alike whose motions are equal, and whose numbers
    differ by less than 1e-4 of their range: two measurements never agree so well in each of three.

    observed : each observation of a load state and its data, by name.
    """
    curves = [(part, y) for part, y in observed.values() if isinstance(part, SpecimenCurves)]
    if not curves:
        return
    states = curves[0][0].states
    numbers = np.hstack([part.comparable(y.reshape(len(y), -1)) for part, y in curves])
    times = curves[0][0].scene.times
    arrays = (states.gradients, states.pulls, *([] if times is None else [times]))
    motion = np.hstack([a.reshape(len(numbers), -1) for a in arrays])
    # In units of what two readings of one measurement may differ by.
    motion, numbers = _in_shares(motion, _ROUND_OFF), _in_shares(numbers, _ALIKE)
    known = np.isfinite(numbers)
    loaded = (np.nan_to_num(numbers) != 0.0).any(axis=1)

    def are_in(few: np.ndarray, many: np.ndarray) -> bool:
        """Return whether each of the rows ``few`` is among ``many``, or there again if they are."""
        both = known[few].any(axis=0) & known[many].any(axis=0)
        points = np.hstack([motion, np.nan_to_num(numbers[:, both])])
        nearest = 2 if few is many else 1
        gaps, _ = KDTree(points[many]).query(points[few], k=[nearest], p=np.inf)
        return bool(both.any() and (gaps <= 1.0).all())

    earlier: dict[str, np.ndarray] = {}
    for test, every in states.protocols.items():
        rows = every[loaded[every]]
        if len(rows) < _FEWEST_ALIKE:
            continue
        if are_in(rows, rows):
            whose = f"test '{test}'" if test else "the table"
            raise InputError(f"{whose} has its rows twice, which would count twice: leave one out")
        for other, others in earlier.items():
            if are_in(*sorted((rows, others), key=len)):
                count = min(len(every), len(states.protocols[other]))
                raise InputError(
                    f"tests '{other}' and '{test}' have the same {count} rows, which would count "
                    "twice: leave one out"
                )
        earlier[test] = rows


def _in_shares(values: np.ndarray, share: float) -> np.ndarray:
    """Return columns (d, c) as multiples of a share of the largest number of each."""
    size = np.nanmax(np.abs(values), axis=0, initial=0.0)
    return values / (share * np.where(size > 0.0, size, 1.0))
