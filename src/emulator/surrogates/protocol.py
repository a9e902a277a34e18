"""Forward maps: theta to displacement. Calibration sees nothing else of the mechanics."""

from __future__ import annotations

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.errors import InputError
from emulator.fem.campaign import Executor
from emulator.scenes.scene import Scene, check_nodes


class Prediction(NamedTuple):
    """Displacement (k, 3) in mm at a forward map's nodes, and whether it may be used, () bool."""

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
        """How pictures and tables call this map, e.g. ``emulator + 2 Newton steps``."""
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
        """Displacement (k, 3) in mm at ``theta`` (p,)."""
        ...

    def evaluate(self, theta: jax.Array) -> Prediction:
        """Displacement (k, 3) in mm at ``theta`` (p,) with its validity, for use in a density."""
        ...

    def at(self, nodes: np.ndarray) -> ForwardMap:
        """The map restricted to ``nodes``; a fast map then computes only those."""
        ...


class SolvingMap(ABC):
    """A forward map whose predictions are FEM solves, driven from Python or done by a cluster.

    All other maps are compiled and differentiated by JAX.
    """

    @abstractmethod
    def evaluate_all(self, thetas: jax.Array) -> Prediction:
        """Predictions at many theta (c, p); fields gain a leading axis."""

    @abstractmethod
    def slopes_all(self, thetas: jax.Array) -> tuple[Prediction, jax.Array]:
        """Predictions at many theta (c, p), and du/dtheta (c, p, k, 3)."""

    @abstractmethod
    def solved_by(self, execute: Executor) -> ForwardMap:
        """The same map with its solves at many theta done by ``execute``."""


_AT_ONCE = 64  # theta evaluated side by side


def evaluator(forward: ForwardMap) -> Callable[[jax.Array], Prediction]:
    """Predictions at many theta (c, p), by a program that is compiled when first called."""
    if isinstance(forward, SolvingMap):
        return forward.evaluate_all
    return jax.jit(lambda t: jax.lax.map(forward.evaluate, t, batch_size=_AT_ONCE))


def evaluate_all(forward: ForwardMap, thetas: jax.Array) -> Prediction:
    """Predictions at many theta (c, p); fields gain a leading axis."""
    return evaluator(forward)(thetas)


def require_answers(forward: ForwardMap, predicted: Prediction, what: str) -> None:
    """:class:`InputError` where one of many predictions is not valid; ``what`` begins its line."""
    invalid = ~np.asarray(predicted.valid)
    if invalid.any():
        raise InputError(
            f"{what}: {forward.label} has no answer at {invalid.sum()} of {len(invalid)} theta"
        )


def solved_by(forward: ForwardMap, execute: Executor) -> ForwardMap:
    """``forward`` with its solves at many theta done by ``execute``.

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
    """Short hash of words and arrays; shape and type of an array count as its values do."""
    digest = hashlib.sha256()
    for part in parts:
        if isinstance(part, str):
            digest.update(f"{len(part)}:{part}".encode())
        else:
            array = np.ascontiguousarray(part)
            digest.update(f"{array.dtype.str}{array.shape}".encode() + array.tobytes())
    return digest.hexdigest()[:16]


def inside_only(forward: ForwardMap, theta: jax.Array) -> Prediction:
    """``forward(theta)``, valid inside the box; outside it the value at the box's centre.

    A map fitted inside the box may be infinite outside it. ``jnp.where`` would still pass the
    gradient of that infinite branch on, as NaN, so the map is never evaluated there.
    """
    inside = forward.scene.space.contains(theta)
    safe = jnp.where(inside[..., None], theta, forward.scene.centre)
    return Prediction(forward(safe), inside)


@dataclass(frozen=True, eq=False)
class Extrapolated:
    """``base`` outside the box too: valid wherever its displacement is finite.

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
        """Displacement (k, 3) in mm."""
        return self.base(theta)

    def evaluate(self, theta: jax.Array) -> Prediction:
        """Displacement (k, 3) in mm, and whether it is finite."""
        u = self.base(theta)
        return Prediction(u, jnp.all(jnp.isfinite(u)))

    def at(self, nodes: np.ndarray) -> Extrapolated:
        """The extrapolated map restricted to ``nodes``."""
        return Extrapolated(self.base.at(nodes))


def rows_of(forward: ForwardMap, nodes: np.ndarray) -> np.ndarray:
    """Rows of ``forward`` that belong to ``nodes``; :class:`InputError` for a node it lacks."""
    nodes = check_nodes(forward.scene, nodes)
    position = {int(node): k for k, node in enumerate(forward.nodes)}
    missing = [int(node) for node in nodes if int(node) not in position]
    if missing:
        raise InputError(
            f"node {missing[0]} is not among the {len(position)} this {forward.kind} map returns"
        )
    return np.array([position[int(node)] for node in nodes])
