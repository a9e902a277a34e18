"""How far two posteriors are apart, with the error of the distance."""

from itertools import combinations
from typing import Any

import numpy as np
from studies.fem_posterior.methods import Weighed

from calibrate.certificate.estimates import jackknife, moments
from calibrate.importance.weights import effective, normalised

MOMENTS = ("mean", "mean_error", "sd", "sd_error")


def of_weights(weighed: Weighed, names: tuple[str, ...]) -> dict[str, Any]:
    """FEM's mean and sd less the emulator's, from FEM's weights at the emulator's draws.

    Both moments are of the same draws, so that the draws' own error cancels.
    """
    weights, p = normalised(weighed.log_weights), len(names)
    sd = weighed.x.std(axis=0)

    def change(used: np.ndarray) -> np.ndarray:
        found = moments(weighed.x, weights * used) - moments(weighed.x, 1.0 * used)
        return np.concatenate([found[:p] / sd, found[p : 2 * p]])

    value, error = jackknife(change, len(weights))
    return {
        "draws": len(weights),
        "failed": int((~np.isfinite(weighed.log_weights)).sum()),
        "effective_weights": effective(weights),
        "log_weight_sd": float(np.std(weighed.log_weights)),
        "shift": dict(zip(names, value[:p].tolist(), strict=True)),
        "shift_error": dict(zip(names, error[:p].tolist(), strict=True)),
        "log_sd": dict(zip(names, value[p:].tolist(), strict=True)),
        "log_sd_error": dict(zip(names, error[p:].tolist(), strict=True)),
        "processor_s": weighed.seconds,
    }


def of_runs(one: dict[str, Any], other: dict[str, Any], names: list[str]) -> dict[str, Any]:
    """Mean (in sd) and log sd of run ``one`` less those of ``other``, with Monte Carlo errors."""
    a, b = ({k: np.array(run[k]) for k in MOMENTS} for run in (one, other))
    shift = (a["mean"] - b["mean"]) / b["sd"]
    shift_error = np.hypot(a["mean_error"], b["mean_error"]) / b["sd"]
    log_sd = np.log(a["sd"] / b["sd"])
    log_sd_error = np.hypot(a["sd_error"] / a["sd"], b["sd_error"] / b["sd"])
    z = np.concatenate([shift / shift_error, log_sd / log_sd_error])
    return {
        "of": one["method"],
        "against": other["method"],
        "shift": dict(zip(names, shift.tolist(), strict=True)),
        "shift_error": dict(zip(names, shift_error.tolist(), strict=True)),
        "log_sd": dict(zip(names, log_sd.tolist(), strict=True)),
        "log_sd_error": dict(zip(names, log_sd_error.tolist(), strict=True)),
        "largest_z": float(np.abs(z).max()),
        "rms_z": float(np.sqrt(np.mean(z**2))),
    }


def with_agreement(case: dict[str, Any]) -> dict[str, Any]:
    """``case`` with every two of its runs compared."""
    pairs = combinations(reversed(case["runs"]), 2)
    return {**case, "agreement": [of_runs(one, other, case["names"]) for one, other in pairs]}


def cost(run: dict[str, Any]) -> dict[str, float]:
    """FEM solves an effective draw: as run, of kept draws, of 1000 after the same warm-up."""
    kept = run["kept_fem_solves"] / run["effective"]
    warmup = run["fem_solves"] - run["kept_fem_solves"]
    return {
        "as run": run["fem_solves"] / run["effective"],
        "kept": kept,
        "of 1000": kept + warmup / 1000.0,
    }


def largest(found: dict[str, Any], key: str) -> tuple[float, float]:
    """The largest of some differences, and its error."""
    name = max(found[key], key=lambda n: abs(found[key][n]))
    return abs(found[key][name]), found[f"{key}_error"][name]
