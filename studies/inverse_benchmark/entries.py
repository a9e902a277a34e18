"""Entries of our own and of outside samplers: a forward map, and what draws with it.

``entries/<entry>/<problem>.csv`` holds draws, ``entries/<entry>/entry.json`` what they took.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from studies.inverse_benchmark.problems import Problem, data_of, model, scene_of

import calibrate as cal
import emulator as em

ENTRIES = Path(__file__).parent / "entries"
KEPT = 500  # draws of an entry that are written
RUNS = 60  # FEM runs of the reduced model
GOOD = 200  # of the emulator
Draws = dict[str, np.ndarray]
Method = Callable[[cal.Model, Draws], tuple[Draws, int]]
"""``method(model, data)``: draws by name, and FEM solves of the sampler."""


@lru_cache
def emulator() -> tuple[em.ForwardMap, float, int]:
    """Series and discrepancy model of the benchmark's scene: the shipped one is of another mesh."""
    plan = replace(em.recipe("mechanics"), simulations=GOOD)
    with TemporaryDirectory() as folder:
        trained = em.train(scene_of(), plan, folder)
    return trained.cache(), trained.record["seconds"], GOOD + 1


@lru_cache
def reduced() -> tuple[em.ForwardMap, float, int]:
    """POD + Gaussian processes of a campaign of their own."""
    began, scene = time.process_time(), scene_of()
    fitted = em.fit_reduced(scene, em.fem.run_campaign(simulator(), em.fem.sobol(scene, RUNS, 5)))
    return fitted, time.process_time() - began, RUNS


@lru_cache
def simulator() -> em.Simulator:
    """FEM on the benchmark's scene."""
    return em.Simulator(scene_of())


def sampler(name: str, **options: Any) -> Method:
    """One of the toolkit's samplers."""

    def draw(statistical: cal.Model, data: Draws) -> tuple[Draws, int]:
        chosen = cal.samplers.SAMPLERS[name]
        posterior = cal.sample(
            statistical, data, sampler=name, options=chosen.options(**options), seed=3,
            predictions=False,
        )  # fmt: skip
        return posterior.draws(), 0

    return draw


def by_emcee(statistical: cal.Model, data: Draws) -> tuple[Draws, int]:
    """Goodman and Weare's ensemble by emcee (Foreman-Mackey et al. 2013): 64 walkers."""
    import emcee

    density, walkers, steps = cal.samplers.density_of(statistical), 64, 10_000
    log_density = jax.jit(jax.vmap(lambda z: density.log_density(z, data)))
    start = jax.vmap(density.prior_draw)(jax.random.split(jax.random.key(3), walkers))
    ensemble = emcee.EnsembleSampler(
        walkers,
        density.dimension,
        lambda z: np.asarray(log_density(jnp.asarray(z))),
        vectorize=True,
    )
    ensemble.random_state = np.random.RandomState(3).get_state()
    ensemble.run_mcmc(np.asarray(start), steps)
    z = ensemble.get_chain(discard=steps // 2, flat=True)
    return {n: np.asarray(v) for n, v in density.constrain(jnp.asarray(z)).items()}, 0


def by_pymc(statistical: cal.Model, data: Draws) -> tuple[Draws, int]:
    """PyMC, our log density wrapped by PyTensor; compiled by JAX, so that NumPyro's NUTS draws.

    PyMC's own NUTS calls Python for every gradient and was not through one problem in 200 s.
    """
    import pymc as pm
    from pytensor import wrap_jax

    density = cal.samplers.density_of(statistical)
    log_density = wrap_jax(lambda z: density.log_density(z, data))
    with pm.Model():
        z = pm.Flat("z", shape=density.dimension)
        pm.Potential("posterior", log_density(z))
        trace = pm.sample(
            500, tune=300, chains=4, random_seed=3, progressbar=False, nuts_sampler="numpyro",
            compute_convergence_checks=False, nuts_sampler_kwargs={"chain_method": "vectorized"},
        )  # fmt: skip
    z = np.asarray(trace["posterior"]["z"]).reshape(-1, density.dimension)
    return {n: np.asarray(v) for n, v in density.constrain(jnp.asarray(z)).items()}, 0


@dataclass(frozen=True)
class Entry:
    """A line of the leaderboard.

    forward : makes the map, and tells the seconds and FEM runs it took.
    """

    name: str
    forward: Callable[[], tuple[em.ForwardMap, float, int]]
    method: Method


_NUTS = {"warmup": 300, "draws": 500, "chains": 4, "rounds": 2}
EMULATOR = emulator
OURS = {
    "emulator_nuts": Entry("emulator, NUTS", EMULATOR, sampler("nuts", **_NUTS)),
    "emulator_laplace": Entry("emulator, Laplace", EMULATOR, sampler("laplace")),
    "emcee": Entry("emulator, emcee", EMULATOR, by_emcee),
    "pod_gp_nuts": Entry(
        f"POD + GP of {RUNS} runs, NUTS", reduced, sampler("nuts", **_NUTS)
    ),
    "emulator_smc": Entry("emulator, SMC", EMULATOR, sampler("smc")),
    "pymc": Entry("emulator, PyMC", EMULATOR, by_pymc),
}  # fmt: skip


def draw(entry: Entry, problem: Problem) -> tuple[np.ndarray, dict[str, Any]]:
    """Draws (n, p) of one problem, at most ``KEPT``, and what they took."""
    forward, _, _ = entry.forward()
    data, began, wall = data_of(problem), time.process_time(), time.perf_counter()
    draws, solves = entry.method(model(problem, forward), data)
    took = {
        "processor_s": time.process_time() - began,
        "wall_s": time.perf_counter() - wall,
        "fem_solves": solves,
    }
    columns = np.column_stack([draws[name] for name in scene_of().parameter_names])
    rows = np.linspace(0, len(columns) - 1, min(KEPT, len(columns))).astype(int)
    return columns[rows], took
