r"""Rounds of FEM runs that find where a posterior is, and teach an emulator there.

Nobody knows beforehand where the data will put a posterior. So the prior is wide, a log-normal of
each parameter, and FEM is asked where it says most:

1. **Begin.** A few runs, with derivatives, are spread over the prior.
2. **Repeat.** A Gaussian process of the data's means and their derivatives is fitted to all runs
   (:mod:`emulator.surrogates.correction`), weighted points follow its posterior
   (:mod:`calibrate.statistical_model.pool`), and fresh runs are made at some of them: half are
   draws of that posterior, which test the process before they teach it, half are far from all runs,
   where it doubts.
3. **End.** The rounds end when the process foresees FEM: log likelihoods at the draws of a round
   differ by less than 0.1 nats in root mean square, and by less than 1 nat wherever FEM or the
   process finds the data likely, twice, or no more runs are allowed. A posterior whose log density
   is wrong by the sd :math:`s` has means wrong by :math:`s` sd at most, since
   :math:`|\mathrm{cov}(x, w)| \le \mathrm{sd}(x)\, \mathrm{sd}(w)`.
4. **Teach.** The process of the last round gives the data of the posterior that is sampled. The
   displacements of all runs, with their sensitivities, become an emulator of the whole body
   (:mod:`emulator.surrogates.discrepancy`), for pictures and predictions of anything else.

The certificate judges the posterior, by FEM runs of its own.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from scipy.special import chdtri
from tqdm import tqdm

from calibrate.certificate.runs import FEMRunner, FEMRuns, correction_from, least_likely
from calibrate.importance.proposals import key_from
from calibrate.importance.weights import normalised
from calibrate.posterior import Posterior
from calibrate.posterior.diagnosis import (
    FORESEEN,
    FORESEEN_ANYWHERE,
    ROUNDS_RECORD,
    TAUGHT_AT,
)
from calibrate.project.problem import Problem, build_model, read_problem
from calibrate.statistical_model import FEMLikelihood, Model
from calibrate.statistical_model.density import density_of, prior_draws
from calibrate.statistical_model.fem_likelihood import runs_of
from calibrate.statistical_model.many_draws import in_blocks
from calibrate.statistical_model.pool import Pool
from calibrate.statistical_model.predictive import Predictive
from emulator.core.display import counting
from emulator.core.errors import SolverError
from emulator.core.machine import one_blas_thread
from emulator.core.rooms import offered
from emulator.core.store import read_arrays, save_arrays
from emulator.fem.campaign import Field, Runs
from emulator.fem.solution import EquilibriumSolver
from emulator.scenes.forward_problem import ForwardProblem
from emulator.scenes.scene import Scene, with_mesh
from emulator.surrogates import registry, shipped
from emulator.surrogates.discrepancy import maximin_subset
from emulator.surrogates.emulator import EMULATOR, Emulator
from emulator.surrogates.part import widened
from emulator.surrogates.protocol import ForwardMap
from emulator.surrogates.taught import ROUNDS, DataProcess, Taught, no_process, taught
from emulator.training.mechanics import add_discrepancy

_ARRAYS = ("theta", "displacement", "sensitivities")  # of a file of solutions
_SCENE, _EARLIER = "of", "draws"  # metadata of that file
_A_ROUND = 8  # runs of a round; half of them are draws
_BEGIN = 10  # runs spread over the prior
_CANDIDATES = 16  # points of which one is taken, where the farthest are
_BULK = 0.95  # mass of the prior inside which FEM is asked where it may find the data likely
_LIKELY = 0.99  # mass of the Gaussian at the best run in which draws count
_NOISE_DRAWS = 256  # draws of the prior of a noise sd that is inferred


@dataclass(frozen=True)
class Round:
    """The outcome of one round.

    runs : the number of runs so far. failed : those at which FEM failed.
    missed : the root mean square by which log likelihoods at the round's draws were missed, nats;
        infinite where no draw was likely.
    worst : the largest miss of a log likelihood at any of its likely points, nats.
    """

    runs: int
    failed: int
    missed: float
    worst: float


def teach(
    model: Model,
    data: Mapping[str, Any],
    simulator: EquilibriumSolver,
    *,
    most: int,
    seed: int = 0,
    keep: Path | None = None,
    deadline: float = np.inf,
    progress: bool = False,
) -> Taught:
    """Return a map of FEM runs where the posterior is; its record lists the rounds.

    Parameters
    ----------
    model : the model of the data, of the body at rest in place of a forward map.
    most : the largest number of runs, each in every load state, besides those of earlier searches.
    keep : the file of FEM's solutions, from which a killed search goes on: the same points are
        asked, and those it holds are not solved again. A search that ended there
        (:func:`keep_for_later`) gives this one all its runs to begin with. None for none.
    deadline : the value of ``time.perf_counter`` by which the last round is to end.

    Raises
    ------
    SolverError
        FEM fails at most points of the prior.
    """
    fingerprint = simulator.scene.fingerprint
    kept, earlier = ({}, {}) if keep is None else _read(keep, fingerprint)
    model, blank = before_runs(model, simulator.scene)
    predictive = Predictive(model, data, _noise_draws(model))
    rng = np.random.default_rng([seed, 2])
    if set(model.names) <= earlier.keys():
        begin = predictive.unconstrain({name: np.asarray(earlier[name]) for name in model.names})
        most += len(begin)
    else:
        begin = _spread_over_prior(predictive, min(_BEGIN, most), rng)
    with (
        one_blas_thread(),
        counting(
            total=most, desc="FEM where the posterior is", disable=not progress, unit="run"
        ) as bar,
    ):
        solver = FEMRunner(predictive, FEMLikelihood(model, simulator, kept=kept), bar)

        def ask(z: np.ndarray) -> FEMRuns:
            answers = solver(z, slopes=True)
            if keep is not None:
                _write(keep, kept, fingerprint, earlier)
            return answers

        runs, rounds = _in_rounds(predictive, ask, begin, most, deadline, rng, bar)
        bar.close()
        learned = correction_from(runs, predictive, most).of_scaled(*predictive.scale_of_features)
    at = predictive.constrain(runs.z[runs.converged])
    taught_at = {name: values.tolist() for name, values in at.items()}
    record = {ROUNDS_RECORD: [asdict(r) for r in rounds], TAUGHT_AT: taught_at}
    process = replace(blank, correction=learned)
    return _map_of(simulator.scene, process, runs_of(kept), record)


def _map_of(
    scene: ForwardProblem,
    data: DataProcess,
    runs: Runs | None = None,
    record: Mapping[str, Any] = MappingProxyType({}),
) -> Taught:
    """Return the map of a process of data, and of the solutions ``runs``; None before the first.

    record : what is told of the rounds.
    """
    if not isinstance(scene, Scene):
        (taught_outputs,) = offered("emulator.external.maps", "taught_outputs")
        of_outputs: Taught = taught_outputs(scene, data, runs, record)
        return of_outputs
    emulator = Emulator(scene)
    if runs is not None:
        emulator, of_runs = add_discrepancy(emulator, runs)
        record = {"discrepancy": of_runs, **record}
    return taught(replace(emulator, record=dict(record)), data)


def _in_rounds(
    predictive: Predictive,
    ask: Callable[[np.ndarray], FEMRuns],
    begin: np.ndarray,
    most: int,
    deadline: float,
    rng: np.random.Generator,
    bar: tqdm,
) -> tuple[FEMRuns, list[Round]]:
    """Return all runs, and the rounds, of which the last two foresaw FEM or time or runs ended.

    begin : the points (k, p) of the runs before the first round.
    """
    began, rounds = time.perf_counter(), list[Round]()
    runs = ask(begin)
    _require_half(runs)

    def is_late() -> bool:
        """Return whether a round as slow as those before would end too late."""
        now = time.perf_counter()
        return now + (now - began) * _A_ROUND / len(runs.z) > deadline

    while len(runs.z) < most and not _are_foreseen(rounds) and not is_late():
        fresh, predicted, drawn = _fresh_points(predictive, runs, most, rng)
        answers = ask(fresh[: most - len(runs.z)])
        rounds.append(_judged(runs, answers, predicted, drawn))
        runs = FEMRuns.joined([runs, answers])
        bar.set_postfix_str(f"log likelihoods missed by {rounds[-1].missed:.2g}")
    return runs, rounds


def before_runs(model: Model, scene: ForwardProblem) -> tuple[Model, DataProcess]:
    """Return the model by a process that knows nothing, and the process: the body is at rest."""
    draws = model.prior_draws(jax.random.key(0), 1)
    thetas = model.states.thetas({name: values[0] for name, values in draws.items()})
    # Not by the map: it moves the supports, which may invert the elements beside them.
    undeformed = jnp.zeros((len(thetas), len(model.observe.nodes), 3))
    constant = np.asarray(ravel_pytree(model.observe(undeformed, thetas))[0])
    process = no_process(model.question, constant, len(model.states.unknowns))
    full = _map_of(scene, process)
    return replace(model, full=full, forward=full.at(model.observe.nodes)), process


def by_rounds(problem: Problem) -> Problem:
    """Return the problem with a map that is taught where its scene has no emulator.

    A specimen gets its states, a table of runs its rows. A run that names a forward map or an
    emulator is returned as it is.
    """
    run, scene = problem.run, problem.scene
    if run.forward != EMULATOR.name or run.emulator is not None:
        return problem
    # A scene file may have the name of a shipped one, and finer:NAME does.
    if scene.name in shipped() and scene.origin.get("scene") == scene.name:
        return problem
    mapped = read_problem(replace(run, forward=scene.usual_map), scene=scene)
    if not scene.has_solver:
        (with_emulator_error,) = offered("calibrate.external.by_rows", "with_emulator_error")
        allowed: Problem = with_emulator_error(mapped)
        return allowed
    return mapped


def taught_map(problem: Problem, **options: Any) -> Taught | None:
    """Return the map that rounds of FEM runs teach; None where the run names another one.

    options : ``keep``, ``deadline`` and ``progress`` of :func:`teach`.
    """
    run = problem.run
    if run.forward != ROUNDS.name:
        return None
    scene = problem.scene if problem.scene.components else with_mesh(problem.scene)
    blank = _map_of(scene, no_process("", np.zeros(0), 1))
    model, data = build_model(problem, blank)
    model, data = replace(model, check_scale=False).given(data)
    most = registry.full_options(ROUNDS.name, run.forward_options)["most_runs"]
    return teach(model, data, problem.simulator, most=most, seed=run.seed, **options)


def account_of(forward: ForwardMap) -> dict[str, Any]:
    """Return the rounds, and the draws at which FEM was solved, of a map that they taught."""
    record = getattr(forward, "record", {})
    return {name: record[name] for name in (ROUNDS_RECORD, TAUGHT_AT) if name in record}


def _require_half(runs: FEMRuns) -> None:
    """Raise :class:`SolverError` where FEM fails at most of the prior."""
    failed = int((~runs.converged).sum())
    if failed > 0.5 * len(runs.z):
        raise SolverError(
            f"FEM fails at {failed} of {len(runs.z)} points of the prior; narrow it, or raise "
            "--load-steps"
        )


def _are_foreseen(rounds: list[Round]) -> bool:
    """Return whether FEM was foreseen in the last two rounds."""
    foreseen = [r.missed <= FORESEEN and r.worst <= FORESEEN_ANYWHERE for r in rounds[-2:]]
    return len(foreseen) > 1 and all(foreseen)


def _noise_draws(model: Model) -> dict[str, np.ndarray]:
    """Return draws of the prior of everything that is inferred, for the size of unknown noise."""
    density = density_of(model)
    return in_blocks(density.constrain, prior_draws(density, jax.random.key(0), _NOISE_DRAWS))


def _spread_over_prior(predictive: Predictive, count: int, rng: np.random.Generator) -> np.ndarray:
    """Return points z (count, p) far from each other in the prior's bulk, from its middle on."""
    z = predictive.prior_draws(key_from(rng), _CANDIDATES * count)
    distance = (((z - np.median(z, axis=0)) / z.std(axis=0)) ** 2).sum(axis=1)
    bulk = z[np.argsort(distance)[: len(z) * 3 // 4]]
    return bulk[maximin_subset(bulk / z.std(axis=0), count)]


def _fresh_points(
    predictive: Predictive, runs: FEMRuns, most: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, int]:
    """Return points z (k, p) to ask FEM at, their predicted log likelihoods, and the draws' number.

    The first points are draws of the posterior as the runs so far have it. The others are those of
    many, where FEM may find the data likely, that are farthest from all runs. Far out in the prior
    a process may find anything likely, and FEM takes minutes: there, it is asked at draws only.
    """
    correction = correction_from(runs, predictive, most)
    pool = Pool.search(predictive, correction, None, (), rng)
    drawn = _A_ROUND // 2
    rows = pool.resampled(drawn, rng)
    x = predictive.features(pool.z)
    rare = (x**2).sum(axis=1) > chdtri(x.shape[1], 1.0 - _BULK)
    explored = normalised(np.where(rare, -np.inf, pool.log_explored))
    chances = explored + pool.corrected
    size = _CANDIDATES * (_A_ROUND - drawn)
    others = rng.choice(len(pool.z), size=size, p=chances / chances.sum())
    scale = np.sqrt(np.cov(pool.z[others], rowvar=False).reshape(len(pool.z[0]), -1).diagonal())
    known = np.concatenate([runs.z, pool.z[rows]])
    scale = np.maximum(scale, 1e-12)
    taken = maximin_subset(pool.z[others] / scale, _A_ROUND - drawn, known / scale)
    every = np.concatenate([rows, others[taken]])
    return pool.z[every], pool.at.corrected[every], drawn


def _judged(runs: FEMRuns, answers: FEMRuns, predicted: np.ndarray, drawn: int) -> Round:
    """Return what a round's answers at its first ``drawn`` points say of what was predicted."""
    every, predicted = FEMRuns.joined([runs, answers]), predicted[: len(answers.z)]
    least = least_likely(every.fem.max(), every.z.shape[1], _LIKELY)
    likely = np.maximum(answers.fem, predicted) > least
    with np.errstate(invalid="ignore"):
        missed = np.abs(answers.fem - predicted)
    at_draws = missed[:drawn][likely[:drawn]]
    size = float(np.sqrt(np.mean(at_draws**2))) if at_draws.size else np.inf
    failed = int((~every.converged).sum())
    return Round(len(every.z), failed, size, float(missed[likely].max(initial=0.0)))


_Draws = Mapping[str, list[float]]  # by the unknown's name


def _write(path: Path, kept: Mapping[bytes, Field], fingerprint: str, earlier: _Draws) -> None:
    """Write solutions of the scene of ``fingerprint``, and the draws of searches that ended."""
    runs = runs_of(kept)._asdict()
    arrays = {name: np.asarray(runs[name])[::-1] for name in _ARRAYS}
    about = {_SCENE: fingerprint, _EARLIER: json.dumps(earlier)}
    save_arrays(path, {n: np.ascontiguousarray(a) for n, a in arrays.items()}, about)


def _read(path: Path, fingerprint: str) -> tuple[dict[bytes, Field], _Draws]:
    """Return solutions and draws that searches of the same scene left, or none."""
    if not path.is_file():
        return {}, {}
    arrays, metadata = read_arrays(path)
    if metadata.get(_SCENE) != fingerprint or not set(_ARRAYS) <= set(arrays):
        return {}, {}
    thetas, *fields = (widened(arrays[name]) for name in _ARRAYS)
    rows = zip(*fields, strict=True)
    kept = {theta.tobytes(): Field(*row) for theta, row in zip(thetas, rows, strict=True)}
    return kept, json.loads(metadata.get(_EARLIER, "{}"))


def keep_for_later(path: Path, posterior: Posterior) -> None:
    """Say in the file of a search's solutions that it ended, and at which draws FEM was solved.

    Derivatives are kept in single precision. Nothing is done where no search left a file.
    """
    if path.is_file() and (taught_at := posterior.taught_at()):
        arrays, metadata = read_arrays(path)
        arrays[_ARRAYS[2]] = arrays[_ARRAYS[2]].astype(np.float32)
        draws = {name: np.asarray(values).tolist() for name, values in taught_at.items()}
        save_arrays(path, arrays, metadata | {_EARLIER: json.dumps(draws)})
