r"""Reference draws, ``references/<name>.csv``: FEM's posterior by importance sampling.

Draws :math:`\theta_k` of the emulator's posterior by long NUTS chains, thinned until they are
nearly independent, are weighted by FEM,

.. math:: w_k \propto L_\mathrm{FEM}(\theta_k) / L_\mathrm{emulator}(\theta_k).

One solve a draw. Less than 80 % of the weights in effect, a solve that fails, or R-hat above 1.01
refuse the reference.
"""

import time
from pathlib import Path

import numpy as np
from studies.common.output import Case
from studies.inverse_benchmark import tables
from studies.inverse_benchmark.problems import Problem, data_of, model

import calibrate as cal
import emulator as em

REFERENCES = Path(__file__).parent / "references"
DRAWS = 1000
OPTIONS = cal.samplers.NUTSOptions(warmup=500, draws=1000, chains=4, rounds=6)
LARGEST_R_HAT, SMALLEST_ESS = 1.01, 0.8


def path_of(problem: Problem) -> Path:
    """The file of a problem's reference draws."""
    return REFERENCES / f"{problem.name}.csv"


def make(
    problem: Problem, forward: em.ForwardMap, simulator: em.Simulator, draws: int = DRAWS
) -> Case:
    """Draw, weigh and write a reference; how good it is.

    Raises
    ------
    SystemExit
        It is not good enough.
    """
    began, statistical = time.process_time(), model(problem, forward)
    data = data_of(problem)
    posterior = cal.sample(statistical, data, options=OPTIONS, seed=1, predictions=False)
    table = posterior.summary()
    all_draws = posterior.draws()
    rows = np.linspace(0, len(next(iter(all_draws.values()))) - 1, draws).astype(int)
    likelihood = cal.FEMLikelihood(statistical, simulator)
    found = [
        likelihood({name: values[row] for name, values in all_draws.items()}, data) for row in rows
    ]
    log_w = np.array([each.fem - each.cheap for each in found])
    failed = int((~np.isfinite(log_w)).sum())
    weights = np.exp(log_w - log_w.max())
    weights /= weights.sum()
    case = {
        "problem": problem.name,
        "r_hat": max(row["r_hat"] for row in table.values()),
        "ess": min(row["ess_bulk"] for row in table.values()),
        "divergences": posterior.divergences,
        "failed": failed,
        "log_weight_sd": float(np.std(log_w)),
        "weights_ess": float(1.0 / np.sum(weights**2) / draws),
        "seconds": time.process_time() - began,
    }
    sound = case["r_hat"] < LARGEST_R_HAT and case["weights_ess"] > SMALLEST_ESS
    if failed or not sound:
        raise SystemExit(f"{problem.name}: no reference to trust: {case}")
    scene = simulator.scene
    columns = np.column_stack([all_draws[name][rows] for name in scene.parameter_names])
    tables.write(path_of(problem), scene.parameter_names, columns, weights)
    return case
