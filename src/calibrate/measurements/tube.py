r"""Measurements of a tube: the pressure inside, and the force along it.

Both are integrals of the wall's stresses (:mod:`emulator.specimens.tube`), with
:math:`\hat\sigma = P F^T / J`. Columns are ``pressure`` and ``force_axial``, the force besides that
of the pressure on closed ends; units as in ``pressure [mmHg]``, kPa and mN without one.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import jax
import jax.numpy as jnp
import numpy as np

from calibrate.measurements.observation import DataField, Layout
from calibrate.measurements.specimens import SpecimenCurves
from emulator.core.errors import InputError
from emulator.core.units import IN_KPA, IN_MN, factor, with_unit
from emulator.mechanics.kinematics import determinant
from emulator.specimens.homogeneous import homogeneous_stresses
from emulator.specimens.specimen import Specimen
from emulator.specimens.tube import Tube, motion_columns


@dataclass(frozen=True, eq=False)
class OfTube(SpecimenCurves):
    """One number (d,) for each state of a tube.

    A kind declares the ``column`` of its table with the ``units``, and the ``integral`` of the
    tube over its wall.
    """

    scene: Specimen

    column: ClassVar[str]
    units: ClassVar[Mapping[str, float]]
    integral: ClassVar[Callable[[Tube, jax.Array, jax.Array], jax.Array]]
    components = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.scene.tube is None:
            raise InputError(f"scene '{self.scene.name}' is no tube, which has a {self.column}")

    def _measured(self, u: jax.Array, theta: jax.Array) -> jax.Array:
        H, P = homogeneous_stresses(self.scene, u, theta)
        F = H + jnp.eye(3)
        cauchy = jax.vmap(lambda P, F: P @ F.T / determinant(F))(P, F)
        assert self.scene.tube is not None
        in_plane = (jnp.diagonal(tensor, axis1=1, axis2=2)[:, :2] for tensor in (F, cauchy))
        return type(self).integral(self.scene.tube, *in_plane)

    @classmethod
    def layouts(cls, words: Collection[str]) -> dict[str, Layout]:
        """Return the layout of the columns of motion and of the number; none without motion."""
        motion = motion_columns(words)
        if not motion and cls.name not in words:  # a column 'pressure' may be of another file
            return {}
        number, *more = [w for w in words if with_unit(w)[0] == cls.column] or [cls.column]
        if more:
            raise InputError(
                f"columns {', '.join([number, *more])}: each is the {cls.column} of a row; leave "
                "one"
            )
        columns = [*(motion or ["outer_radius", "stretch_axial"]), number]
        fields = [DataField(word, (word,), where=word != number) for word in columns]
        return {cls.name: Layout((), tuple(fields))}

    @classmethod
    def values_in(cls, *selection: Any) -> tuple[DataField, ...]:
        """Return the field of the number."""
        return (DataField(cls.column, (cls.column,)),)

    @classmethod
    def read(
        cls, scene: Specimen, layout: Layout, arrays: Mapping[str, np.ndarray]
    ) -> tuple[Self, np.ndarray]:
        """Return the observation and its data, of the states that the scene has."""
        *_, measured = layout.fields
        part = cls(scene).check_motion({w: arrays[w] for w in motion_columns(arrays)})
        word = measured.variable
        values = arrays[word] * factor(word, with_unit(word)[1], cls.unit, cls.units)
        return part, values


class TubePressure(OfTube):
    """Pressures (d,) in kPa inside a tube, in each of its states."""

    kind = name = "tube_pressure"
    quantity = "pressure"
    column = "pressure"
    unit = "kPa"
    units = IN_KPA
    integral = Tube.pressure


class TubeForce(OfTube):
    """Reduced axial forces (d,) in mN of a tube, in each of its states."""

    kind = name = "tube_force"
    quantity = "force"
    column = "force_axial"
    unit = "mN"
    units = IN_MN
    integral = Tube.axial_force
