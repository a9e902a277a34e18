"""FEM of higher fidelity than a model's: on a finer mesh, or of a specimen between its grips."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, Protocol, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from calibrate.measurements import Observations
from calibrate.measurements.outputs import on_finer
from calibrate.statistical_model.model import Model
from emulator.accuracy.mesh_error import MeshError, MeshErrorEstimate, mesh_error
from emulator.core.rooms import offered
from emulator.fem import Simulator
from emulator.fem.campaign import at_once
from emulator.fem.linear.suitesparse import LARGE
from emulator.fem.solution import EquilibriumSolver
from emulator.scenes.scene import Scene

Known = Sequence[MeshErrorEstimate]


class MeshPair(NamedTuple):
    """Data (m,) without noise at one draw, all observations raveled.

    fine : of the FEM that is closer to the measurement.
    coarse : of the scene's own FEM.
    estimates : the fields of which others may start.
    """

    fine: np.ndarray
    coarse: np.ndarray
    estimates: Known = ()


class FinerFEM(Protocol):
    """FEM of higher fidelity than a model's simulator.

    of : the word for what is finer: ``mesh``, ``grips``, ``steps``, ``mesh and steps``.
    """

    @property
    def of(self) -> str: ...  # noqa: D102

    @property
    def nodes(self) -> int:
        """The number of nodes of its mesh."""
        ...

    @property
    def workers(self) -> int:
        """The number of draws that are solved at once."""
        ...

    def __call__(self, draw: Mapping[str, Any], known: Known = ()) -> MeshPair:
        """Return the data at ``draw``; :class:`SolverError` where FEM does not converge.

        known : fields of earlier draws, from which solves may start.
        """
        ...

    def forget(self) -> None:
        """Free what is kept between solves."""
        ...


def finer_fem(model: Model, simulator: EquilibriumSolver) -> FinerFEM:
    """Return the FEM of higher fidelity than the model's simulator.

    Raises
    ------
    InputError
        There is none: a specimen without grips, a finer mesh that is too large, a load that it
        cannot have, or an observation that says nothing of grips.
    """
    if not isinstance(simulator.scene, Scene):
        (of_problem,) = offered(*simulator.scene.refined_by.split(":"))
        finer: FinerFEM = of_problem(model, simulator)
        return finer
    error = mesh_error(cast(Simulator, simulator))
    return _OnFinerMesh(model, error, on_finer(error, model.observe))


def flat_data(observe: Observations, fields: Sequence[jax.Array], thetas: jax.Array) -> np.ndarray:
    """Return the data (m,) without noise, raveled, from a field (n, 3) mm of each load state."""
    seen = jnp.stack([u[observe.nodes] for u in fields])
    return np.asarray(ravel_pytree(observe(seen, thetas))[0])


@dataclass(frozen=True, eq=False)
class _OnFinerMesh:
    """FEM on the next finer mesh; ``observe`` are the model's observations there."""

    model: Model
    error: MeshError
    observe: Observations

    of = "mesh"

    @property
    def nodes(self) -> int:
        return len(self.error.finer.scene.mesh.nodes)

    @property
    def workers(self) -> int:
        # Large factorisations share the cores well, and each point is a good start of the next.
        return 1 if 3 * self.nodes >= LARGE else at_once(self.error.simulator, self.nodes)

    def __call__(self, draw: Mapping[str, Any], known: Known = ()) -> MeshPair:
        """Return the data; solves start from ``known`` and from the draw's earlier states."""
        thetas, estimates = self.model.states.thetas(draw), list[MeshErrorEstimate]()
        for theta in thetas:
            estimates.append(self.error(theta, self._start(theta), known=[*known, *estimates]))
        fine = flat_data(self.observe, [e.fine for e in estimates], thetas)
        coarse = flat_data(self.model.observe, [e.coarse for e in estimates], thetas)
        return MeshPair(fine, coarse, estimates)

    @cached_property
    def _start(self) -> Callable[[jax.Array], jax.Array]:
        return jax.jit(self.model.full)

    def forget(self) -> None:
        self.error.forget()
