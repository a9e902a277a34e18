"""FEM's posterior as draws, from the points of a check."""

from __future__ import annotations

import json

import jax
import jax.numpy as jnp
import numpy as np

from calibrate.certificate.check import Check, examine, resampled
from calibrate.certificate.verdict import Certificate
from calibrate.posterior import Posterior
from calibrate.posterior.tree import make_tree
from calibrate.samplers.importance import effective
from calibrate.samplers.modes import MISSED_AT, MISSED_BY
from emulator.core.errors import InputError
from emulator.fem import Simulator

_CHAINS = 4
_OF_OTHER_DRAWS = (
    "log_evidence", "log_evidence_error", "pareto_k", "importance_efficiency", MISSED_BY, MISSED_AT,
)  # fmt: skip


def reweight(
    posterior: Posterior,
    simulator: Simulator,
    *,
    draws: int | None = None,
    seed: int = 0,
    progress: bool = False,
) -> Posterior:
    """FEM's posterior in place of ``posterior``, checked with ``draws`` FEM runs.

    Raises
    ------
    InputError
        As :func:`calibrate.certify`; or the verdict is neither ``accepted`` nor ``reweight``, so
        that nothing says the reweighted posterior is FEM's.
    """
    check = examine(posterior, simulator, draws=draws, seed=seed, progress=progress)
    return reweighted(check, seed=seed)


def keeps(certificate: Certificate) -> bool:
    """Whether the reweighted posterior is FEM's, as far as the check can tell."""
    return certificate.verdict in ("accepted", "reweight")


def reweighted(check: Check, *, seed: int = 0) -> Posterior:
    """The corrected map's posterior as 4 chains of independent draws.

    Resampled from the pool, 1000 draws or as many as the pool has effective points, whichever is
    less; equal ones occur. Their number and the verdict are in the attributes ``reweighted``. Log
    likelihoods and replicated data are of the corrected map's data.

    Raises
    ------
    InputError
        The verdict is neither ``accepted`` nor ``reweight``.
    """
    verdict = check.certificate.verdict
    if not keeps(check.certificate):
        raise InputError(
            f"reweight: the verdict is '{verdict}' ({check.certificate.reason}); a reweighted "
            "posterior needs 'reweight' or 'accepted'"
        )
    points = effective(check.pool.corrected)
    length = int(min(points, 1000.0) // _CHAINS)
    rows = resampled(check.pool, _CHAINS * length, np.random.default_rng([seed, 1]))
    drawn = check.predictive.constrain(check.pool.z[rows])
    posterior, at = check.posterior, check.pool.at
    shape = (_CHAINS, length)
    draws = {name: drawn[name].reshape(shape) for name in posterior.model.names}
    statistics = {"lp": (at.prior + at.corrected)[rows].reshape(shape)}
    flat = check.predictive.corrected_means(check.pool.z[rows], check.correction)
    by_name = jax.vmap(jax.vmap(check.predictive.by_name))(jnp.asarray(flat.reshape(*shape, -1)))
    means = {name: np.asarray(mean) for name, mean in by_name.items()}
    key = jax.random.key(seed)
    tree = make_tree(posterior.model, posterior.data, draws, statistics, key, means)
    kept = {n: a for n, a in posterior.tree.attrs.items() if n not in _OF_OTHER_DRAWS}
    tree.attrs.update(kept)
    tree.attrs["reweighted"] = json.dumps({"verdict": verdict, "effective_points": points})
    return Posterior(tree, posterior.model, posterior.data)
