"""Observations of a body in time: what is seen of it, at every row of its history."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, Self

import jax
import jax.numpy as jnp
import numpy as np

from calibrate.measurements.displacements import Length
from calibrate.measurements.observation import Observation, derive
from calibrate.measurements.reaction import Reaction
from calibrate.measurements.volume import CavityVolume
from emulator.core.units import IN_MN
from emulator.fem.after_time import ForceThroughTime, force_through_time
from emulator.fem.history import BodyInTime


@dataclass(frozen=True, eq=False)
class AtEveryRow(Observation):
    """One number of a body at every row of its history, (m,).

    scene : the body in time.
    part : the observation of the body in one state.
    """

    scene: BodyInTime
    part: Observation

    curve_axis = "time (s)"
    of_body: ClassVar[type[Observation]]

    def __post_init__(self) -> None:
        first = self.scene.scene.node_count * np.arange(len(self.scene.times))
        derive(self, nodes=(first[:, None] + self.part.nodes).ravel(), unit=self.part.unit)
        derive(self, **{name: getattr(self.part, name) for name in self.arguments})

    @property
    def shape(self) -> tuple[int, ...]:
        """The number of rows."""
        return (len(self.scene.times),)

    def curves(self, entries: np.ndarray | None = None) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Return times (k,) in s, and rows (k,) of the data, by the name of their test.

        entries : the rows that were measured; all where it is None.
        """
        measured = np.arange(len(self.scene.times)) if entries is None else entries
        curves = {}
        for name, test in self.scene.tests.items():
            rows = np.flatnonzero(np.isin(measured, test))
            curves[name or self.kind] = self.scene.times[measured[rows]], rows
        return curves

    def evaluate(self, displacement: jax.Array, theta: jax.Array) -> jax.Array:
        """Return the numbers (..., m)."""
        by_row = self.scene.rows_of(displacement)
        thetas = jnp.vectorize(self.scene.thetas, signature="(p)->(m,q)")(theta)
        return self.part.evaluate(by_row, thetas)

    @classmethod
    def of(cls, scene: Any, *arguments: Any, **options: Any) -> Self:
        """Return the observation of ``scene`` that the arguments describe."""
        return cls(scene, cls.of_body.of(scene.scene, *arguments, **options))


@dataclass(frozen=True, eq=False)
class ForceAtEveryRow(AtEveryRow):
    """The force of a support of a body in time, which depends on where all of it has been."""

    part: Reaction
    force: ForceThroughTime = field(init=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        force = force_through_time(self.scene.scene, self.part.force)
        derive(self, nodes=np.arange(self.scene.node_count), force=force)

    def evaluate(self, displacement: jax.Array, theta: jax.Array) -> jax.Array:
        """Return the forces (..., m) in N."""

        def forces(u: jax.Array, theta: jax.Array) -> jax.Array:
            rows, thetas = self.scene.rows_of(u), self.scene.thetas(theta)
            forces = jnp.zeros(len(rows))
            for test in self.scene.tests.values():
                forces = forces.at[test].set(self.force(rows[test], thetas[test]))
            return forces / IN_MN["N"]

        return jnp.vectorize(forces, signature="(k,i),(p)->(m)")(displacement, theta)


_KINDS: dict[type[Observation], type[AtEveryRow]] = {
    CavityVolume: AtEveryRow,
    Length: AtEveryRow,
    Reaction: ForceAtEveryRow,
}


def kinds_in_time(_: BodyInTime) -> Mapping[str, type[Observation]]:
    """Return the kinds of observation of a body in time, by name."""
    declared = ("kind", "hint", "arguments", "kind_is_name", "quantity", "positive")
    return {
        kind.kind: type(
            base.__name__,
            (base,),
            {"of_body": kind} | {word: getattr(kind, word) for word in declared},
        )
        for kind, base in _KINDS.items()
    }
