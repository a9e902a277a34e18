"""Finite elements as a forward map."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.errors import InputError
from emulator.core.store import to_json
from emulator.fem.campaign import Row, Solver, solve_rows
from emulator.fem.solution import EquilibriumSolver
from emulator.scenes.forward_problem import ForwardProblem
from emulator.scenes.scene import all_nodes, check_nodes
from emulator.surrogates.protocol import ForwardKind, ForwardMap, Prediction, fingerprint_of


@dataclass(frozen=True, eq=False)
class FEMForward:
    """The simulator as a forward map: several theta are solved at once, by threads.

    All other maps are compiled and differentiated by JAX.

    simulator, nodes : the simulator, and the nodes (k,) whose displacement is returned.
    start : the map that predicts where Newton's method begins; ``None`` for the body at rest.
    """

    simulator: EquilibriumSolver
    nodes: np.ndarray
    start: ForwardMap | None = None

    kind = "fem"
    label = "FEM"

    @cached_property
    def scene(self) -> ForwardProblem:
        """The scene or the history that is simulated."""
        return self.simulator.scene

    @cached_property
    def fingerprint(self) -> str:
        """Short hash of scene, solver options and nodes; ``start`` only affects the time taken."""
        options = to_json(asdict(cast(Any, self.simulator).options))
        return fingerprint_of(self.kind, self.scene.fingerprint, options, self.nodes)

    def evaluate(self, theta: jax.Array) -> Prediction:
        """Return the displacement (k, 3) mm, and whether the solve converged."""
        start = None if self.start is None else self.start(theta)
        solution = self.simulator.solve(theta, start)
        return Prediction(solution.displacement[self.nodes], solution.converged)

    def evaluate_all(self, thetas: jax.Array) -> Prediction:
        """Return the predictions at many theta (c, p)."""
        return self._solved(thetas)[0]

    def slopes_all(self, thetas: jax.Array) -> tuple[Prediction, jax.Array]:
        """Return the predictions at many theta (c, p), and du/dtheta (c, p, k, 3)."""
        prediction, rows = self._solved(thetas, sensitivities=True)
        return prediction, jnp.stack([row.sensitivities[:, self.nodes] for row in rows])

    def _solved(
        self, thetas: jax.Array, *, sensitivities: bool = False
    ) -> tuple[Prediction, list[Row]]:
        solver = Solver(self.simulator, sensitivities=sensitivities)
        start = self.start
        starts = (lambda _: ()) if start is None else (lambda number: (start(thetas[number]),))
        solved = solve_rows(solver, thetas, starts=starts)
        rows = sorted(solved, key=lambda row: row.number)
        u = jnp.stack([row.solution.displacement[self.nodes] for row in rows])
        return Prediction(u, jnp.stack([row.solution.converged for row in rows])), rows

    def __call__(self, theta: jax.Array) -> jax.Array:
        """Return the displacement (k, 3) mm."""
        return self.evaluate(theta).displacement

    def at(self, nodes: np.ndarray) -> FEMForward:
        """Return the same map over other ``nodes``."""
        return replace(self, nodes=check_nodes(self.scene, nodes))


def fem_forward(simulator: EquilibriumSolver, start: ForwardMap | None = None) -> FEMForward:
    """Return the simulator as a forward map over all nodes; ``start`` predicts its starts."""
    return FEMForward(simulator, all_nodes(simulator.scene), start)


def by_solver(solver: EquilibriumSolver, start: ForwardMap | None = None) -> ForwardMap:
    """Return ``solver`` as a forward map over all nodes; that of a specimen is one already.

    :class:`InputError` for another program, through which a sampler cannot differentiate.
    """
    if solver.scene.outside:
        raise InputError(
            f"forward map 'fem': '{solver.scene.name}' is {solver.scene.noun}, and a sampler needs "
            "derivatives within its steps; leave --forward out, and runs of it teach a map"
        )
    return cast(ForwardMap, solver) if hasattr(solver, "at") else fem_forward(solver, start)


FEM = ForwardKind(
    "fem",
    "finite elements, from rest each time",
    lambda ingredients, _: by_solver(ingredients.simulator),
    anywhere=True,
)
