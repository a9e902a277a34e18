"""Finite elements as a forward map."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from functools import cached_property

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.store import to_json
from emulator.fem.campaign import Executor, Row, Solver, in_process, solve_rows
from emulator.fem.simulator import Simulator
from emulator.scenes.scene import Scene, all_nodes, check_nodes
from emulator.surrogates.protocol import (
    ForwardKind,
    ForwardMap,
    Prediction,
    SolvingMap,
    fingerprint_of,
)


@dataclass(frozen=True, eq=False)
class FEMForward(SolvingMap):
    """The simulator as a forward map.

    simulator, nodes : the simulator, and the nodes (k,) whose displacement is returned.
    start : the map that predicts where Newton's method begins; ``None`` for the body at rest.
    execute : the executor that solves at many theta; by default in this process.
    """

    simulator: Simulator
    nodes: np.ndarray
    start: ForwardMap | None = None
    execute: Executor = in_process

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
        """Return the displacement (k, 3) mm, and whether the solve converged."""
        start = None if self.start is None else self.start(theta)
        solution = self.simulator.solve(theta, start)
        return Prediction(solution.displacement[self.nodes], solution.converged)

    def evaluate_all(self, thetas: jax.Array) -> Prediction:
        """Return the predictions at many theta (c, p), which ``execute`` solves."""
        return self._predicted(self._rows(thetas))

    def slopes_all(self, thetas: jax.Array) -> tuple[Prediction, jax.Array]:
        """Return the predictions at many theta (c, p), and du/dtheta (c, p, k, 3)."""
        rows = self._rows(thetas, sensitivities=True)
        slopes = jnp.stack([row.sensitivities[:, self.nodes] for row in rows])
        return self._predicted(rows), slopes

    def _predicted(self, rows: list[Row]) -> Prediction:
        return Prediction(
            jnp.stack([row.solution.displacement[self.nodes] for row in rows]),
            jnp.stack([row.solution.converged for row in rows]),
        )

    def _rows(self, thetas: jax.Array, *, sensitivities: bool = False) -> list[Row]:
        solver = Solver(self.simulator, sensitivities=sensitivities, from_rest_again=False)
        start = self.start
        starts = (lambda _: ()) if start is None else (lambda number: (start(thetas[number]),))
        rows = solve_rows(solver, thetas, starts=starts, execute=self.execute)
        return sorted(rows, key=lambda row: row.number)

    def __call__(self, theta: jax.Array) -> jax.Array:
        """Return the displacement (k, 3) mm."""
        return self.evaluate(theta).displacement

    def at(self, nodes: np.ndarray) -> FEMForward:
        """Return the same map over other ``nodes``."""
        return replace(self, nodes=check_nodes(self.scene, nodes))

    def solved_by(self, execute: Executor) -> FEMForward:
        """Return the same map, whose solves at many theta are done by ``execute``."""
        return replace(self, execute=execute)


def fem_forward(simulator: Simulator, start: ForwardMap | None = None) -> FEMForward:
    """Return the simulator as a forward map over all nodes; ``start`` predicts its starts."""
    return FEMForward(simulator, all_nodes(simulator.scene), start)


FEM = ForwardKind(
    "fem",
    "finite elements, from rest each time",
    lambda ingredients, _: fem_forward(ingredients.simulator),
    solves_fem=True,
)
