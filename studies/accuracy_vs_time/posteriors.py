"""What the posterior costs: its error against FEM's, and the time from mesh and data to draws.

Data and FEM's posterior are those of ``studies/inverse_benchmark``: the ventricle, displacements,
strains and volume. Each forward map and sampler is made and run in a process of its own, without a
cache of compiled programs. Some posteriors are certified, too.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from numpyro.infer import MCMC
from numpyro.infer import NUTS as NUTSKernel
from studies.accuracy_vs_time.rungs import SEED, mechanics
from studies.common.output import Case
from studies.inverse_benchmark import entries, reference, tables
from studies.inverse_benchmark.problems import PROBLEMS, data_of, model, scene_of
from studies.inverse_benchmark.score import score

import calibrate as cal
import emulator as em

PROBLEM = PROBLEMS["all_mid"]
NUTS = entries.sampler("nuts", warmup=500, draws=1000, chains=4)
FEW = entries.sampler("nuts", warmup=150, draws=250, chains=2, rounds=1)


def by_numpyro(statistical: cal.Model, data: entries.Draws) -> tuple[entries.Draws, int]:
    """NumPyro's own NUTS with a dense metric, 4 chains of 1000 draws."""
    run = MCMC(
        NUTSKernel(statistical, dense_mass=True), num_warmup=1000, num_samples=1000, num_chains=4,
        chain_method="sequential", progress_bar=False,
    )  # fmt: skip
    run.run(jax.random.key(3), statistical.check_data(data))
    drawn = run.get_samples()
    return {name: np.asarray(drawn[name]) for name in statistical.names}, 0


def _series(order: int) -> Callable[[em.Scene], em.ForwardMap]:
    return lambda scene: em.Emulator(
        scene, taylor=em.expand(em.Simulator(scene), order=order)
    ).cache()


def _mechanics(runs: int) -> Callable[[em.Scene], em.ForwardMap]:
    return lambda scene: mechanics(scene, runs).cache()


def _reduced(runs: int) -> Callable[[em.Scene], em.ForwardMap]:
    return lambda scene: em.fit_reduced(
        scene, em.fem.run_campaign(em.Simulator(scene), em.fem.sobol(scene, runs, SEED))
    )


def _fem(scene: em.Scene) -> em.ForwardMap:
    """FEM, started by a series of order 2: the fastest way to ask FEM itself."""
    return em.fem_forward(em.Simulator(scene), _series(2)(scene))


@dataclass(frozen=True)
class Way:
    """A forward map, made from the scene, and a sampler.

    sampler : ``None`` for the toolkit's default, with a certificate after it.
    """

    kind: str
    make: Callable[[em.Scene], em.ForwardMap]
    sampler: entries.Method | None = NUTS


WAYS = {
    **{f"series of order {n}, NUTS": Way("series", _series(n)) for n in (1, 2, 3)},
    **{
        f"series + discrepancy, {n} FEM runs, NUTS": Way("emulator", _mechanics(n))
        for n in (5, 20, 60)
    },
    **{
        f"series + discrepancy, {n} FEM runs, certified": Way("emulator", _mechanics(n), None)
        for n in (5, 20, 60)
    },
    **{f"POD + GP, {n} FEM runs, NUTS": Way("POD + GP", _reduced(n)) for n in (10, 30, 60)},
    "POD + GP, 60 FEM runs, NumPyro's NUTS": Way("POD + GP", _reduced(60), by_numpyro),
    "series + discrepancy, 20 FEM runs, SMC": Way(
        "emulator", _mechanics(20), entries.sampler("smc")
    ),
    "series + discrepancy, 20 FEM runs, Laplace": Way(
        "emulator", _mechanics(20), entries.sampler("laplace")
    ),
    "FEM, NUTS": Way("FEM", _fem, FEW),
}


def examine(name: str) -> Case:
    """One way: its error, and its time from the mesh and from the map."""
    way, scene = WAYS[name], scene_of()
    began = time.perf_counter()
    forward = way.make(scene)
    forward(jnp.asarray(scene.centre)).block_until_ready()
    offline = time.perf_counter() - began
    began = time.perf_counter()
    statistical, data, after = model(PROBLEM, forward), data_of(PROBLEM), {}
    if way.sampler:
        draws, solves = way.sampler(statistical, data)
        sampling = time.perf_counter() - began
    else:
        posterior = cal.sample(statistical, data, seed=3, predictions=False)
        draws, sampling = posterior.draws(), time.perf_counter() - began
        # Against FEM on this mesh, as the reference is: linear elements fail the row of the mesh.
        certificate = cal.certify(posterior, entries.simulator(), mesh=0)
        solves = certificate.evidence.physics.runs
        after = {
            "certifying_s": time.perf_counter() - began - sampling,
            "verdict": certificate.verdict,
            "reason": certificate.reason,
        }
    names = scene.parameter_names
    columns = np.column_stack([draws[each] for each in names])
    table = tables.Table(columns, np.full(len(columns), 1.0 / len(columns)))
    found = score(table, tables.read(reference.path_of(PROBLEM), names))
    kept = ("sliced", "largest_shift", "largest_log_sd", "draws")
    return {
        "kind": way.kind,
        "posterior": name,
        "offline_s": offline,
        "sampling_s": sampling,
        "fem_solves": solves,
        **after,
        **{key: found[key] for key in kept},
    }
