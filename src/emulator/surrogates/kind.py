"""A kind of forward map: its name, its options, how it is built, kept and restored.

Each kind is one :class:`ForwardKind` beside its map, and one line in
:mod:`emulator.surrogates.registry`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from emulator.core.errors import InputError
from emulator.fem.simulator import Simulator
from emulator.scenes.scene import Scene
from emulator.surrogates.protocol import Extrapolated, ForwardMap

Options = Mapping[str, int]
Arrays = Mapping[str, np.ndarray]


@dataclass(frozen=True)
class Option:
    """A whole number that a kind of forward map is built with.

    name : in Python and in files, e.g. ``fem_runs``; ``--fem-runs`` on the command line.
    least : smallest value allowed.
    """

    name: str
    default: int
    help: str
    least: int = 1

    @property
    def flag(self) -> str:
        """The option on the command line."""
        return f"--{self.name.replace('_', '-')}"

    def checked(self, value: Any) -> int:
        """``value``, or :class:`InputError` unless it is a whole number large enough."""
        if isinstance(value, bool) or not isinstance(value, int):
            raise InputError(f"{self.name} is {value!r}; it must be a whole number")
        if value < self.least:
            raise InputError(f"{self.name} is {value}; it must be {self.least} or more")
        return value


@dataclass(frozen=True)
class Ingredients:
    """What forward maps are built from.

    scene, simulator : the scene and its FEM simulator.
    emulator : shipped name or folder; ``None`` stands for the emulator shipped for the scene.
    seed : of the design of FEM runs.
    extrapolate : build a map that also answers outside the box, to measure its error there.
    """

    scene: Scene
    simulator: Simulator
    emulator: str | None = None
    seed: int = 0
    extrapolate: bool = False
    progress: bool = False

    def ranged(self, forward: ForwardMap) -> ForwardMap:
        """``forward``, which is valid in the box only, extrapolated if that was asked for."""
        return Extrapolated(forward) if self.extrapolate else forward


@dataclass(frozen=True)
class ForwardKind:
    """A kind of forward map.

    build : the map over all nodes, from ingredients and a value of every option.
    to_arrays, from_arrays : of a kind that is fitted while it is built, so that a second build
        need not give the first one's map; its arrays are then kept with results.
        ``from_arrays`` raises ``KeyError`` where one is missing. ``None`` for a kind that reads
        what it needs from elsewhere.
    from_emulator : whether an emulator is one of its ingredients.
    solves_fem : whether a prediction is a FEM solve, which workers of a cluster can do.
    """

    name: str
    help: str
    build: Callable[[Ingredients, Options], ForwardMap]
    options: tuple[Option, ...] = ()
    to_arrays: Callable[[ForwardMap], Arrays] | None = None
    from_arrays: Callable[[Scene, Arrays], ForwardMap] | None = None
    from_emulator: bool = False
    solves_fem: bool = False
