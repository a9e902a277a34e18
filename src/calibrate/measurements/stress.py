r"""Stresses of a specimen: the curves of a tensile, biaxial or shear test.

All measures follow from the first Piola-Kirchhoff stress P of a state of gradient F
(:func:`~emulator.specimens.homogeneous.homogeneous_stresses`) with what grips add to it
(:mod:`emulator.specimens.gripped`),

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
from collections.abc import Collection, Mapping
from copy import copy
from dataclasses import dataclass
from typing import Self

import jax
import jax.numpy as jnp
import numpy as np

from calibrate.measurements.observation import DataField, Layout, derive
from calibrate.measurements.specimens import Components
from emulator.core.errors import InputError
from emulator.core.units import IN_KPA, IN_MM2, IN_MN, factor, with_unit
from emulator.mechanics.kinematics import cofactor, determinant
from emulator.specimens.gripped import added, gripped_stresses
from emulator.specimens.homogeneous import homogeneous_stresses
from emulator.specimens.specimen import Specimen
from emulator.specimens.states import AXES, motion_columns, pull_columns

_COMPONENT = re.compile(r"(stress|cauchy|second)_([xyz])([xyz])?")
_PULL = re.compile(r"force(_[xyz][xyz]?)")
_AREA = re.compile(r"area(_[xyz][xyz]?)")


@dataclass(frozen=True, eq=False)
class Stress(Components):
    """Stresses (d, c) of ``components`` (c) in the d states of a specimen, in kPa.

    :class:`InputError` for a scene that is no specimen, or an unknown component.

    scene : the specimen.
    components : such as ``stress_x`` or ``cauchy_xy``.
    shares : what grips add, (d, 3, 3), in place of what the scene's grips have learned.
    """

    scene: Specimen
    components: tuple[str, ...]
    shares: jax.Array | None = None

    kind = "stress"
    hint = ", such as stress:stress_x,stress_y"
    name = "stress"
    quantity = "stress"
    pattern = _COMPONENT
    such_as = "give stress, cauchy or second with its plane, such as stress_x or stress_xy"
    unit = "kPa"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.scene.grips is not None and self.scene.grips.learned is not None:
            self._check_grips(self.scene.grips.learned.shares[0])

    def comparable(self, numbers: np.ndarray) -> np.ndarray:
        """Return first Piola-Kirchhoff stresses (d, 9), of normal components where J is 1."""
        P = np.full((len(numbers), 3, 3), np.nan)
        for c, component in enumerate(self.components):
            measure, row, column = _parts(component)
            stretch = self.stretches[:, row] if row == column else np.ones(len(numbers))
            by_measure = {"stress": 1.0, "cauchy": 1.0 / stretch, "second": stretch}
            first = P[:, row, column]
            P[:, row, column] = np.where(
                np.isnan(first), numbers[:, c] * by_measure[measure], first
            )
        return P.reshape(len(numbers), 9)

    def gripped(self, shares: np.ndarray) -> Self:
        """Return the stresses with those that grips add, see :func:`gripped_observations`.

        :class:`InputError` where a component acts on no grip.
        """
        self._check_grips(shares)
        part = copy(self)
        derive(part, shares=jnp.asarray(np.nan_to_num(shares)))
        return part

    def _check_grips(self, shares: np.ndarray) -> None:
        """Raise :class:`InputError` if a stress component is measured by no grip."""
        for component in self.components:
            _, row, column = _parts(component)
            if np.isnan(shares[:, row, column]).all():
                raise InputError(f"'{component}' acts on no grip of the piece")

    def _measured(self, u: jax.Array, theta: jax.Array) -> jax.Array:
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
    def layouts(cls, words: Collection[str]) -> dict[str, Layout]:
        """Return the layout of the columns of motions and stresses; of one each as an example."""
        stresses = [word for word in words if is_stress(word)]
        if not stresses and pull_columns(words):  # of measured stretches
            return {}
        areas = [w for w in words if stresses and _AREA.fullmatch(with_unit(w)[0])]
        columns = [*(motion_columns(words) or ["stretch_x"]), *(stresses or ["stress_x"]), *areas]
        return {cls.name: Layout((), tuple(DataField(word, (word,)) for word in columns))}

    @classmethod
    def read(
        cls, scene: Specimen, layout: Layout, arrays: Mapping[str, np.ndarray]
    ) -> tuple[Self, np.ndarray]:
        """Return the observation and its data in kPa, of the states that the scene has."""
        columns = _in_kpa(arrays)
        motions = {w: arrays[w] for w in motion_columns(arrays)}
        part = cls(scene, tuple(columns)).check_motion(motions)
        values = np.column_stack(list(columns.values()))
        part._check_signs(values)
        pulls = {axis: arrays[word] for axis, word in pull_columns(arrays).items()}
        for component, stress in columns.items():
            _, row, column = _parts(component)
            pull = pulls.get(AXES[row], np.nan)
            if row == column and not np.isnan(pull + stress).all():
                raise InputError(
                    f"column '{component}' is the stress of a direction that has 'applied_"
                    f"{AXES[row]}': what the machine applies is no data, leave the column out"
                )
        return part, values

    def _check_signs(self, values: np.ndarray) -> None:
        """Refuse a prescribed component that does negative work along the path from rest.

        One that moves less than a third of the largest may contract while it is pulled.
        """
        gradients = self.states.gradients
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


def is_stress(word: str) -> bool:
    """Return whether a column holds stresses, or forces that are divided by areas."""
    name = with_unit(word)[0]
    return bool(_COMPONENT.fullmatch(name) or _PULL.fullmatch(name))


def _parts(component: str) -> tuple[str, int, int]:
    """Return the measure of a component, its row and its column."""
    match = _COMPONENT.fullmatch(component)
    assert match is not None
    measure, row, column = match.groups()
    return measure, AXES.index(row), AXES.index(column or row)


def _in_kpa(arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the stresses in kPa by component; forces are divided by their areas."""
    areas, columns = dict[str, np.ndarray](), dict[str, tuple[str, np.ndarray]]()
    for word, values in arrays.items():
        name, unit = with_unit(word)
        if (match := _AREA.fullmatch(name)) is not None:
            areas[match[1]] = values * factor(word, unit, "mm2", IN_MM2)
    for word, values in arrays.items():
        name, unit = with_unit(word)
        if _COMPONENT.fullmatch(name) is not None:
            component, stress = name, values * factor(word, unit, "kPa", IN_KPA)
        elif (match := _PULL.fullmatch(name)) is not None:
            if (area := areas.get(match[1])) is None:
                raise InputError(
                    f"column '{word}' is a force; give the area at rest as well, 'area{match[1]}'"
                )
            component = f"stress{match[1]}"
            stress = values * factor(word, unit, "mN", IN_MN) / area
        else:
            continue
        for other, (source, known) in columns.items():
            both = ~np.isnan(known + stress)
            if _parts(other)[1:] == _parts(component)[1:] and both.any():
                raise InputError(
                    f"columns '{source}' and '{word}' both have a stress of row "
                    f"{both.argmax() + 1}, which would count twice: leave one out"
                )
        if component in columns:  # another test's, in another unit
            stress = np.where(np.isnan(stress), columns[component][1], stress)
        columns[component] = word, stress
    return {component: stress for component, (_, stress) in columns.items()}


stresses = Stress.of
