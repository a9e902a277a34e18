r"""What data determined, what it says of the tissue's stress, and what to measure next.

**Combinations.** Stiffness and load can rise together and leave the body where it is; a table of
marginals hides that. In :math:`x = \log\theta`, with covariances :math:`S` of the posterior and
:math:`P` of the prior, the combinations :math:`\prod_k \theta_k^{w_k}` that the data determines,
best first, solve

.. math:: S w = \lambda P w

and :math:`1 - \sqrt\lambda` is how far each has contracted.

**Stress.** The stress-stretch curve is often well known where the parameters are not. Along an
isochoric stretch :math:`\lambda` of direction e, transversely :math:`\lambda^{-1/2}`,

.. math:: F = \lambda\, e \otimes e + \lambda^{-1/2} (I - e \otimes e), \qquad
          \sigma_{ee} - \sigma_\perp = \lambda \frac{dW}{d\lambda}

with :math:`\sigma_\perp` the mean of the two transverse Cauchy stresses: J is 1 on the whole path,
so that :math:`\dot W = \sigma : d` and :math:`d = \frac{\dot\lambda}{\lambda}\,
\text{diag}(1, -\frac12, -\frac12)`. The pressure that incompressibility leaves free drops out.

**Next measurement.** A candidate :math:`y' = g'(x) + \varepsilon'` with the information F' about x
(:mod:`~calibrate.analysis.fisher`) would add to the present posterior, of covariance C,

.. math:: \Delta = \tfrac12 \log_2 \det\left(1 + C F'\right) \text{ bits},

where the map is linear over the posterior (Lindley 1956; Chaloner and Verdinelli 1995). The gain is
averaged over draws of the posterior; no data is simulated and no posterior sampled. A candidate has
its own noise only: an error that it would share with the present data is not counted.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg import eigh

from calibrate.analysis.fisher import information_at
from calibrate.measurements import Observation, Observations
from calibrate.noise import Noise
from calibrate.posterior import Posterior
from calibrate.statistical_model import Model
from emulator.core.errors import InputError, look_up
from emulator.fem.energy import point_energy
from emulator.scenes.scene import Scene
from emulator.scenes.tissue import Tissue

_PRIOR_DRAWS = 4096
# Exponents are rounded to be readable; those that round to zero are left out.
_DIGITS = 1
_LEARNED = 0.95  # largest posterior sd over prior sd of a reported combination
_TOGETHER = 0.7  # least absolute correlation of reported pairs
_BEST = 2  # reported combinations


def identify(posterior: Posterior) -> dict[str, Any]:
    """Return contraction, correlations and identified combinations, as plain JSON.

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
    """Return draws (s, q) of the unknowns of theta from their prior."""
    draws = model.prior_draws(jax.random.key(0), _PRIOR_DRAWS)
    return np.stack([np.asarray(draws[name]) for name in model.states.unknowns], axis=1)


def _on_scale(thetas: np.ndarray, log: np.ndarray) -> np.ndarray:
    return np.where(log, np.log(np.where(log, thetas, 1.0)), thetas)


def combinations(
    names: tuple[str, ...], after: np.ndarray, before: np.ndarray
) -> list[dict[str, Any]]:
    """Return the products of powers that the data informs, the most contracted first.

    Parameters
    ----------
    after, before : (q, q) covariances of log theta, of the posterior and of the prior.
    """
    _, directions = eigh(after, before)  # eigenvalues ascend
    prior_sd = np.sqrt(np.diagonal(before))
    products = []
    for w in directions.T:
        # The parameter that contributes most to its variance under the prior has exponent 1.
        leading = int(np.argmax(np.abs(w) * prior_sd))
        exponents = w / w[leading]
        sds = [float(np.sqrt(exponents @ S @ exponents)) for S in (after, before)]
        if sds[0] > _LEARNED * sds[1]:
            continue
        rounded = np.round(exponents, _DIGITS) + 0.0
        nonzero = {n: float(e) for n, e in zip(names, rounded, strict=True) if e}
        products.append({"exponents": nonzero, "known_to": sds[0], "prior": sds[1]})
    return sorted(products, key=lambda entry: entry["known_to"] / entry["prior"])


def in_words(result: dict[str, Any]) -> str:
    """Return the result in words: contractions, correlated pairs, the best combinations."""
    learned = ", ".join(f"{name} {100 * c:.0f} %" for name, c in result["contraction"].items())
    lines = [f"learned from the data (1 - sd / prior sd): {learned}"]
    names = list(result["correlation"])
    together = [
        f"{first} and {second} ({result['correlation'][first][second]:+.2f})"
        for k, first in enumerate(names)
        for second in names[k + 1 :]
        if abs(result["correlation"][first][second]) >= _TOGETHER
    ]
    lines.append(f"only known together: {', '.join(together) or 'none'}")
    return "\n".join([*lines, *products_in_words(result["combinations"], _BEST)])


def products_in_words(combinations: list[dict[str, Any]], best: int) -> list[str]:
    """Return the ``best`` combinations, a line each."""
    return [
        f"known best: {_product(entry['exponents'])} to {100 * entry['known_to']:.2g} % "
        f"(prior {100 * entry['prior']:.2g} %)"
        for entry in combinations[:best]
    ]


def _product(exponents: dict[str, float]) -> str:
    """Return the combination as a quotient, the largest exponents first."""
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


_DRAWS = 32


class Candidate(NamedTuple):
    """Something that could be measured, and what one would know then.

    bits : expected information gain.
    sd : per unknown, its expected sd relative to the present one.
    """

    bits: float
    sd: dict[str, float]


def next_measurement(
    posterior: Posterior, candidates: Mapping[str, tuple[Observation, Noise]]
) -> dict[str, Candidate]:
    """Return the candidates by name, the most informative first.

    Parameters
    ----------
    candidates : an observation and its noise, of known sd, by name; in a body with several load
        states the name says in which, as in ``volume@diastole``.
    """
    model, draws = posterior.model, posterior.draws()
    table = np.stack([draws[name] for name in model.states.unknowns], axis=1)
    log = bool((table > 0.0).all())
    x = np.log(table) if log else table
    covariance = np.atleast_2d(np.cov(x, rowvar=False))
    rows = np.linspace(0, len(x) - 1, min(_DRAWS, len(x))).astype(int)
    gains_by_name = {}
    for name, (part, noise) in candidates.items():
        information_of = jax.jit(
            information_at(model, Observations({name: part}), {name: noise}, log=log)
        )
        gains, ratios = [], []
        for k in rows:
            information, _ = information_of(jnp.asarray(x[k]), None, jnp.zeros(0))
            gain, ratio = _gain(covariance, np.asarray(information))
            gains.append(gain)
            ratios.append(ratio)
        sd = dict(zip(model.states.unknowns, np.mean(ratios, axis=0).tolist(), strict=True))
        gains_by_name[name] = Candidate(float(np.mean(gains)), sd)
    return dict(sorted(gains_by_name.items(), key=lambda item: -item[1].bits))


def _gain(C: np.ndarray, information: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the gain in bits, and the sd afterwards relative to now (q,)."""
    root = np.linalg.cholesky(C)
    precision = np.eye(len(C)) + root.T @ information @ root
    after = root @ np.linalg.solve(precision, root.T)
    bits = 0.5 * np.linalg.slogdet(precision)[1] / np.log(2.0)
    return float(bits), np.sqrt(np.diagonal(after) / np.diagonal(C))


STRETCHES = np.linspace(1.0, 1.25, 26)
_STRESS_DRAWS = 500
_FIBRE, _CROSS = jnp.array([1.0, 0.0, 0.0]), jnp.array([0.0, 1.0, 0.0])


class StressBand(NamedTuple):
    """Difference of axial and transverse Cauchy stress, kPa, over ``stretch`` (n,).

    direction : ``fibre`` or ``cross-fibre``.
    low, median, high : (n,) quantiles over the posterior's draws.
    """

    direction: str
    stretch: np.ndarray
    low: np.ndarray
    median: np.ndarray
    high: np.ndarray


def stress_band(
    posterior: Posterior,
    direction: str = "fibre",
    *,
    stretches: Sequence[float] | np.ndarray = STRETCHES,
    probability: float = 0.9,
) -> StressBand:
    """Return the band of stresses under a stretch along ``fibre`` or ``cross-fibre``.

    A law without fibres has no directions; both are the same then. In a scene with regions it is
    that of a stiffness factor of the first.

    Raises
    ------
    InputError
        Another direction, or a stretch that is not above 0.
    """
    axis = look_up({"fibre": _FIBRE, "cross-fibre": _CROSS}, direction, "stress: direction")
    stretch = np.asarray(stretches, dtype=float)
    if not (stretch > 0.0).all():
        raise InputError("stress: stretches must be above 0; 1 is no stretch")
    model = posterior.model
    state = model.states.states[0]  # the material is the same in every load state
    thetas = posterior.thetas(state)
    rows = np.linspace(0, len(thetas) - 1, min(_STRESS_DRAWS, len(thetas))).astype(int)
    curve = jax.jit(jax.vmap(lambda t: stresses(model.forward.scene, t, axis, stretch)))
    edge = 0.5 * (1.0 - probability)
    quantiles = np.quantile(np.asarray(curve(thetas[rows])), [edge, 0.5, 1.0 - edge], axis=0)
    return StressBand(direction, stretch, *quantiles)


def stresses(scene: Scene, theta: jax.Array, axis: jax.Array, stretch: np.ndarray) -> jax.Array:
    """Return stress differences (n,), kPa, along ``axis`` (3,); fibres along x, sheets along y."""
    energy, at = point_energy(scene, theta), _tissue(scene)

    def along(value: jax.Array) -> jax.Array:
        projection = jnp.outer(axis, axis)
        F = value * projection + (jnp.eye(3) - projection) / jnp.sqrt(value)
        return energy(F - jnp.eye(3), at)

    lam = jnp.asarray(stretch)
    return lam * jax.vmap(jax.grad(along))(lam)


def _tissue(scene: Scene) -> Tissue:
    """Return the tissue of one element with the fibre along x, and the sheet along y."""
    directions = None
    if scene.law.sheets:
        directions = jnp.stack([_FIBRE, _CROSS])
    elif scene.law.fibres:
        directions = _FIBRE
    return Tissue(directions, None if scene.regions is None else jnp.array(0))
