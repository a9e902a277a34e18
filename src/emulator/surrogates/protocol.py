"""Forward maps: theta to displacement. Calibration sees nothing else of the mechanics.

A kind of forward map is one :class:`ForwardKind` next to its map, and one line in
:mod:`emulator.surrogates.registry`.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, cast

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.errors import InputError
from emulator.fem.simulator import Simulator
from emulator.fem.solution import EquilibriumSolver
from emulator.scenes.forward_problem import ForwardProblem
from emulator.scenes.scene import check_nodes, with_mesh


class Prediction(NamedTuple):
    """The displacement (k, 3) mm at a forward map's nodes, and whether it is valid, () bool."""

    displacement: jax.Array
    valid: jax.Array


class ForwardMap(Protocol):
    """Theta to displacement, differentiable, usable under ``jit`` and ``vmap``.

    kind, label : the names of its kind, e.g. ``corrected``, and of the map in pictures and tables,
        e.g. ``emulator + 2 Newton steps``.
    scene : the scene whose displacement it predicts, or the specimen.
    nodes : the nodes at which it predicts, (k,), in the order of its rows.
    fingerprint : a short hash of everything that shapes the prediction (:func:`fingerprint_of`).
    """

    @property
    def kind(self) -> str: ...  # noqa: D102

    @property
    def label(self) -> str: ...  # noqa: D102

    @property
    def scene(self) -> ForwardProblem: ...  # noqa: D102

    @property
    def nodes(self) -> np.ndarray: ...  # noqa: D102

    @property
    def fingerprint(self) -> str: ...  # noqa: D102

    def __call__(self, theta: jax.Array) -> jax.Array:
        """Return the displacement (k, 3) mm at ``theta`` (p,)."""
        ...

    def evaluate(self, theta: jax.Array) -> Prediction:
        """Return the displacement (k, 3) mm at ``theta`` (p,), and whether it is valid."""
        ...

    def at(self, nodes: np.ndarray) -> ForwardMap:
        """Return the map restricted to ``nodes``; a fast map then computes only those."""
        ...


def fingerprint_of(*parts: str | np.ndarray | jax.Array) -> str:
    """Return a short hash of words and arrays, of whose shapes and types, too."""
    digest = hashlib.sha256()
    for part in parts:
        if isinstance(part, str):
            digest.update(f"{len(part)}:{part}".encode())
        else:
            array = np.ascontiguousarray(part)
            digest.update(f"{array.dtype.str}{array.shape}".encode() + array.tobytes())
    return digest.hexdigest()[:16]


def inside_only(forward: ForwardMap, theta: jax.Array) -> Prediction:
    """Return ``forward(theta)``, valid inside the box; outside, the value at the centre.

    A map fitted inside the box may be infinite outside it. ``jnp.where`` would still pass the
    gradient of that infinite branch on, as NaN, so the map is never evaluated there.
    """
    inside = forward.scene.space.contains(theta)
    safe = jnp.where(inside[..., None], theta, forward.scene.centre)
    return Prediction(forward(safe), inside)


def rows_of(forward: ForwardMap, nodes: np.ndarray) -> np.ndarray:
    """Return the rows of ``forward`` that belong to ``nodes``; refuse a node that it lacks."""
    nodes = check_nodes(forward.scene, nodes)
    position = {int(node): k for k, node in enumerate(forward.nodes)}
    missing = [int(node) for node in nodes if int(node) not in position]
    if missing:
        raise InputError(
            f"node {missing[0]} is not among the {len(position)} this {forward.kind} map returns"
        )
    return np.array([position[int(node)] for node in nodes])


Options = Mapping[str, int]
Arrays = Mapping[str, np.ndarray]


@dataclass(frozen=True)
class Option:
    """A whole number that a kind of forward map is built with.

    name : the name in Python and in files, e.g. ``fem_runs``; ``--fem-runs`` on the command line.
    default, least : the default, and the smallest value allowed.
    help : the words of the command line.
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
        """Return ``value``; refuse one that is too small or no whole number."""
        if isinstance(value, bool) or not isinstance(value, int):
            raise InputError(f"{self.name} is {value!r}; it must be a whole number")
        if value < self.least:
            raise InputError(f"{self.name} is {value}; it must be {self.least} or more")
        return value


@dataclass(frozen=True)
class Ingredients:
    """The ingredients from which forward maps are built.

    scene, simulator : the scene or the specimen, and what solves it.
    emulator : a shipped name or a folder; ``None`` for the emulator shipped for the scene.
    seed : the seed of the design of FEM runs.
    progress : whether progress bars are shown.
    """

    scene: ForwardProblem
    simulator: EquilibriumSolver
    emulator: str | None = None
    seed: int = 0
    progress: bool = False

    @property
    def fem(self) -> Simulator:
        """The simulator of a scene; :class:`InputError` for a specimen, which has no mesh."""
        with_mesh(self.scene)
        return cast(Simulator, self.simulator)


@dataclass(frozen=True)
class ForwardKind:
    """A kind of forward map.

    name, help : the name, and the words of the command line.
    build : the function from ingredients and a value of every option to the map over all nodes.
    options : the options of ``build``.
    to_arrays, from_arrays : write and read the arrays of a map that is fitted while it is built,
        because a second fit may give another map; they are kept with results. ``from_arrays``
        raises ``KeyError`` where one is missing. ``None`` for a kind that is not fitted.
    words : the further words that have an effect: ``emulator`` where one is an ingredient.
    closer : words on the map to take where this one is too far from FEM; none for an exact one.
    anywhere : whether its maps answer outside of their scene's box, too.
    """

    name: str
    help: str
    build: Callable[[Ingredients, Options], ForwardMap]
    options: tuple[Option, ...] = ()
    to_arrays: Callable[[ForwardMap], Arrays] | None = None
    from_arrays: Callable[[Any, Arrays], ForwardMap] | None = None
    words: tuple[str, ...] = ()
    closer: str = (
        "--forward rounds (FEM where the posterior is) or corrected (or more of its --steps)"
    )
    anywhere: bool = False
