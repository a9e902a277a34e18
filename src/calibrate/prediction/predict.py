r"""What the draws of a posterior predict of another scene, by finite elements at a few of them.

A Gaussian process of FEM's data with their derivatives (:mod:`emulator.surrogates.correction`, of
the body at rest) is fitted to runs at draws that lie far from each other, and gives the data at all
draws. Runs at other draws, at random, test it: the root mean square by which they are missed, as a
share of the draws' own spread, is to be :math:`\epsilon \le 0.05`, so that a predicted sd is right
to :math:`\sqrt{1 + \epsilon^2} - 1`, a tenth of a percent. While it is more, the tests teach, and
other draws test. A specimen's states are solved at every draw.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from calibrate.certificate.runs import FEMRunner, FEMRuns, correction_from
from calibrate.measurements import Observation, Observations, observations
from calibrate.noise import GaussianNoise
from calibrate.posterior import Posterior
from calibrate.prediction.transfer import Learned, Transfer, transfer
from calibrate.project import simulator_of
from calibrate.project.rounds import before_runs
from calibrate.state_names import in_state
from calibrate.statistical_model import FEMLikelihood, Model
from calibrate.statistical_model.fem_likelihood import runs_of
from calibrate.statistical_model.model import model
from calibrate.statistical_model.predictive import Predictive
from emulator.core.display import counting
from emulator.core.errors import InputError, SolverError
from emulator.core.machine import one_blas_thread
from emulator.core.rooms import offered
from emulator.fem.campaign import Field
from emulator.fem.solution import EquilibriumSolver
from emulator.scenes.forward_problem import ForwardProblem
from emulator.scenes.scene import Scene
from emulator.surrogates.discrepancy import maximin_subset
from emulator.surrogates.emulator import CachedEmulator, Emulator
from emulator.surrogates.protocol import ForwardMap
from emulator.training.mechanics import add_discrepancy

_BEGIN, _TESTS = 12, 6  # runs that teach before the first test, and of each test
_MISSED = 0.05  # sd of the draws by which tests may be missed, in root mean square
_FEWEST = 20  # draws from which quantiles can be told
_QUANTILES = (0.05, 0.5, 0.95)


@dataclass(frozen=True, eq=False)
class Predicted:
    """Predictions of a scene at draws of a posterior.

    scene, observe : the scene, its ranges wide enough for the draws, and what is observed of it.
    draws : draws (s,) of each unknown of the scene's theta, by name.
    sources : the source of each parameter's values, in words.
    values : data without noise (s, *shape) at each draw, by the observation's name.
    runs, failed : the number of FEM runs, each in every load state, and of those that failed.
    missed : the root mean square by which the last tests were missed, in sd of the draws; zero
        where every draw was solved.
    forward : a forward map of the whole body at the draws. thetas : theta (s, S, p).
    """

    scene: ForwardProblem
    observe: Observations
    draws: Mapping[str, np.ndarray]
    sources: Mapping[str, str]
    values: Mapping[str, np.ndarray]
    runs: int
    failed: int
    missed: float
    forward: ForwardMap
    thetas: jax.Array
    warnings: list[str] = field(default_factory=list)

    def summary(self) -> dict[str, dict[str, Any]]:
        """Return unit, mean, sd and quantiles of 5, 50 and 95 % of each observation, by name."""
        rows = {}
        for name, values in self.values.items():
            low, median, high = np.quantile(values, _QUANTILES, axis=0)
            rows[name] = {
                "unit": self.observe.parts[name].unit,
                "mean": values.mean(axis=0),
                "sd": values.std(axis=0, ddof=1),
                "low": low,
                "median": median,
                "high": high,
            }
        return rows


def predict_on(
    learned: Posterior | Learned,
    scene: ForwardProblem,
    observe: Observation | Mapping[str, Observation] | Observations,
    *,
    known: Mapping[str, float] | None = None,
    another: float | None = None,
    draws: int = 1000,
    most_runs: int = 96,
    load_steps: int = 1,
    seed: int = 0,
    progress: bool = False,
) -> Predicted:
    """Return what draws of a posterior predict of another scene of the same law.

    Parameters
    ----------
    learned : the posterior, or what a population says of a member that was not seen.
    scene : the scene or specimen, whose parameters of the law take the posterior's draws.
    observe : one observation of it, or several by name; ``volume@p8`` is one in a load state.
    known : the values of parameters that are neither the posterior's nor drawn, by
        ``parameter`` or ``parameter@state``. Others are drawn from their prior in the scene.
    another : the log-sd of the stiffness between specimens, to predict another specimen than the
        one that was measured; None for the same.
    draws : the number of draws. most_runs : the largest number of FEM runs.

    Raises
    ------
    InputError
        A scene of another law, a name that is no parameter, or too few draws.
    SolverError
        FEM fails at a fifth of the draws or more.
    """
    if draws < _FEWEST:
        raise InputError(f"prediction: {draws} draws; give {_FEWEST} or more")
    rng, several = np.random.default_rng([seed, 5]), observations(observe)
    if isinstance(learned, Posterior):
        learned = Learned.of(learned)
    if another is not None:
        learned = learned.of_another_specimen(another, np.random.default_rng([seed, 6]))
    target = transfer(learned, scene, several, known or {}, draws, rng)
    if not isinstance(target.scene, Scene):
        return _of_states(learned, target, several)
    simulator = simulator_of(target.scene, load_steps)
    return _of_body(simulator, target, several, most_runs, rng, progress=progress)


def _of_body(
    simulator: EquilibriumSolver,
    target: Transfer,
    several: Observations,
    most_runs: int,
    rng: np.random.Generator,
    *,
    progress: bool,
) -> Predicted:
    """Return the predictions of a body, which is solved by FEM at a few draws."""
    kept: dict[bytes, Field] = {}
    assert isinstance(target.scene, Scene)
    at_rest = Emulator(target.scene).cache()
    with one_blas_thread(), counting(
        total=_BEGIN + _TESTS, desc="FEM at draws", disable=not progress, unit="run"
    ) as bar:  # fmt: skip
        run_model, _ = before_runs(_model(at_rest, several, target), target.scene)
        data = {name: jnp.zeros(shape) for name, shape in several.shapes.items()}
        predictive = Predictive(run_model, data)
        solver = FEMRunner(predictive, FEMLikelihood(run_model, simulator, kept=kept), bar)
        z = predictive.unconstrain(target.draws)
        values, runs, missed = _by_process(solver, z, most_runs, rng)
    emulator, _ = add_discrepancy(Emulator(target.scene), runs_of(kept))
    thetas = target.states.thetas(target.draws)
    shaped = jax.vmap(several.unravel)(jnp.asarray(values))
    failed = int((~runs.converged).sum())
    warnings = _faults(failed, len(runs.z), missed)
    return Predicted(
        target.scene, several, target.draws, target.sources,
        {name: np.asarray(v) for name, v in shaped.items()},
        len(runs.z), failed, missed, emulator.cache(), thetas, warnings,
    )  # fmt: skip


def _model(forward: CachedEmulator, observe: Observations, target: Transfer) -> Model:
    """Return a model whose unknowns are the target draws'; its noise is of no consequence."""
    entries = zip(target.states.states, target.states.entries, strict=True)
    known = {
        in_state(name, state): source
        for state, row in entries
        for name, source in zip(target.scene.parameter_names, row, strict=True)
        if isinstance(source, float)
    }
    noise = {name: GaussianNoise(sd=1.0) for name in observe.bases}
    return model(forward, observe, noise, known=known, check_scale=False)


def _by_process(
    solver: FEMRunner, z: np.ndarray, most: int, rng: np.random.Generator
) -> tuple[np.ndarray, FEMRuns, float]:
    """Return the data (s, m) at points z (s, p), FEM's runs, and by how much tests were missed."""
    x = z / np.maximum(z.std(axis=0), 1e-12 * np.abs(z).max() + 1e-300)
    left = list(range(len(z)))

    def solved(rows: np.ndarray) -> FEMRuns:
        taken = [left[k] for k in rows]
        for row in taken:
            left.remove(row)
        return solver(z[taken], slopes=True)

    runs = solved(maximin_subset(x[left], min(_BEGIN, len(left))))
    missed = np.inf
    while True:
        _require_most(runs)
        scales = np.maximum(runs.means[runs.converged].std(axis=0), 1e-300)
        correction = correction_from(runs, solver.predictive, most + _BEGIN, scales)
        values = solver.predictive.corrected_means(z, correction)
        if missed <= _MISSED or len(runs.z) >= most or not left:
            return values, runs, float(missed if left else 0.0)
        count = min(_TESTS, len(left), most - len(runs.z))
        rows = rng.choice(len(left), size=count, replace=False)
        known = [left[k] for k in rows]
        solver.bar.total = max(len(runs.z) + count, solver.bar.total)
        tests = solved(rows)
        there, smallest = tests.converged, max(1e-12 * np.abs(values).max(), 1e-300)
        spread = np.maximum(values.std(axis=0), smallest)
        gap = (tests.means[there] - values[known][there]) / spread
        missed = float(np.sqrt(np.mean(gap**2))) if there.any() else np.inf
        if there.any() and not np.isfinite(missed):
            raise SolverError("prediction: FEM at further draws is foreseen by no finite number")
        solver.bar.set_postfix_str(f"missed by {missed:.2g} sd")
        runs = FEMRuns.joined([runs, tests])


def _of_states(learned: Learned, target: Transfer, observe: Observations) -> Predicted:
    """Return the predictions of a specimen, whose states are solved at each draw.

    They keep their volume where those that the draws were learned on did.
    """
    incompressible = all(getattr(body, "incompressible", False) for body, _ in learned.bodies)
    (homogeneous,) = offered("emulator.specimens.homogeneous", "homogeneous")
    forward = homogeneous(target.scene, incompressible=incompressible)
    thetas = target.states.thetas(target.draws)
    data, valid = jax.jit(lambda t: jax.lax.map(observe.through(forward), t))(thetas)
    valid = np.asarray(valid)
    failed = int((~valid).sum())
    if failed > 0.2 * len(valid):
        raise SolverError(_FAILS.format(failed=failed, count=len(valid)))
    return Predicted(
        target.scene, observe, {n: v[valid] for n, v in target.draws.items()}, target.sources,
        {name: np.asarray(values)[valid] for name, values in data.items()},
        len(valid), failed, 0.0, forward, thetas[valid], _faults(failed, len(valid), 0.0),
    )  # fmt: skip


_FAILS = (
    "FEM fails at {failed} of {count} draws: the loads of this scene are too large for them, or "
    "raise --load-steps"
)


def _require_most(runs: FEMRuns) -> None:
    failed = int((~runs.converged).sum())
    if failed > 0.2 * len(runs.z):
        raise SolverError(_FAILS.format(failed=failed, count=len(runs.z)))


def _faults(failed: int, count: int, missed: float) -> list[str]:
    """Return a sentence for draws at which FEM failed, and for tests that were missed."""
    sentences = []
    if failed:
        sentences.append(
            f"FEM failed at {failed} of {count} draws, which the bands do not stand for"
        )
    if not missed <= _MISSED:
        sentences.append(
            f"FEM at further draws is missed by {missed:.2g} sd of the band, more than {_MISSED}: "
            "allow more runs (--most-runs)"
        )
    return sentences
