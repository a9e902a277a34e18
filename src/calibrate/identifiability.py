r"""What the data has fixed: single parameters, pairs that move together, products of powers.

Stiffness and load can rise together and leave the body where it is; a table of marginals hides
that. In :math:`x = \log\theta`, with covariances :math:`S` of the posterior and :math:`P` of the
prior, the combinations :math:`\prod_k \theta_k^{w_k}` the data speaks about, one after the other,
solve

.. math:: S w = \lambda P w

and :math:`1 - \sqrt\lambda` is how far each has contracted.
"""

from __future__ import annotations

from typing import Any

import jax
import numpy as np
from scipy.linalg import eigh

from calibrate.posterior import Posterior

_PRIOR_DRAWS = 4096
# Exponents are rounded for people; those that round to zero are left out.
_DIGITS = 1


def identifiability(posterior: Posterior) -> dict[str, Any]:
    """Contraction, correlations and identified combinations, as plain JSON.

    Returns
    -------
    contraction : per parameter, 1 less the posterior's sd over the prior's, on the parameter's
        scale: 0 nothing learned, 1 all.
    correlation : first -> second -> correlation, posterior, on the parameters' scales.
    combinations : best known first, each with its ``exponents``, its relative sd ``known_to`` and
        ``prior`` that of the prior; empty where a parameter may be 0 or below.
    """
    scene = posterior.model.forward.scene
    names = scene.parameter_names
    after = np.asarray(posterior.thetas())
    before = _prior_draws(posterior)
    log = np.array([parameter.scale == "log" for parameter in scene.parameters])
    x, prior = (_on_scale(thetas, log) for thetas in (after, before))
    contraction = 1.0 - x.std(axis=0, ddof=1) / prior.std(axis=0, ddof=1)
    correlation = np.atleast_2d(np.corrcoef(x, rowvar=False))
    positive = bool((after > 0.0).all() and (before > 0.0).all())
    return {
        "contraction": dict(zip(names, contraction.tolist(), strict=True)),
        "correlation": {
            first: {second: float(correlation[j, k]) for k, second in enumerate(names)}
            for j, first in enumerate(names)
        },
        "combinations": _combinations(names, np.log(after), np.log(before)) if positive else [],
    }


def _prior_draws(posterior: Posterior) -> np.ndarray:
    """Theta (s, p) from the prior."""
    prior, names = posterior.model.prior, posterior.model.forward.scene.parameter_names
    keys = jax.random.split(jax.random.key(0), len(names))
    return np.stack(
        [prior[n].sample(key, (_PRIOR_DRAWS,)) for n, key in zip(names, keys, strict=True)], axis=1
    )


def _on_scale(thetas: np.ndarray, log: np.ndarray) -> np.ndarray:
    return np.where(log, np.log(np.where(log, thetas, 1.0)), thetas)


def _combinations(
    names: tuple[str, ...], after: np.ndarray, before: np.ndarray
) -> list[dict[str, Any]]:
    """Directions in log theta (s, p), the one that has contracted most first."""
    covariances = [np.atleast_2d(np.cov(x, rowvar=False)) for x in (after, before)]
    _, directions = eigh(*covariances)  # eigenvalues ascend
    spread = before.std(axis=0)
    found = []
    for w in directions.T:
        # The parameter whose prior range it takes most of has exponent 1.
        leading = int(np.argmax(np.abs(w) * spread))
        exponents = np.round(w / w[leading], _DIGITS) + 0.0
        sds = [float((x @ exponents).std(ddof=1)) for x in (after, before)]
        kept = {n: float(e) for n, e in zip(names, exponents, strict=True) if e}
        found.append({"exponents": kept, "known_to": sds[0], "prior": sds[1]})
    return sorted(found, key=lambda entry: entry["known_to"] / entry["prior"])


def in_words(found: dict[str, Any], *, pairs: float = 0.7, best: int = 2) -> str:
    """The result for people: contractions, pairs that move together, the best combinations.

    Parameters
    ----------
    pairs : least correlation, either way, of the pairs that are named.
    best : number of combinations that are named.
    """
    learned = ", ".join(f"{name} {100 * c:.0f} %" for name, c in found["contraction"].items())
    lines = [f"learned from the data (1 - sd / prior sd): {learned}"]
    names = list(found["correlation"])
    together = [
        f"{first} and {second} ({found['correlation'][first][second]:+.2f})"
        for k, first in enumerate(names)
        for second in names[k + 1 :]
        if abs(found["correlation"][first][second]) >= pairs
    ]
    lines.append(f"only known together: {', '.join(together) or 'none'}")
    for entry in found["combinations"][:best]:
        lines.append(
            f"known best: {_product(entry['exponents'])} to {100 * entry['known_to']:.2g} % "
            f"(prior {100 * entry['prior']:.2g} %)"
        )
    return "\n".join(lines)


def _product(exponents: dict[str, float]) -> str:
    ordered = sorted(exponents.items(), key=lambda item: -abs(item[1]))
    return " ".join(name if e == 1.0 else f"{name}^{e:g}" for name, e in ordered)
