"""Certificates of one posterior again and again: is their shift of a mean noise, or bias?

A certificate's shift of a mean has four terms, in sd of the draws:

    corrected pool - FEM's (unknown)        the pool's Monte Carlo error
    tests by FEM less tests by the map      a step, about zero for a good map
    - (draws' mean - FEM's mean)            the draws' own Monte Carlo error

A long run of the emulator, weighted by FEM, gives FEM's mean; so each is measured.
"""

from typing import Any

import numpy as np
from arviz_stats.base import array_stats
from studies.fem_posterior.comparison import of_weights
from studies.fem_posterior.methods import AXES, stacked, weigh
from studies.fem_posterior.problems import Problem

import calibrate as cal
from calibrate.certificate import examine
from calibrate.certificate.check import Check
from calibrate.certificate.estimates import jackknife, moments
from calibrate.importance.weights import normalised
from calibrate.samplers.nuts import NUTSOptions

SHIFT = "shift, less FEM's change"
SHIFT_AND_DRAWS = "the same, its error with the draws'"
MEAN = "certificate's mean, less FEM's"
DRAWS = "draws' mean, less the emulator's"
PAIRED = "paired change, less FEM's"


def parts_of(check: Check) -> dict[str, np.ndarray]:
    """Means (p,) by the pool, with and without correction, and what FEM changes of them.

    paired : corrected less uncorrected pool, plus the step; its error by a jackknife of the
    difference, in which the pool's error cancels.
    """
    names = check.posterior.model.names
    here = check.pool.predictive.constrain(check.pool.z)
    x = np.stack([here[name] for name in names], axis=1)
    p, pool = len(names), check.pool
    corrected, cheap = pool.corrected, normalised(pool.log_cheap)
    error = jackknife(lambda used: moments(x, corrected * used), len(x))[1][:p]
    change, change_error = jackknife(
        lambda used: moments(x, corrected * used) - moments(x, cheap * used), len(x)
    )
    evidence = check.certificate.evidence
    mean = np.array([f.value for f in evidence.mean.values()])
    base = moments(x, corrected)[:p]
    total_error = np.array([f.error for f in evidence.mean.values()])
    step_error = np.sqrt(np.maximum(total_error**2 - error**2, 0.0))
    return {
        "pool": base,
        "pool_error": error,
        "step": mean - base,
        "step_error": step_error,
        "mean": mean,
        "mean_error": total_error,
        "paired": change[:p] + mean - base,
        "paired_error": np.hypot(change_error[:p], step_error),
        "uncorrected": moments(x, cheap)[:p],
    }


def certificates(
    problem: Problem, count: int = 8, long: int = 6000, weighed: int = 600, posteriors: int = 4
) -> dict[str, Any]:
    """``count`` certificates of ``posteriors`` posteriors, against a run of ``long`` draws."""
    names = problem.cheap.names
    reference = cal.sample(
        problem.cheap, problem.data, options=NUTSOptions(draws=long, rounds=1), seed=1000,
        predictions=False,
    )  # fmt: skip
    draws = stacked(reference)
    flat = draws.reshape(-1, len(names))
    sd = flat.std(axis=0)
    by_weights = of_weights(weigh(problem, reference, weighed), names)
    moved = np.array(list(by_weights["shift"].values()))
    truth = flat.mean(axis=0) + moved * sd
    truth_error = np.hypot(
        errors_of_means(draws) / sd,
        list(by_weights["shift_error"].values()),
    )
    rows = []
    for k in range(count):
        if k % (count // posteriors) == 0:
            posterior = cal.sample(problem.cheap, problem.data, seed=k, predictions=False)
            own = stacked(posterior)
            own_mean = own.reshape(-1, len(names)).mean(axis=0)
            own_error = [
                array_stats.mcse(x, method="mean", **AXES) for x in np.moveaxis(own, -1, 0)
            ]
        check = examine(posterior, problem.simulator, seed=k)
        found = parts_of(check)
        rows.append(
            {
                "seed": k,
                "verdict": check.certificate.verdict,
                "pool_points": check.certificate.evidence.tail.pool,
                "draws": ((own_mean - truth) / sd).tolist(),
                "draws_error": (own_error / sd).tolist(),
                "shift": [f.value for f in check.certificate.evidence.draws.shift.values()],
                "shift_error": [f.error for f in check.certificate.evidence.draws.shift.values()],
                **{key: ((v - truth) / sd).tolist() for key, v in found.items()
                   if key in ("pool", "mean", "uncorrected")},
                **{key: (v / sd).tolist() for key, v in found.items()
                   if key not in ("pool", "mean", "uncorrected")},
            }
        )  # fmt: skip
        print(k, names[int(np.argmax(np.abs(rows[-1]["shift"])))], _round(rows[-1]), flush=True)
    case = {
        "name": f"certificates of the {problem.name}",
        "status": "measured",
        "names": list(names),
        "reference_effective": float(
            min(array_stats.ess(x, method="bulk", **AXES) for x in np.moveaxis(draws, -1, 0))
        ),
        "reference_error": truth_error.tolist(),
        "weights": by_weights,
        "certificates": rows,
    }
    return {**case, "summary": summary(case)}


def errors_of_means(draws: np.ndarray) -> np.ndarray:
    """Monte Carlo errors (p,) of the means of draws (chains, draws, p)."""
    columns = np.moveaxis(draws, -1, 0)
    return np.array([array_stats.mcse(x, method="mean", **AXES) for x in columns])


def summary(case: dict[str, Any]) -> dict[str, Any]:
    """Each term less what it should be, in sd: average, scatter, and errors claimed for it."""
    rows = case["certificates"]
    change, change_error = (
        np.array(list(case["weights"][key].values())) for key in ("shift", "shift_error")
    )

    def of(key: str) -> np.ndarray:
        return np.array([row[key] for row in rows])

    known = np.array(case["reference_error"])
    terms = {
        SHIFT: (of("shift") - change, of("shift_error")),
        SHIFT_AND_DRAWS: (of("shift") - change, np.hypot(of("shift_error"), of("draws_error"))),
        MEAN: (of("mean"), np.hypot(of("mean_error"), known)),
        DRAWS: (of("draws") + change, np.hypot(of("draws_error"), known)),
        PAIRED: (of("paired") - change, np.hypot(of("paired_error"), change_error)),
    }
    return {
        name: {
            "average": values.mean(axis=0).tolist(),
            "rms": _rms(values),
            "largest": float(np.abs(values).max()),
            "claimed": _rms(errors),
            "rms_z": _rms(values / errors),
        }
        for name, (values, errors) in terms.items()
    }


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _round(row: dict[str, Any]) -> dict[str, Any]:
    return {k: np.round(v, 3).tolist() for k, v in row.items() if isinstance(v, list)}
