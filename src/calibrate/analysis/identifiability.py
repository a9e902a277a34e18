r"""The parameters that data determine, with a prior and by likelihood alone, and the stress.

**Combinations.** Stiffness and load can rise together and leave the body where it is; a table of
marginals hides that. With covariances :math:`S` of the posterior and :math:`P` of the prior, in
:math:`x_k = \log\theta_k` where that is the parameter's scale and in
:math:`\theta_k / \bar\theta_k`, to first order the same, where its scale is uniform, the
combinations :math:`\prod_k \theta_k^{w_k}` that the data determines, best first, solve

.. math:: S w = \lambda P w

and :math:`1 - \sqrt\lambda` is how far each has contracted.

**Profiles.** How well one unknown explains the data with all others at their best:

.. math:: L_k(v) = \max_{\theta : \theta_k = v} \log p(y \mid \theta)
          - \max_\theta \log p(y \mid \theta)

No prior enters but its support, so that a flat profile says: the data alone does not determine
:math:`\theta_k`, whatever the posterior's sd. The 95 % likelihood interval ends where :math:`L_k`
falls below -1.92 (half the quantile 3.84 of chi-squared with one degree of freedom; Raue et al.
2009).

**Stress.** The stress-stretch curve is often well known where the parameters are not. Along an
isochoric stretch :math:`\lambda` of direction e, transversely :math:`\lambda^{-1/2}`,

.. math:: F = \lambda\, e \otimes e + \lambda^{-1/2} (I - e \otimes e), \qquad
          \sigma_{ee} - \sigma_\perp = \lambda \frac{dW}{d\lambda}

with :math:`\sigma_\perp` the mean of the two transverse Cauchy stresses: J is 1 on the whole path,
so that :math:`\dot W = \sigma : d` and :math:`d = \frac{\dot\lambda}{\lambda}\,
\text{diag}(1, -\frac12, -\frac12)`. The pressure that incompressibility leaves free drops out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg import eigh

from calibrate.posterior import Posterior
from calibrate.posterior.box import BoxEnd
from calibrate.posterior.box import in_words as box_in_words
from calibrate.priors import bounds
from calibrate.samplers import density_of
from calibrate.statistical_model import Model
from emulator.core.errors import InputError, look_up
from emulator.core.minimise import minimise
from emulator.fem.energy import point_energy
from emulator.scenes.scene import Scene
from emulator.scenes.tissue import Tissue, stiffness_of

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
        the posterior and ``prior`` in the prior, without parameters whose range is not above 0.
        A combination with a parameter of ``box_ends`` is left out: that range made it narrow.
    box_ends : the ends of ranges that end the posterior (:mod:`calibrate.posterior.box`).
    """
    model = posterior.model
    names, draws = model.states.unknowns, posterior.draws()
    after = np.stack([draws[name] for name in names], axis=1)
    x, prior = (np.asarray(model.on_scales(theta)) for theta in (after, prior_table(model)))
    contraction = 1.0 - x.std(axis=0, ddof=1) / prior.std(axis=0, ddof=1)
    correlation = np.atleast_2d(np.corrcoef(x, rowvar=False))
    posterior_S, prior_S = (np.atleast_2d(np.cov(points, rowvar=False)) for points in (x, prior))
    ends = posterior.box_ends()
    cut = {end.name for end in ends}
    known = combinations(model, posterior_S, prior_S, after.mean(axis=0))
    return {
        "contraction": dict(zip(names, contraction.tolist(), strict=True)),
        "correlation": {
            first: {second: float(correlation[j, k]) for k, second in enumerate(names)}
            for j, first in enumerate(names)
        },
        "combinations": [entry for entry in known if not cut & set(entry["exponents"])],
        "box_ends": [asdict(end) for end in ends],
    }


def prior_table(model: Model) -> np.ndarray:
    """Return draws (s, q) of the unknowns of theta from their prior, where each has its scale."""
    draws = model.prior_draws(jax.random.key(0), _PRIOR_DRAWS)
    table = np.stack([np.asarray(draws[name]) for name in model.states.unknowns], axis=1)
    return table[((table > 0.0) | ~model.on_log_scale).all(axis=1)]


def combinations(
    model: Model, after: np.ndarray, before: np.ndarray, mean: np.ndarray
) -> list[dict[str, Any]]:
    """Return the products of powers that the data informs, the most contracted first.

    Parameters
    ----------
    after, before : (q, q) covariances of the posterior and of the prior, on the unknowns' scales.
    mean : (q,) means of the unknowns.
    """
    log, low = model.on_log_scale, np.array([parameter.low for parameter in model.parameters])
    powers = np.flatnonzero(log | ((low >= 0.0) & (mean > 0.0)))
    if not powers.size:
        return []
    names = [model.states.unknowns[k] for k in powers]
    relative = np.where(log, 1.0, mean)[powers]
    ratios = np.outer(relative, relative)
    after, before = (S[np.ix_(powers, powers)] / ratios for S in (after, before))
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
    if result["box_ends"]:
        lines.append(": ".join(box_in_words([BoxEnd(**end) for end in result["box_ends"]])))
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


DROP_95 = 1.92
_BOUND = 12.0  # bound of an unconstrained coordinate, within 1e-5 of its interval's ends
_WIDTH = 4.0  # posterior sd that the grid covers on each side of the median


class Profile(NamedTuple):
    """The profile of one unknown.

    values : (v,), ascending. drop : (v,) log likelihood below its maximum, 0 at the best.
    low, high : ends of the 95 % likelihood interval; infinite where the likelihood does not fall so
        far within ``values``.
    """

    values: np.ndarray
    drop: np.ndarray
    low: float
    high: float


def profile_likelihood(posterior: Posterior, name: str, points: int = 21) -> Profile:
    """Return the profile of the unknown ``name``, to four posterior sd on each side.

    Each maximisation starts from the draw nearest in that unknown, and from the best of the point
    before.

    Raises
    ------
    InputError
        No such unknown.
    """
    model = posterior.model
    if name not in model.names:
        raise InputError(f"profile: '{name}' is not inferred; inferred: {', '.join(model.names)}")
    density, data = density_of(model), posterior.data
    named = {n: jnp.asarray(values) for n, values in posterior.draws().items()}
    z = np.asarray(jax.jit(jax.vmap(density.unconstrain))(named))
    k = density.names.index(name)
    priors = {**model.prior, **model.noise_priors}
    limits = [_BOUND if np.isfinite(bounds(priors[n])).all() else np.inf for n in density.names]
    grid = np.median(z[:, k]) + z[:, k].std() * np.linspace(-_WIDTH, _WIDTH, points)
    grid = np.clip(grid, -limits[k], limits[k])
    along = np.median(z, axis=0) + np.zeros((points, 1))
    along[:, k] = grid
    values = np.asarray(density.constrain(jnp.asarray(along))[name])

    nuisance = np.array([j for j in range(z.shape[1]) if j != k])
    bound = np.array(limits)[nuisance]

    @jax.jit
    @jax.value_and_grad
    def objective(rest: jax.Array, value: jax.Array) -> jax.Array:
        point = jnp.zeros(z.shape[1]).at[k].set(value).at[nuisance].set(rest)
        return -density.log_likelihood(point, data)

    best: list[float] = []
    last: list[np.ndarray] = []  # where the maximum was at the value before
    for value in grid:
        nearest = z[int(np.argmin(np.abs(z[:, k] - value))), nuisance]
        optima = [
            minimise(
                partial(objective, value=value), np.clip(s, -bound, bound), low=-bound, high=bound
            )
            for s in (nearest, *last)
        ]
        lowest = min(optima, key=lambda minimum: minimum.value)
        best.append(-lowest.value)
        last = [lowest.x]
    drop = np.max(best) - np.array(best)
    least = int(np.argmin(drop))
    low = _crossing(values[least::-1], drop[least::-1], -np.inf)
    return Profile(values, drop, low, _crossing(values[least:], drop[least:], np.inf))


def _crossing(values: np.ndarray, drop: np.ndarray, otherwise: float) -> float:
    """Return the value at which the drop first crosses :data:`DROP_95`."""
    beyond = np.flatnonzero(drop > DROP_95)
    if not beyond.size:
        return otherwise
    i = int(beyond[0])
    share = (DROP_95 - drop[i - 1]) / (drop[i] - drop[i - 1])
    return float(values[i - 1] + share * (values[i] - values[i - 1]))


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
) -> StressBand:
    """Return the 90 % band of stresses under a stretch along ``fibre`` or ``cross-fibre``.

    A law without fibres has no directions; both are the same then. In a scene with regions it is
    that of the first; modes of stiffness do not count.

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
    quantiles = np.quantile(np.asarray(curve(thetas[rows])), [0.05, 0.5, 0.95], axis=0)
    return StressBand(direction, stretch, *quantiles)


def stresses(scene: Scene, theta: jax.Array, axis: jax.Array, stretch: np.ndarray) -> jax.Array:
    """Return stress differences (n,), kPa, along ``axis`` (3,); fibres along x, sheets along y."""
    energy, at = point_energy(scene, theta), _tissue(scene, theta)

    def along(value: jax.Array) -> jax.Array:
        projection = jnp.outer(axis, axis)
        F = value * projection + (jnp.eye(3) - projection) / jnp.sqrt(value)
        return energy(F - jnp.eye(3), at)

    lam = jnp.asarray(stretch)
    return lam * jax.vmap(jax.grad(along))(lam)


def _tissue(scene: Scene, theta: jax.Array) -> Tissue:
    """Return the tissue of the first region, the fibre along x and the sheet along y."""
    directions = None
    if scene.law.sheets:
        directions = jnp.stack([_FIBRE, _CROSS])
    elif scene.law.fibres:
        directions = _FIBRE
    if scene.regions is None:
        return Tissue(directions)
    factors = stiffness_of(scene.regions, None, scene.resolve(theta))
    assert factors is not None
    return Tissue(directions, factors[int(np.argmin(scene.regions))])
