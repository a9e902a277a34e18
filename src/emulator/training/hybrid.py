r"""Recipe ``hybrid``: a Taylor series, a network in mechanical modes, and a discrepancy model.

The network is trained on the energy. Its separable decoder is given modes that are computed from
mechanics: they span the series about the centre, and so the body's response to these parameters,
and they are orthonormal in the tangent there, :math:`\phi_j \cdot K_c\, \phi_k = \delta_{jk}`. In
their coefficients the potential energy is round near the centre, which keeps training on it from
leaving the soft modes behind. After some steps the modes are frozen and only the coefficients are
trained.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from emulator.fem import Simulator
from emulator.surrogates.emulator import Emulator
from emulator.surrogates.taylor import Expansion
from emulator.training.checkpoint import Record
from emulator.training.graph_network import BatchPlan, batch_training
from emulator.training.mechanics import add_discrepancy, series_and_runs
from emulator.training.network_plan import Problem, architecture_of, untrained
from emulator.training.objectives import Objective, component_scales
from emulator.training.optimiser import cosine
from emulator.training.plan import Job, check_order, check_runs

_SAMPLES = 400  # positions over which a mode's energy is averaged
_TRUNCATION = 1e-12  # least energy of a mode, relative to the largest
_STEP = 0.1  # unit of the network's output, over the rms of a mode's coefficient


@dataclass(frozen=True)
class Hybrid(BatchPlan):
    """A Taylor series, a network in mechanical modes, and a discrepancy model.

    order : the order of the series.
    modes : the largest number of mechanical modes given to the decoder.
    freeze : the step at which the modes are frozen.
    """

    recipe: str = "hybrid"
    objective: Objective = "energy"
    steps: int = 2000
    simulations: int = 200
    order: int = 3
    modes: int = 40
    freeze: int = 200
    needs_slopes: ClassVar[bool] = True

    def __post_init__(self) -> None:
        super().__post_init__()
        check_runs(self.simulations)
        check_order(self.order)

    @property
    def budget_share(self) -> float:
        """The share of a budget after which the last step ends."""
        return 0.85

    @property
    def most_steps(self) -> int | None:
        """The steps of the plan: the discrepancy model soon outdoes the network."""
        return self.steps

    def prepare(self, job: Job) -> Problem:
        """Return the FEM runs, and an emulator whose network is untrained."""
        scene, simulator = job.scene, Simulator(job.scene)
        modes = self.modes if self.order else 0
        architecture = architecture_of(self, job, "separable", modes=modes)
        series, runs = series_and_runs(job, simulator, self, self.order)
        plan = self.with_counts(simulations=len(runs.theta) - 1)
        scale = component_scales(scene, runs, from_runs=self.learns_from_runs)
        basis = (mechanical_modes(simulator, series, self.modes) / scale).astype(np.float32)
        emulator = untrained(plan, job, series, architecture, scale, basis)
        training = batch_training(emulator, plan, cosine(self.learning_rate), runs, self.freeze)
        return Problem(plan, emulator, runs, training)

    def complete(self, emulator: Emulator, problem: Problem) -> tuple[Emulator, Record]:
        """Return the emulator with a discrepancy model, and how it was chosen."""
        emulator, choice = add_discrepancy(emulator, problem.runs)
        return emulator, {"discrepancy": choice}


def mechanical_modes(simulator: Simulator, series: Expansion, most: int) -> np.ndarray:
    """Return modes (f, n, 3) mm, scaled so that coefficients of order 1 are typical.

    There are ``most`` of them or fewer, and none for a series of order 0.
    """
    count, shape = len(series.indices), series.displacement.shape
    if count == 0 or most == 0:
        return np.zeros((0, *shape))
    samples = np.random.default_rng(0).random((_SAMPLES, len(simulator.scene.parameters)))
    rms = np.sqrt(np.mean(np.asarray(series.monomials(jnp.asarray(samples))) ** 2, axis=0))
    fields = np.asarray(series.derivatives) * rms[:, None, None]
    energies, vectors = np.linalg.eigh(_energies(simulator, series, fields))
    order = np.argsort(energies)[::-1][:most]
    order = order[energies[order] > _TRUNCATION * energies.max()]
    # Scale each K_c-unit vector by the root of its energy, the rms of its coefficient.
    return _STEP * np.tensordot(vectors[:, order].T, fields, axes=1)


def _energies(simulator: Simulator, series: Expansion, fields: np.ndarray) -> np.ndarray:
    """Return the products (t, t) of ``fields`` (t, n, 3) in the tangent at the centre, mN mm."""
    system = simulator.system
    theta = simulator.scene.from_unit(jnp.asarray(series.centre))

    @jax.jit
    def tangent_times(field: jax.Array) -> jax.Array:
        residual = lambda u: system.residual(u, theta)  # noqa: E731
        return jax.jvp(residual, (series.displacement,), (field,))[1]

    forces = np.stack([np.asarray(tangent_times(jnp.asarray(field))) for field in fields])
    free = fields.reshape(len(fields), -1)[:, np.asarray(system.free)]
    products = free @ forces.T
    return 0.5 * (products + products.T)
