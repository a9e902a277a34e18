r"""What the data determines: single parameters, correlated pairs, products of powers.

Stiffness and load can rise together and leave the body where it is; a table of marginals hides
that. In :math:`x = \log\theta`, with covariances :math:`S` of the posterior and :math:`P` of the
prior, the combinations :math:`\prod_k \theta_k^{w_k}` that the data determines, best first, solve

.. math:: S w = \lambda P w

and :math:`1 - \sqrt\lambda` is how far each has contracted.
"""

from __future__ import annotations

from typing import Any

import jax
import numpy as np
from scipy.linalg import eigh

from calibrate.posterior import Posterior
from calibrate.statistical_model import Model

_PRIOR_DRAWS = 4096
# Exponents are told rounded, to be readable; those that round to zero are left out.
_DIGITS = 1
_LEARNED = 0.95  # largest share of its prior sd that a combination is told with
_TOGETHER = 0.7  # least absolute correlation of pairs that are told
_BEST = 2  # combinations that are told


def identify(posterior: Posterior) -> dict[str, Any]:
    """Contraction, correlations and identified combinations, as plain JSON.

    Returns
    -------
    contraction : per parameter, 1 - sd of the posterior / sd of the prior, on the parameter's
        scale: 0 where nothing was learned, 1 where the posterior has no width.
    correlation : first -> second -> correlation, posterior, on the parameters' scales.
    combinations : best known first, each with its ``exponents``, its relative sd ``known_to`` in
        the posterior and ``prior`` in the prior; empty where a parameter may be 0 or below.
    """
    model = posterior.model
    names, draws = model.states.unknowns, posterior.draws()
    after = np.stack([draws[name] for name in names], axis=1)
    before = prior_table(model)
    log = np.array(model.on_log_scale)
    x, prior = (_on_scale(thetas, log) for thetas in (after, before))
    contraction = 1.0 - x.std(axis=0, ddof=1) / prior.std(axis=0, ddof=1)
    correlation = np.atleast_2d(np.corrcoef(x, rowvar=False))
    positive = bool((after > 0.0).all() and (before > 0.0).all())
    covariances = [
        np.atleast_2d(np.cov(np.log(t), rowvar=False)) for t in (after, before)
    ] * positive
    return {
        "contraction": dict(zip(names, contraction.tolist(), strict=True)),
        "correlation": {
            first: {second: float(correlation[j, k]) for k, second in enumerate(names)}
            for j, first in enumerate(names)
        },
        "combinations": combinations(names, *covariances) if positive else [],
    }


def prior_table(model: Model) -> np.ndarray:
    """Draws (s, q) of the unknowns of theta from their prior."""
    draws = model.prior_draws(jax.random.key(0), _PRIOR_DRAWS)
    return np.stack([np.asarray(draws[name]) for name in model.states.unknowns], axis=1)


def _on_scale(thetas: np.ndarray, log: np.ndarray) -> np.ndarray:
    return np.where(log, np.log(np.where(log, thetas, 1.0)), thetas)


def combinations(
    names: tuple[str, ...], after: np.ndarray, before: np.ndarray
) -> list[dict[str, Any]]:
    """Products of powers of which something was learned, the most contracted first.

    Parameters
    ----------
    after, before : (q, q) covariances of log theta, of the posterior and of the prior.
    """
    _, directions = eigh(after, before)  # eigenvalues ascend
    prior_sd = np.sqrt(np.diagonal(before))
    found = []
    for w in directions.T:
        # The parameter that contributes most to its variance under the prior has exponent 1.
        leading = int(np.argmax(np.abs(w) * prior_sd))
        exponents = w / w[leading]
        sds = [float(np.sqrt(exponents @ S @ exponents)) for S in (after, before)]
        if sds[0] > _LEARNED * sds[1]:
            continue
        rounded = np.round(exponents, _DIGITS) + 0.0
        kept = {n: float(e) for n, e in zip(names, rounded, strict=True) if e}
        found.append({"exponents": kept, "known_to": sds[0], "prior": sds[1]})
    return sorted(found, key=lambda entry: entry["known_to"] / entry["prior"])


def in_words(found: dict[str, Any]) -> str:
    """The result in words: contractions, correlated pairs, the best combinations."""
    learned = ", ".join(f"{name} {100 * c:.0f} %" for name, c in found["contraction"].items())
    lines = [f"learned from the data (1 - sd / prior sd): {learned}"]
    names = list(found["correlation"])
    together = [
        f"{first} and {second} ({found['correlation'][first][second]:+.2f})"
        for k, first in enumerate(names)
        for second in names[k + 1 :]
        if abs(found["correlation"][first][second]) >= _TOGETHER
    ]
    lines.append(f"only known together: {', '.join(together) or 'none'}")
    return "\n".join([*lines, *products_in_words(found["combinations"], _BEST)])


def products_in_words(combinations: list[dict[str, Any]], best: int) -> list[str]:
    """The ``best`` combinations, a line each."""
    return [
        f"known best: {_product(entry['exponents'])} to {100 * entry['known_to']:.2g} % "
        f"(prior {100 * entry['prior']:.2g} %)"
        for entry in combinations[:best]
    ]


def _product(exponents: dict[str, float]) -> str:
    """As a quotient, the largest exponents first."""
    ordered = sorted(exponents.items(), key=lambda item: -abs(item[1]))

    def factors(sign: float) -> str:
        return " ".join(
            name if sign * e == 1.0 else f"{name}^{sign * e:g}"
            for name, e in ordered
            if sign * e > 0
        )

    above, below = factors(1.0), factors(-1.0)
    if not below:
        return above
    return f"{above or 1} / {f'({below})' if ' ' in below else below}"
