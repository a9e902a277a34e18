"""Outputs of an external solver as observations; each is called as in the problem's file."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import jax

from calibrate.measurements.observation import DataField, Layout, Observation, derive
from emulator.external.problem import ExternalProblem, Output


@dataclass(frozen=True, eq=False)
class ExternalOutput(Observation):
    """One output (size,), or () of one number, of an external problem.

    scene : the problem.
    """

    scene: ExternalProblem

    output: ClassVar[Output]
    arguments = ()
    positive = False

    def __post_init__(self) -> None:
        derive(self, nodes=self.scene.places[self.kind], unit=self.output.unit or "1")

    @property
    def shape(self) -> tuple[int, ...]:
        """The shape of the data."""
        return () if self.output.size == 1 else (self.output.size,)

    def evaluate(self, displacement: jax.Array, theta: jax.Array) -> jax.Array:  # noqa: ARG002
        """Return the numbers (..., *shape), the first column of their rows."""
        numbers = displacement[..., 0]
        return numbers if self.shape else numbers[..., 0]

    @classmethod
    def of(cls, scene: Any, *arguments: Any, **options: Any) -> Self:  # noqa: ARG003
        """Return the output of ``scene``."""
        return cls(scene)

    @classmethod
    def layouts(cls, words: Collection[str]) -> dict[str, Layout]:
        """Return the layout of its columns, if any of them is there."""
        if not set(words) & {cls.kind, *cls.output.columns}:
            return {}
        return {cls.kind: Layout((), (DataField(cls.kind, cls.output.columns),))}


def kinds_of_outputs(scene: ExternalProblem) -> dict[str, type[Observation]]:
    """Return a kind of observation for each output of a problem, by its name."""
    return {
        output.name: type(
            ExternalOutput.__name__,
            (ExternalOutput,),
            {"kind": output.name, "quantity": output.name, "output": output},
        )
        for output in scene.outputs
    }
