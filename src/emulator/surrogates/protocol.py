"""Forward maps: theta to displacement. Calibration sees nothing else of the mechanics.

A kind of forward map is one :class:`ForwardKind` next to its map, and one line in
:mod:`emulator.surrogates.registry`.
"""

from __future__ import annotations

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.errors import InputError
from emulator.fem.campaign import Executor
from emulator.fem.simulator import Simulator
from emulator.scenes.scene import Scene, check_nodes


class Prediction(NamedTuple):
    """The displacement (k, 3) mm at a forward map's nodes, and whether it is valid, () bool."""

    displacement: jax.Array
    valid: jax.Array


class ForwardMap(Protocol):
    """Theta to displacement, differentiable, usable under ``jit`` and ``vmap``."""

    @property
    def kind(self) -> str:
        """Name of its kind, e.g. ``emulator`` or ``fem``."""
        ...

    @property
    def label(self) -> str:
        """The name in pictures and tables, e.g. ``emulator + 2 Newton steps``."""
        ...

    @property
    def scene(self) -> Scene:
        """The scene whose displacement it predicts."""
        ...

    @property
    def nodes(self) -> np.ndarray:
        """Nodes at which it predicts, (k,), in the order of its rows."""
        ...

    @property
    def fingerprint(self) -> str:
        """Short hash of everything that shapes the prediction (:func:`fingerprint_of`)."""
        ...

    def __call__(self, theta: jax.Array) -> jax.Array:
        """Return the displacement (k, 3) mm at ``theta`` (p,)."""
        ...

    def evaluate(self, theta: jax.Array) -> Prediction:
        """Return the displacement (k, 3) mm at ``theta`` (p,), and whether it is valid."""
        ...

    def at(self, nodes: np.ndarray) -> ForwardMap:
        """Return the map restricted to ``nodes``; a fast map then computes only those."""
        ...


class SolvingMap(ABC):
    """A forward map whose predictions are FEM solves, driven from Python or done by a cluster.

    All other maps are compiled and differentiated by JAX.
    """

    @abstractmethod
    def evaluate_all(self, thetas: jax.Array) -> Prediction:
        """Return the predictions at many theta (c, p); fields gain a leading axis."""

    @abstractmethod
    def slopes_all(self, thetas: jax.Array) -> tuple[Prediction, jax.Array]:
        """Return the predictions at many theta (c, p), and du/dtheta (c, p, k, 3)."""

    @abstractmethod
    def solved_by(self, execute: Executor) -> ForwardMap:
        """Return the same map with its solves at many theta done by ``execute``."""


_AT_ONCE = 64  # theta in one batch


def evaluator(forward: ForwardMap) -> Callable[[jax.Array], Prediction]:
    """Return the function from theta (c, p) to predictions; its first call compiles it."""
    if isinstance(forward, SolvingMap):
        return forward.evaluate_all
    return jax.jit(lambda t: jax.lax.map(forward.evaluate, t, batch_size=_AT_ONCE))


def evaluate_all(forward: ForwardMap, thetas: jax.Array) -> Prediction:
    """Return the predictions at many theta (c, p); fields gain a leading axis."""
    return evaluator(forward)(thetas)


def require_answers(forward: ForwardMap, prediction: Prediction, what: str) -> None:
    """Raise :class:`InputError` where a prediction is not valid; ``what`` begins the message."""
    invalid = ~np.asarray(prediction.valid)
    if invalid.any():
        raise InputError(
            f"{what}: {forward.label} has no answer at {invalid.sum()} of {len(invalid)} theta"
        )


def solved_by(forward: ForwardMap, execute: Executor) -> ForwardMap:
    """Return ``forward`` with its solves at many theta done by ``execute``.

    Raises
    ------
    InputError
        A map that solves nothing.
    """
    if not isinstance(forward, SolvingMap):
        raise InputError(
            f"a {forward.kind} map solves no FEM, so a scheduler has no effect; take fem_forward, "
            "or leave the scheduler out"
        )
    return forward.solved_by(execute)


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


@dataclass(frozen=True, eq=False)
class Extrapolated:
    """The map ``base`` without the limits of its box: valid wherever its displacement is finite.

    It measures how the error grows outside the box; a density must not use it.
    """

    base: ForwardMap

    @property
    def kind(self) -> str:
        """Kind of ``base``."""
        return self.base.kind

    @property
    def label(self) -> str:
        """Label of ``base``."""
        return self.base.label

    @property
    def scene(self) -> Scene:
        """The scene whose displacement ``base`` predicts."""
        return self.base.scene

    @property
    def nodes(self) -> np.ndarray:
        """Nodes at which it predicts, (k,)."""
        return self.base.nodes

    @property
    def fingerprint(self) -> str:
        """Short hash of ``base`` and of its use outside the box."""
        return fingerprint_of("extrapolated", self.base.fingerprint)

    def __call__(self, theta: jax.Array) -> jax.Array:
        """Return the displacement (k, 3) mm."""
        return self.base(theta)

    def evaluate(self, theta: jax.Array) -> Prediction:
        """Return the displacement (k, 3) mm, and whether it is finite."""
        u = self.base(theta)
        return Prediction(u, jnp.all(jnp.isfinite(u)))

    def at(self, nodes: np.ndarray) -> Extrapolated:
        """Return the extrapolated map restricted to ``nodes``."""
        return Extrapolated(self.base.at(nodes))


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

    scene, simulator : the scene and its FEM simulator.
    emulator : a shipped name or a folder; ``None`` for the emulator shipped for the scene.
    seed : the seed of the design of FEM runs.
    extrapolate : whether the map also answers outside the box, to measure its error there.
    progress : whether progress bars are shown.
    """

    scene: Scene
    simulator: Simulator
    emulator: str | None = None
    seed: int = 0
    extrapolate: bool = False
    progress: bool = False

    def ranged(self, forward: ForwardMap) -> ForwardMap:
        """Return ``forward``, extrapolated beyond the box if that is asked for."""
        return Extrapolated(forward) if self.extrapolate else forward


@dataclass(frozen=True)
class ForwardKind:
    """A kind of forward map.

    name, help : the name, and the words of the command line.
    build : the function from ingredients and a value of every option to the map over all nodes.
    options : the options of ``build``.
    to_arrays, from_arrays : write and read the arrays of a map that is fitted while it is built,
        because a second fit may give another map; they are kept with results. ``from_arrays``
        raises ``KeyError`` where one is missing. ``None`` for a kind that is not fitted.
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
