"""Finite elements as a forward map."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import cached_property

import jax
import jax.numpy as jnp
import numpy as np

from emulator.fem.campaign import Solver, solve_rows
from emulator.fem.simulator import Simulator
from emulator.scenes.scene import Scene
from emulator.store import to_json
from emulator.surrogates.kind import ForwardKind
from emulator.surrogates.protocol import (
    ForwardMap,
    Prediction,
    all_nodes,
    check_nodes,
    fingerprint_of,
)


@dataclass(frozen=True, eq=False)
class FEMForward:
    """The simulator as a forward map; Newton begins at ``start(theta)``, or at rest if ``None``."""

    simulator: Simulator
    nodes: np.ndarray
    start: ForwardMap | None = None

    kind = "fem"
    label = "FEM"

    @cached_property
    def scene(self) -> Scene:
        """The scene that is simulated."""
        return self.simulator.scene

    @cached_property
    def fingerprint(self) -> str:
        """Short hash of scene, solver options and nodes; ``start`` only affects the time taken."""
        options = to_json(asdict(self.simulator.options))
        return fingerprint_of(self.kind, self.scene.fingerprint, options, self.nodes)

    def evaluate(self, theta: jax.Array) -> Prediction:
        """Displacement (k, 3) in mm and whether the solve converged."""
        start = None if self.start is None else self.start(theta)
        solution = self.simulator.solve(theta, start)
        return Prediction(solution.displacement[self.nodes], solution.converged)

    def evaluate_all(self, thetas: jax.Array) -> Prediction:
        """Predictions at many theta (c, p), one after the other."""
        solver = Solver(self.simulator, from_rest_again=False)
        starts = (lambda _: ()) if self.start is None else (lambda theta: (self.start(theta),))
        rows = [row.solution for row in solve_rows(solver, thetas, starts=starts)]
        return Prediction(
            jnp.stack([solution.displacement[self.nodes] for solution in rows]),
            jnp.stack([solution.converged for solution in rows]),
        )

    def __call__(self, theta: jax.Array) -> jax.Array:
        """Displacement (k, 3) in mm."""
        return self.evaluate(theta).displacement

    def at(self, nodes: np.ndarray) -> FEMForward:
        """The same simulator, returning only ``nodes``."""
        return FEMForward(self.simulator, check_nodes(self.scene, nodes), self.start)


def fem_forward(simulator: Simulator, start: ForwardMap | None = None) -> FEMForward:
    """The simulator as a forward map over all nodes; ``start`` predicts where Newton begins."""
    return FEMForward(simulator, all_nodes(simulator.scene), start)


FEM = ForwardKind(
    "fem", "finite elements, from rest each time", lambda made_of, _: fem_forward(made_of.simulator)
)
