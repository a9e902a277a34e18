"""The ways to a posterior: draws, what they cost in FEM solves and in processor time."""

import time
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from arviz_stats.base import array_stats
from studies.fem_posterior.problems import Problem

import calibrate as cal
from calibrate.importance import transport
from calibrate.posterior import Posterior
from calibrate.samplers import density_of, named_draws
from calibrate.samplers.chains import compile_chains
from calibrate.samplers.nuts import NUTS, NUTSOptions
from calibrate.statistical_model import FEMLikelihood

AXES = {"chain_axis": 0, "draw_axis": 1}
PLAIN, TUNED, CHEAP = (
    "FEM-NUTS",
    "FEM-NUTS, tuned by the emulator",
    "emulator + certificate",
)


@dataclass(frozen=True)
class Sizes:
    """Lengths of the runs.

    chains, warmup, draws : of FEM-NUTS. tuned : warm-up and draws of the run that starts from the
    emulator's posterior. weighed : draws of the emulator at which FEM is solved. certificate : FEM
    runs. cheap : warm-up and draws of the emulator's own run.
    """

    chains: int = 2
    warmup: int = 150
    draws: int = 200
    tuned: tuple[int, int] = (100, 200)
    weighed: int = 1000
    certificate: int = 200
    cheap: tuple[int, int] = (500, 1000)


@dataclass(frozen=True, eq=False)
class Outcome:
    """Draws (chains, draws, p) of the unknowns, and what they cost.

    solves : FEM's, warm-up included. kept_solves : of the draws kept. adjoints : whether each
    solve comes with one. again_s : processor time of a second run, its programs compiled.
    """

    method: str
    draws: np.ndarray
    solves: int
    kept_solves: int
    seconds: float
    adjoints: bool = False
    again_s: float | None = None
    more: dict[str, Any] = field(default_factory=dict)

    @property
    def effective(self) -> float:
        """Smallest bulk ESS of an unknown."""
        return min(float(array_stats.ess(x, method="bulk", **AXES)) for x in self._unknowns)

    @property
    def r_hat(self) -> float:
        return max(float(array_stats.rhat(x, **AXES)) for x in self._unknowns)

    def errors(self, method: str) -> np.ndarray:
        """Monte Carlo errors (p,) of the ``mean`` or the ``sd``."""
        return np.array([array_stats.mcse(x, method=method, **AXES) for x in self._unknowns])

    @property
    def _unknowns(self) -> np.ndarray:
        return np.moveaxis(self.draws, -1, 0)

    def flat(self) -> np.ndarray:
        return self.draws.reshape(-1, self.draws.shape[-1])

    def to_json(self) -> dict[str, Any]:
        effective, flat = self.effective, self.flat()
        return {
            "method": self.method,
            "chains": self.draws.shape[0],
            "draws": self.draws.shape[1],
            "effective": effective,
            "r_hat": self.r_hat,
            "fem_solves": self.solves,
            "kept_fem_solves": self.kept_solves,
            "adjoints": self.adjoints,
            "solves_per_effective_draw": self.solves / effective,
            "kept_solves_per_effective_draw": self.kept_solves / effective,
            "processor_s": self.seconds,
            "processor_again_s": self.again_s,
            "effective_per_s": effective / self.seconds,
            "effective_per_s_again": None if self.again_s is None else effective / self.again_s,
            "mean": flat.mean(axis=0).tolist(),
            "mean_error": self.errors("mean").tolist(),
            "sd": flat.std(axis=0, ddof=1).tolist(),
            "sd_error": self.errors("sd").tolist(),
            **self.more,
        }


def stacked(posterior: Posterior) -> np.ndarray:
    """Draws (chains, draws, p)."""
    group = posterior.tree["posterior"]
    return np.stack([np.asarray(group[name]) for name in posterior.model.names], axis=-1)


def by_emulator(problem: Problem, sizes: Sizes, seed: int) -> tuple[Outcome, Posterior]:
    """The emulator's posterior and its certificate; once more with all programs compiled."""
    warmup, draws = sizes.cheap
    options = NUTSOptions(warmup=warmup, draws=draws)

    def once(seed: int) -> tuple[Posterior, Any, float, float]:
        begin = time.process_time()
        posterior = cal.sample(
            problem.cheap, problem.data, options=options, seed=seed, predictions=False
        )
        sampled = time.process_time()
        certificate = cal.certify(posterior, problem.simulator, draws=sizes.certificate, seed=seed)
        return posterior, certificate, sampled - begin, time.process_time() - sampled

    posterior, certificate, sampling, certifying = once(seed)
    again = sum(once(seed)[2:])  # the same work
    shifts = certificate.evidence.draws.shift
    more = {
        "verdict": certificate.verdict,
        "sampling_s": sampling,
        "certifying_s": certifying,
        "divergences": posterior.divergences,
        "certificate_shift": {name: f.value for name, f in shifts.items()},
        "certificate_shift_error": {name: f.error for name, f in shifts.items()},
    }
    made = Outcome(
        CHEAP, stacked(posterior), sizes.certificate, sizes.certificate, sampling + certifying,
        again_s=again, more=more,
    )  # fmt: skip
    return made, posterior


def by_fem(problem: Problem, sizes: Sizes, seed: int) -> Outcome:
    """NUTS with FEM as its forward map: pilot and final run, one round."""
    options = NUTSOptions(sizes.warmup, sizes.draws, sizes.chains, rounds=1)
    before, begin = problem.solves.total(), time.process_time()
    posterior = cal.sample(problem.fem, problem.data, options=options, seed=seed, predictions=False)
    solves = problem.solves.total() - before
    kept = int(posterior.tree["sample_stats"]["n_steps"].sum())
    more = {"divergences": posterior.divergences}
    seconds = time.process_time() - begin
    return Outcome(PLAIN, stacked(posterior), solves, kept, seconds, adjoints=True, more=more)


def by_tuned_fem(
    problem: Problem, posterior: Posterior, sizes: Sizes, seed: int, seconds: float
) -> Outcome:
    """The same without a pilot: coordinates straightened by the emulator's posterior.

    ``seconds`` that sampling it took are counted.
    """
    warmup, length = sizes.tuned
    options = NUTSOptions(warmup, length, sizes.chains, rounds=1)
    before, begin = problem.solves.total(), time.process_time()
    density = density_of(problem.fem)
    data = problem.fem.check_data(problem.data)
    drawn = {name: jnp.asarray(values) for name, values in posterior.draws().items()}
    map_ = transport.fit_standard(np.asarray(jax.jit(jax.vmap(density.unconstrain))(drawn)))
    programs = compile_chains(density, NUTS, options)
    keys = jax.random.split(jax.random.key(seed), sizes.chains)
    states, _ = programs.start(keys, data, map_)
    # One length of both, so that one program serves.
    part = int(np.gcd(warmup, length))
    found = []
    for _ in range((warmup + length) // part):
        states, draws = programs.advance(states, data, map_, count=part)
        found.append(jax.tree.map(np.asarray, draws))
    solves = problem.solves.total() - before
    kept = found[warmup // part :]
    named = named_draws(problem.fem, np.concatenate([d.z for d in kept], axis=1))
    return Outcome(
        TUNED,
        np.stack([named[name] for name in problem.fem.names], axis=-1),
        solves,
        int(sum(d.statistics["n_steps"].sum() for d in kept)),
        seconds + time.process_time() - begin,
        adjoints=True,
        more={"divergences": int(sum(d.statistics["diverging"].sum() for d in kept))},
    )


@dataclass(frozen=True)
class Weighed:
    """FEM's log likelihood less the emulator's at some of its draws ``x`` (s, p)."""

    x: np.ndarray
    log_weights: np.ndarray
    seconds: float


def weigh(problem: Problem, posterior: Posterior, count: int) -> Weighed:
    """FEM at ``count`` evenly spaced draws of the emulator's posterior."""
    drawn = posterior.draws()
    size = len(drawn[posterior.model.names[0]])
    rows = np.linspace(0, size - 1, count).astype(int)
    likelihood = FEMLikelihood(posterior.model, problem.simulator)
    begin = time.process_time()
    found = [likelihood({n: v[r] for n, v in drawn.items()}, posterior.data) for r in rows]
    seconds = time.process_time() - begin
    x = np.stack([drawn[name][rows] for name in posterior.model.names], axis=1)
    return Weighed(x, np.array([f.fem - f.cheap for f in found]), seconds)
