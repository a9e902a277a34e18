r"""Stretches of a specimen under load control, measured while stresses are prescribed.

Where a table has ``applied_x``, the machine pulls along x with this first Piola-Kirchhoff stress
(:mod:`emulator.specimens.states`), and the column ``stretch_x``, ``strain_x`` or ``green_x`` is
data: :math:`\lambda = F_{xx}` of the equilibrium. In states without a pull along x it is
prescribed, and the data are missing. Errors correlate along a test's curve by the way of the pull,
as a share of the test's largest.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Self

import jax
import jax.numpy as jnp
import numpy as np

from calibrate.measurements.observation import DataField, Layout
from calibrate.measurements.specimens import Components
from emulator.specimens.specimen import Specimen
from emulator.specimens.states import (
    APPLIED,
    AXES,
    components_of,
    motion_columns,
    pull_columns,
    stretch_columns,
)


@dataclass(frozen=True, eq=False)
class Stretch(Components):
    """Stretches (d, c) of ``components`` (c) in the d states of a specimen; 1 is at rest.

    :class:`InputError` for a scene that is no specimen, or an unknown component.

    scene : the specimen.
    components : such as ``stretch_x``.
    """

    scene: Specimen
    components: tuple[str, ...]

    kind = "stretches"
    hint = ", such as stretches:stretch_x,stretch_y"
    name = "stretch"
    quantity = "stretch"
    unit = "1"
    pattern = re.compile("stretch_([xyz])")
    such_as = "one of stretch_x, stretch_y, stretch_z"
    curve_axis = "way from the first state of each test, as a share of its largest pull"
    at_rest = 1.0
    usual_length = (0.3, "of a test's largest pull")

    @property
    def _axes(self) -> list[int]:
        """The numbers of the components' axes."""
        return [AXES.index(component[-1]) for component in self.components]

    def _measured(self, u: jax.Array, theta: jax.Array) -> jax.Array:
        diagonal = jnp.diagonal(self.scene.gradients(u), axis1=1, axis2=2)
        return 1.0 + diagonal[:, np.array(self._axes)]

    @classmethod
    def layouts(cls, words: Collection[str]) -> dict[str, Layout]:
        """Return the layout of the columns of motions and pulls; of one each as an example."""
        pulls, stretches = pull_columns(words), stretch_columns(words)
        columns = [*motion_columns(words), *([] if pulls else [f"{APPLIED}_x"])]
        columns += [] if stretches.keys() & pulls.keys() else [f"stretch_{min(pulls, default='x')}"]
        return {cls.name: Layout((), tuple(DataField(w, (w,)) for w in dict.fromkeys(columns)))}

    @classmethod
    def read(
        cls, scene: Specimen, layout: Layout, arrays: Mapping[str, np.ndarray]
    ) -> tuple[Self, np.ndarray]:
        """Return the observation and its data, NaN where the stretch is prescribed."""
        axes = sorted(pull_columns(arrays).keys() & stretch_columns(arrays).keys())
        part = cls(scene, tuple(f"stretch_{axis}" for axis in axes)).check_motion(arrays)
        H, pulls = components_of(arrays)
        stretches = 1.0 + np.where(np.isnan(pulls), np.nan, np.diagonal(H, axis1=1, axis2=2))
        return part, stretches[:, part._axes]

    @property
    def _pulls(self) -> list[str]:
        return [f"{APPLIED}_{component[-1]}" for component in self.components]


stretches = Stretch.of
