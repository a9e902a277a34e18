r"""Stresses of a specimen: the curves of a tensile, biaxial or shear test.

All measures follow from the first Piola-Kirchhoff stress P of a state of gradient F
(:func:`~emulator.surrogates.homogeneous.homogeneous_stresses`) with what grips add to it
(:mod:`emulator.surrogates.gripped`),

.. math:: \sigma = P F^T / J, \qquad S = F^{-1} P .

========================  ====================================================
column                    is
========================  ====================================================
``stress_x``              :math:`P_{xx}`, force over the area at rest
``cauchy_x``              :math:`\sigma_{xx}`
``second_x``              :math:`S_{xx}`
``stress_xy``             :math:`P_{xy}`, along x on planes normal to y
``force_x``, ``area_x``   :math:`P_{xx}` as a force, and the area at rest that it acts on
========================  ====================================================

Columns may have units, ``stress_x [MPa]``; without one, stresses are in kPa, forces in mN and areas
in mm2.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import jax
import jax.numpy as jnp
import numpy as np

from calibrate.measurements.observation import Block, Field, Table
from calibrate.measurements.points import PointObservation
from calibrate.noise.protocol import Sites
from emulator.core.errors import InputError
from emulator.mechanics.kinematics import cofactor, determinant
from emulator.scenes.scene import Scene, all_nodes
from emulator.scenes.specimen import AXES, motion_columns, states, states_of, with_unit
from emulator.surrogates.gripped import added, gripped_stresses
from emulator.surrogates.homogeneous import homogeneous_stresses

_COMPONENT = re.compile(r"(stress|cauchy|second)_([xyz])([xyz])?")
_PULL = re.compile(r"force(_[xyz][xyz]?)")
_AREA = re.compile(r"area(_[xyz][xyz]?)")
_IN_KPA = {"kPa": 1.0, "Pa": 1e-3, "MPa": 1e3, "mmHg": 0.13332239, "g/cm2": 0.0980665}
_IN_MN = {"mN": 1.0, "N": 1e3, "g": 9.80665, "gf": 9.80665, "kN": 1e6}
_IN_MM2 = {"mm2": 1.0, "cm2": 100.0, "m2": 1e6}
_APART = 1e3  # distance between the sites of two tests, whose errors do not correlate
_ROUND_OFF = 1e-6


@dataclass(frozen=True, eq=False)
class Stress(PointObservation):
    """Stresses (d, c) of ``components`` (c) in the d states of a specimen, in kPa.

    :class:`InputError` for a scene that is no specimen, or an unknown component.

    scene : the specimen.
    components : such as ``stress_x`` or ``cauchy_xy``.
    shares : what grips add, (d, 3, 3), in place of what the scene's grips have learned.
    """

    scene: Scene
    components: tuple[str, ...]
    shares: jax.Array | None = None

    kind = "stress"
    usage = "stress:COMPONENT,..."
    hint = ", such as stress:stress_x,stress_y"
    name = "stress"
    arguments = ("components",)
    quantity = "stress"
    unit = "kPa"
    other_units = {"MPa": 1e3, "Pa": 1e-3, "mmHg": 0.13332239}
    place_field = Field("motion", ("stretch_x",), where=True)
    value_fields = (Field("stress_x", ("stress_x",)),)
    constants = {"stretch": "stretches"}
    curve_axis = "way from the first state of each test, in stretch"

    def __post_init__(self) -> None:
        states_of(self.scene)  # refuses what is no specimen
        for component in self.components:
            if _COMPONENT.fullmatch(component) is None:
                raise InputError(
                    f"stress '{component}' is unknown; give stress, cauchy or second with its "
                    "plane, such as stress_x or stress_xy"
                )
        if self.scene.grips is not None and self.scene.grips.learned is not None:
            self._check_grips(self.scene.grips.learned.shares[0])
        self._derive(nodes=all_nodes(self.scene))

    @classmethod
    def of(cls, scene: Scene, components: str | Sequence[str]) -> Self:
        """Return the observation of ``components``, as text joined by commas."""
        texts = components.split(",") if isinstance(components, str) else components
        return cls(scene, tuple(str(text) for text in texts))

    @property
    def _full_shape(self) -> tuple[int, ...]:
        return len(self.scene.mesh.elements), len(self.components)

    @cached_property
    def stretches(self) -> np.ndarray:
        """The prescribed stretches of the states along x, y and z, (d, 3); NaN where free."""
        given = states_of(self.scene)
        return np.where(given.free, np.nan, 1.0 + np.diagonal(given.gradients, axis1=1, axis2=2))

    @cached_property
    def tests(self) -> Mapping[str, np.ndarray]:
        """The states (k,) of each test by its name; one without a name where none has any."""
        return states_of(self.scene).protocols

    @cached_property
    def paths(self) -> np.ndarray:
        """The way of each state from the first of its test, in stretch, and the test's place."""
        given = states_of(self.scene)
        paths = np.zeros((len(given.free), 3))
        paths[:, 0] = given.paths
        for number, rows in enumerate(self.tests.values()):
            paths[rows, 1] = _APART * number
        return paths

    @property
    def sites(self) -> Sites:
        """The way along each test in stretch, so that errors correlate along its curve."""
        sites = Sites.of(self.paths, len(self.components))
        return sites if self.entries is None else Sites(*(each[self.entries] for each in sites))

    @property
    def curves(self) -> Mapping[str, tuple[np.ndarray, np.ndarray]]:
        """The curve of each test and component, over the way in stretch."""
        every = np.arange(len(self.stretches) * len(self.components))
        states, components = np.divmod(
            every if self.entries is None else self.entries, len(self.components)
        )
        found = {}
        for test, rows in self.tests.items():
            for c, component in enumerate(self.components):
                own = np.flatnonzero(np.isin(states, rows) & (components == c))
                if len(own):
                    found[f"{test} {component}".strip()] = self.paths[states[own], 0], own
        return found

    def gripped(self, shares: np.ndarray) -> Self:
        """Return the same stresses with what grips add, (d, 3, 3) as shares of a state's stress.

        :class:`InputError` where a component acts on no grip.
        """
        self._check_grips(shares)
        part = copy(self)  # with the entries that are not missing
        part._derive(shares=jnp.asarray(np.nan_to_num(shares)))
        return part

    def _check_grips(self, shares: np.ndarray) -> None:
        """Refuse components of which grips say nothing: all their shares are NaN."""
        for component in self.components:
            _, row, column = _parts(component)
            if np.isnan(shares[:, row, column]).all():
                raise InputError(f"'{component}' acts on no grip of the piece")

    def rows(self) -> tuple[str, np.ndarray]:
        """Return the numbers of the states."""
        return "state", np.arange(len(self.stretches))

    def evaluate(self, displacement: jax.Array, theta: jax.Array) -> jax.Array:
        """Return stresses (..., d, c) in kPa."""
        return jnp.vectorize(self._stresses, signature="(k,i),(p)->(d,c)")(displacement, theta)

    def _stresses(self, u: jax.Array, theta: jax.Array) -> jax.Array:
        H, P = homogeneous_stresses(self.scene, u, theta)
        P = gripped_stresses(self.scene, P, theta) if self.shares is None else added(P, self.shares)
        return jax.vmap(self._components)(H, P)

    def _components(self, H: jax.Array, P: jax.Array) -> jax.Array:
        """Return the observed components (c,) from the stress (3, 3) of a state."""
        F = H + jnp.eye(3)
        J = determinant(F)
        of_measure = {"stress": P, "cauchy": P @ F.T / J, "second": cofactor(F).T @ P / J}
        numbers = []
        for component in self.components:
            measure, row, column = _parts(component)
            numbers.append(of_measure[measure][row, column])
        return jnp.stack(numbers)

    @classmethod
    def tables(cls, words: Collection[str]) -> dict[str, Table]:
        """Return the table of the columns of motions and stresses; of one each as an example."""
        given = [word for word in words if is_stress(word)]
        areas = [w for w in words if given and _AREA.fullmatch(with_unit(w)[0])]
        columns = [*(motion_columns(words) or ["stretch_x"]), *(given or ["stress_x"]), *areas]
        return {cls.name: Table((), tuple(Field(word, (word,)) for word in columns))}

    @classmethod
    def read(
        cls, scene: Scene, name: str, table: Table, arrays: Mapping[str, np.ndarray]
    ) -> tuple[Self, np.ndarray]:
        """Return the observation and its data in kPa, of the states that the scene has."""
        expected = states_of(scene)
        found = states({w: arrays[w] for w in motion_columns(arrays)}, ordered=False)
        if len(found.free) != len(expected.free):
            raise InputError(
                f"{len(found.free)} rows say how the specimen moves; scene '{scene.name}' has "
                f"{len(expected.free)} states"
            )
        same = np.abs(found.gradients - expected.gradients).max(axis=(1, 2)) <= _ROUND_OFF
        other = np.flatnonzero(~same | (found.free != expected.free).any(axis=1))
        if len(other):
            raise InputError(
                f"row {other[0] + 1} moves otherwise than the state of scene '{scene.name}'"
            )
        columns = _in_kpa(arrays)
        part = cls(scene, tuple(columns))
        values = np.column_stack(list(columns.values()))
        part._check_signs(values)
        return part, values

    def _check_signs(self, values: np.ndarray) -> None:
        """Refuse a driven component that does negative work along the way from rest.

        One that moves less than a third of the largest may contract while it is pulled.
        """
        gradients = states_of(self.scene).gradients
        driven = np.abs(gradients).max() / 3.0
        for k, component in enumerate(self.components):
            _, row, column = _parts(component)
            motion = gradients[:, row, column]
            if np.nansum(values[:, k] * motion) < 0.0 and np.abs(motion).max() > driven:
                raise InputError(
                    f"column '{component}' pulls against the motion: is its sign right, or "
                    f"its axis? ({np.nanmin(values[:, k]):.3g} to {np.nanmax(values[:, k]):.3g} "
                    "kPa)"
                )

    def block(self, name: str, values: np.ndarray) -> Block:
        """Return the motion of each state, and the stresses."""
        given = states_of(self.scene)
        arrays = {f"stretch_{a}": self.stretches[:, k] for k, a in enumerate(AXES)}
        arrays |= {
            f"shear_{a}{b}": given.gradients[:, i, j]
            for i, a in enumerate(AXES)
            for j, b in enumerate(AXES)
            if i != j
        }
        moved = {word: x for word, x in arrays.items() if np.nan_to_num(x).any()}
        of_stress = dict(zip(self.components, values.reshape(len(values), -1).T, strict=True))
        return [(Field(word, (word,)), x) for word, x in {**moved, **of_stress}.items()]


def is_stress(word: str) -> bool:
    """Return whether a column has stresses, or forces that become some."""
    name = with_unit(word)[0]
    return bool(_COMPONENT.fullmatch(name) or _PULL.fullmatch(name))


def _parts(component: str) -> tuple[str, int, int]:
    """Return the measure of a component, its row and its column."""
    found = _COMPONENT.fullmatch(component)
    assert found is not None
    measure, row, column = found.groups()
    return measure, AXES.index(row), AXES.index(column or row)


def _in_kpa(arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the stresses in kPa by component; forces are divided by their areas."""
    areas, columns = dict[str, np.ndarray](), dict[str, np.ndarray]()
    for word, values in arrays.items():
        name, unit = with_unit(word)
        if (found := _AREA.fullmatch(name)) is not None:
            areas[found[1]] = values * _factor(word, unit, "mm2", _IN_MM2)
    for word, values in arrays.items():
        name, unit = with_unit(word)
        if _COMPONENT.fullmatch(name) is not None:
            columns[name] = values * _factor(word, unit, "kPa", _IN_KPA)
        elif (found := _PULL.fullmatch(name)) is not None:
            if (area := areas.get(found[1])) is None:
                raise InputError(
                    f"column '{word}' is a force; give the area at rest as well, 'area{found[1]}'"
                )
            columns[f"stress{found[1]}"] = values * _factor(word, unit, "mN", _IN_MN) / area
    return columns


def _factor(word: str, unit: str, usual: str, known: Mapping[str, float]) -> float:
    """Return the factor from a column's unit, ``usual`` where it has none."""
    plain = unit.replace("²", "2").replace("^", "") or usual
    if plain not in known:
        raise InputError(f"column '{word}': unit '{unit}' is unknown; one of {', '.join(known)}")
    return known[plain]


stresses = Stress.of
