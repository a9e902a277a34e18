"""FEM's posterior in place of the map's: draws of the corrected map, where a check allows it."""

from __future__ import annotations

import json
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from calibrate.certificate.check import Check, examine
from calibrate.certificate.verdict import Certificate
from calibrate.importance.weights import effective
from calibrate.posterior import Posterior
from calibrate.posterior.diagnosis import MAP_ERRORS, MAP_MOVES
from calibrate.posterior.posterior import make_tree
from calibrate.samplers.modes import MISSED_AT, MISSED_BY
from emulator.core.errors import InputError, check_arguments
from emulator.fem.solution import EquilibriumSolver

_CHAINS = 4  # chains of a reweighted posterior
_OF_OTHER_DRAWS = (
    "log_evidence", "log_evidence_error", "pareto_k", "importance_efficiency", MISSED_BY, MISSED_AT,
    MAP_ERRORS, MAP_MOVES, "weights_pareto_k", "evaluations", "effective_points",
)  # fmt: skip


def reweight(
    posterior: Posterior, simulator: EquilibriumSolver, *, seed: int = 0, **options: Any
) -> Posterior:
    """Return FEM's posterior in place of ``posterior``, checked as by :func:`examine`.

    Raises
    ------
    InputError
        As :func:`examine`; or the verdict is neither ``accepted`` nor ``reweight``, so that nothing
        says the reweighted posterior is FEM's.
    """
    check_arguments(options, "reweight", examine)
    return reweighted(examine(posterior, simulator, seed=seed, **options), seed=seed)


def can_reweight(certificate: Certificate) -> bool:
    """Return whether the reweighted posterior is FEM's, as far as the check can tell."""
    return certificate.verdict in ("accepted", "reweight")


def reweighted(check: Check, *, seed: int = 0) -> Posterior:
    """Return the corrected map's posterior as 4 chains of independent draws.

    They are resampled from the pool, 1000 draws or as many as the pool has effective points,
    whichever is less; equal ones occur. Their number and the verdict are in the attributes
    ``reweighted``. Log likelihoods and replicated data are of the corrected map's data.

    Raises
    ------
    InputError
        The verdict is neither ``accepted`` nor ``reweight``.
    """
    verdict = check.certificate.verdict
    if not can_reweight(check.certificate):
        raise InputError(
            f"reweight: the verdict is '{verdict}' ({check.certificate.reason}); a reweighted "
            "posterior needs 'reweight' or 'accepted'"
        )
    pool, predictive, source = check.pool, check.pool.predictive, check.posterior
    points = effective(pool.corrected)
    shape = (_CHAINS, int(min(points, 1000.0) // _CHAINS))
    rows = pool.resampled(shape[0] * shape[1], np.random.default_rng([seed, 1]))
    by_name = predictive.constrain(pool.z[rows])
    draws = {name: by_name[name].reshape(shape) for name in source.model.names}
    statistics = {"lp": (pool.at.prior + pool.at.corrected)[rows].reshape(shape)}
    flat = jnp.asarray(predictive.corrected_means(pool.z[rows], pool.correction))
    means = jax.vmap(jax.vmap(source.model.observe.unravel))(flat.reshape(*shape, -1))
    means = jax.tree.map(np.asarray, means)
    tree = make_tree(source.model, source.data, draws, statistics, jax.random.key(seed), means)
    attributes = {n: a for n, a in source.tree.attrs.items() if n not in _OF_OTHER_DRAWS}
    tree.attrs.update(attributes)
    tree.attrs["reweighted"] = json.dumps({"verdict": verdict, "effective_points": points})
    return Posterior(tree, source.model, source.data)
