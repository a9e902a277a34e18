r"""Stresses of a specimen: the curves of a tensile, biaxial or shear test.

The stress P is that of the law less a pressure, at which nothing pulls along the last free
direction l of a state with gradient F,

.. math::
    P = \frac{\partial W}{\partial F} - p \operatorname{cof} F, \qquad
    p = \frac{\partial W}{\partial F_{ll}} \Big/ \operatorname{cof}(F)_{ll}, \qquad
    \sigma = P F^T / J, \qquad S = F^{-1} P .

The pressure vanishes where a compressible specimen is in equilibrium, and is the unknown of an
incompressible one.

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
from emulator.fem.energy import point_energy
from emulator.mechanics.kinematics import cofactor, determinant
from emulator.scenes.scene import Scene, all_nodes
from emulator.scenes.specimen import AXES, motion_columns, states, states_of, with_unit

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
    """

    scene: Scene
    components: tuple[str, ...]

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
        gradients, paths = states_of(self.scene).gradients, np.zeros((len(self.stretches), 3))
        for number, rows in enumerate(self.tests.values()):
            steps = np.linalg.norm(np.diff(gradients[rows], axis=0), axis=(1, 2))
            paths[rows, 0] = np.concatenate([[0.0], np.cumsum(steps)])
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

    def rows(self) -> tuple[str, np.ndarray]:
        """Return the numbers of the states."""
        return "state", np.arange(len(self.stretches))

    def evaluate(self, displacement: jax.Array, theta: jax.Array) -> jax.Array:
        """Return stresses (..., d, c) in kPa."""
        return jnp.vectorize(self._stresses, signature="(k,i),(p)->(d,c)")(displacement, theta)

    def _stresses(self, u: jax.Array, theta: jax.Array) -> jax.Array:
        elements, free = self.scene.mesh.elements, states_of(self.scene).free
        H = jnp.swapaxes(u[elements[:, 1:]] - u[elements[:, :1]], 1, 2)
        tissue = jax.tree.map(lambda each: each[:, 0], self.scene.tissue_at(theta))
        law_stress = jax.vmap(jax.grad(point_energy(self.scene, theta)))(H, tissue)
        last = np.where(free.any(axis=1), 2 - np.argmax(free[:, ::-1], axis=1), 3)
        return jax.vmap(self._components)(H, law_stress, jnp.asarray(last))

    def _components(self, H: jax.Array, stress: jax.Array, last: jax.Array) -> jax.Array:
        """Return the observed components (c,) from the law's stress dW/dF (3, 3) of a state.

        last : the axis of the last free direction; 3 where there is none.
        """
        F, free = H + jnp.eye(3), jnp.arange(3) == last
        cofactors = cofactor(F)
        along = jnp.where(free, jnp.diagonal(cofactors), 1.0)
        pressure = jnp.sum(jnp.where(free, jnp.diagonal(stress) / along, 0.0))
        P, J = stress - pressure * cofactors, determinant(F)
        of_measure = {"stress": P, "cauchy": P @ F.T / J, "second": cofactors.T @ P / J}
        numbers = []
        for component in self.components:
            measure, row, column = _parts(component)
            numbers.append(of_measure[measure][row, column])
        return jnp.stack(numbers)

    @classmethod
    def tables(cls, words: Collection[str]) -> dict[str, Table]:
        """Return the table of the columns of motions and stresses; of one each as an example."""
        names = {word: with_unit(word)[0] for word in words}
        given = [w for w, n in names.items() if _COMPONENT.fullmatch(n) or _PULL.fullmatch(n)]
        areas = [w for w, n in names.items() if given and _AREA.fullmatch(n)]
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
