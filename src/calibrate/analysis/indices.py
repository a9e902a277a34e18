r"""Sensitivity of any function of independent parameters, each a point of the unit interval.

With :math:`y = g(x)`, x uniform in the unit cube and :math:`V` the variance of y,

.. math:: S_i = \frac{\operatorname{Var}_{x_i} E(y \mid x_i)}{V}, \qquad
          T_i = 1 - \frac{\operatorname{Var}_{x_{\sim i}} E(y \mid x_{\sim i})}{V}

are the first-order and the total index of :math:`x_i` (Sobol' 1993, Homma and Saltelli 1996): what
fixing it would take off the variance on average, and what is left of it when all others are fixed.
Derivatives bound the latter (Sobol' and Kucherenko 2009),

.. math:: T_i \le \frac{\nu_i}{\pi^2 V}, \qquad
          \nu_i = E\Big(\frac{\partial g}{\partial x_i}\Big)^2,

and the eigenvectors of :math:`E(\nabla g\, \nabla g^T)` are directions along which g changes, most
first: its active subspace (Constantine 2015). Morris' screening is the mean of absolute elementary
effects :math:`\mu^*` and their standard deviation :math:`\sigma`, in the unit of y.

Several outputs have indices each, and together those of their variances' sum (Gamboa et al. 2014),

.. math:: S_i = \sum_k V_k S_{ik} \Big/ \sum_k V_k .
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
import xarray as xr
from SALib.analyze import morris as morris_analysis
from SALib.analyze import sobol as sobol_analysis
from SALib.sample import morris as morris_design
from SALib.sample import sobol as sobol_design
from scipy.stats import norm, qmc

from calibrate.priors import Prior, bisect, bounds, dependence_of
from emulator.core.errors import InputError, check_known, check_seed

_EDGE = 1e-9  # cut off the unit interval, because unbounded priors have infinite quantiles at 0


@dataclass(frozen=True, eq=False)
class Factors:
    """Parameters by name, varied together where they form a group.

    names : the names of the parameters, (p,).
    groups : the names of each group's parameters, by the group's name; a parameter that is in none
        is a group of its own.

    Raises
    ------
    InputError
        A group that names another's parameter, or an unknown one.
    """

    names: tuple[str, ...]
    groups: Mapping[str, Sequence[str]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        grouped = [name for group in self.groups.values() for name in group]
        for name in grouped:
            if name not in self.names:
                raise InputError(
                    f"group of parameters: '{name}' is none of {', '.join(self.names)}"
                )
            if grouped.count(name) > 1:
                raise InputError(f"group of parameters: '{name}' is in two groups")
        for group in self.groups:
            if group in self.names:
                raise InputError(f"group of parameters: '{group}' is a parameter's name")

    @cached_property
    def group_of(self) -> tuple[str, ...]:
        """The group each parameter is in, (p,); its own name where it is in none."""
        of = {name: group for group, members in self.groups.items() for name in members}
        return tuple(of.get(name, name) for name in self.names)

    @property
    def labels(self) -> tuple[str, ...]:
        """The names of what varies independently, in the order of their first parameters."""
        return tuple(dict.fromkeys(self.group_of))

    @property
    def problem(self) -> dict[str, Any]:
        """SALib's description of the unit cube."""
        problem: dict[str, Any] = {
            "num_vars": len(self.names),
            "names": list(self.names),
            "bounds": [[0.0, 1.0]] * len(self.names),
        }
        return problem | {"groups": list(self.group_of)} if self.groups else problem


def quantiles(prior: Prior, names: Sequence[str], points: jax.Array) -> jax.Array:
    """Return theta (..., p) whose cumulative probabilities are ``points`` (..., p)."""
    inside = jnp.clip(points, _EDGE, 1.0 - _EDGE)
    columns = [_quantile(prior[name], inside[..., k]) for k, name in enumerate(names)]
    return jnp.stack(columns, axis=-1)


def densities(prior: Prior, names: Sequence[str], theta: jax.Array) -> jax.Array:
    """Return each parameter's density (..., p) at ``theta`` (..., p): dx/dtheta of its point x."""
    columns = [jnp.exp(prior[name].log_prob(theta[..., k])) for k, name in enumerate(names)]
    return jnp.stack(columns, axis=-1)


def check_independent(prior: Prior) -> None:
    """Refuse a prior whose parameters depend on each other: its variance has no shares."""
    dependence = dependence_of(prior)
    if dependence is not None and np.any(dependence.correlation != np.eye(len(dependence.names))):
        raise InputError(
            f"sensitivity: the prior correlates {', '.join(dependence.names)}; shares of the "
            "variance are defined for independent parameters, e.g. --prior box"
        )


def _quantile(distribution: dist.Distribution, points: jax.Array) -> jax.Array:
    try:
        return distribution.icdf(points)
    except NotImplementedError:
        low, high = bounds(distribution)
        if not np.isfinite([low, high]).all():
            raise InputError(
                f"prior {type(distribution).__name__} has neither quantiles nor finite ends"
            ) from None
        return bisect(distribution.cdf, points, low, high)


METHODS = ("sobol", "morris", "derivatives")
"""Variance-based indices, screening, and what exact derivatives say."""

Function = Callable[[np.ndarray], np.ndarray]
"""Points (n, p) of the unit cube to outputs (n, m)."""
Derivative = Callable[[np.ndarray], np.ndarray]
"""Points (n, p) of the unit cube to derivatives (n, m, p)."""

CONFIDENCE = 0.95
_DEVIATIONS = norm.ppf(0.5 * (1.0 + CONFIDENCE))  # half-width of the interval of a normal, in sd
_RESAMPLES = 100
_LEVELS = 4  # levels of Morris' grid


def analyse(
    factors: Factors,
    function: Function,
    *,
    method: str = "sobol",
    samples: int = 512,
    derivative: Derivative | None = None,
    seed: int = 0,
) -> xr.Dataset:
    """Return the sensitivity of the outputs of ``function``.

    Parameters
    ----------
    samples : n. ``sobol`` evaluates n (f + 2) points for f factors, ``morris`` n (f + 1), and
        ``derivatives`` the derivatives at n points. Sobol' sequences want a power of two.

    Returns
    -------
    Dataset over ``factor`` (``parameter`` for derivatives) and ``output``; values ending in
    ``_half_width`` are half the width of a 95 % interval, from resampling. Outputs that do not vary
    have NaN. ``together`` marks what all outputs give together.

    Raises
    ------
    InputError
        An unknown method, too few samples, no derivative, or outputs that are not finite.
    """
    check_known(method, METHODS, "method")
    check_seed(seed, "sensitivity")
    if samples < 2 or (method == "sobol" and samples & (samples - 1)):
        raise InputError(
            f"sensitivity: {samples} samples; give 2 or more, for sobol a power of two"
        )
    if method == "derivatives":
        if derivative is None:
            raise InputError("method 'derivatives' needs the derivative of the function")
        return _by_derivatives(factors, function, derivative, samples, seed)
    run = _by_variance if method == "sobol" else _by_screening
    return run(factors, function, samples, seed)


def _by_variance(factors: Factors, function: Function, samples: int, seed: int) -> xr.Dataset:
    points = sobol_design.sample(factors.problem, samples, calc_second_order=False, seed=seed)
    outputs = _evaluated(function, points)
    shape = len(factors.labels), outputs.shape[1]
    indices = {name: np.full(shape, np.nan) for name in ("first", "total")}
    half = {name: np.full(shape, np.nan) for name in indices}
    resampled = {name: np.zeros((_RESAMPLES, shape[0])) for name in indices}
    variance = _base(outputs, len(factors.labels)).var(axis=0)
    for k in np.flatnonzero(_varies(outputs)):
        # SALib takes the seed 0 for none.
        result = sobol_analysis.analyze(
            factors.problem, outputs[:, k], calc_second_order=False, num_resamples=_RESAMPLES,
            conf_level=CONFIDENCE, keep_resamples=True, seed=seed + 1,
        )  # fmt: skip
        for name, key in (("first", "S1"), ("total", "ST")):
            indices[name][:, k], half[name][:, k] = result[key], result[f"{key}_conf"]
            resampled[name] += variance[k] * result[f"{key}_conf_all"]
    weights = variance * _varies(outputs)
    dims = ("factor", "output")
    data: dict[str, Any] = {name: (dims, values) for name, values in indices.items()}
    data |= {f"{name}_half_width": (dims, values) for name, values in half.items()}
    for name, values in indices.items():
        total = (
            np.nansum(values * weights, axis=1) / weights.sum() if weights.any() else values[:, 0]
        )
        data[f"{name}_together"] = ("factor", total)
        spread = resampled[name].std(axis=0, ddof=1) / max(weights.sum(), np.finfo(float).tiny)
        data[f"{name}_together_half_width"] = ("factor", _DEVIATIONS * spread)
    data["variance"] = ("output", variance)
    return _dataset(data, factors, evaluations=len(points), method="sobol")


def _by_screening(factors: Factors, function: Function, samples: int, seed: int) -> xr.Dataset:
    points = morris_design.sample(factors.problem, samples, num_levels=_LEVELS, seed=seed)
    outputs = _evaluated(function, points)
    shape = len(factors.labels), outputs.shape[1]
    effects = {name: np.full(shape, np.nan) for name in ("mu_star", "sigma", "mu_star_half_width")}
    for k in range(shape[1]):
        result = morris_analysis.analyze(
            factors.problem, points, outputs[:, k], num_resamples=_RESAMPLES,
            conf_level=CONFIDENCE, num_levels=_LEVELS, seed=seed + 1,
        )  # fmt: skip
        for name, key in (
            ("mu_star", "mu_star"), ("sigma", "sigma"), ("mu_star_half_width", "mu_star_conf"),
        ):  # fmt: skip
            effects[name][:, k] = np.ma.filled(np.ma.asarray(result[key], dtype=float), np.nan)
    data: dict[str, Any] = {
        name: (("factor", "output"), values) for name, values in effects.items()
    }
    together = np.sqrt(np.mean(effects["mu_star"] ** 2, axis=1))
    data["mu_star_together"] = ("factor", together)
    return _dataset(data, factors, evaluations=len(points), method="morris")


def _by_derivatives(
    factors: Factors, function: Function, derivative: Derivative, samples: int, seed: int
) -> xr.Dataset:
    bits = (samples - 1).bit_length()
    points = qmc.Sobol(len(factors.names), rng=seed).random_base2(bits)[:samples]
    outputs, slopes = _evaluated(function, points), derivative(points)
    if not np.isfinite(slopes).all():
        raise InputError("sensitivity: derivatives are not finite")
    variance = outputs.var(axis=0)
    square = np.mean(slopes**2, axis=0).T  # (p, m)
    with np.errstate(divide="ignore", invalid="ignore"):
        bound = np.where(_varies(outputs), square / (np.pi**2 * variance), np.nan)
    spread = np.std(slopes**2, axis=0, ddof=1).T / np.sqrt(samples)
    matrix = np.einsum("nkp,nkq->pq", slopes, slopes) / samples
    values, vectors = np.linalg.eigh(matrix)
    order = np.argsort(values)[::-1]
    vectors = vectors[:, order]
    vectors *= np.where(vectors[np.abs(vectors).argmax(axis=0), np.arange(len(values))] < 0, -1, 1)
    total = variance.sum()
    dims = ("parameter", "output")
    data = {
        "nu": (dims, square),
        "nu_half_width": (dims, _DEVIATIONS * spread),
        "bound_on_total": (dims, bound),
        "bound_on_total_together": (
            "parameter",
            square.sum(axis=1) / (np.pi**2 * total)
            if total > 0.0
            else np.full(len(square), np.nan),
        ),
        "active_value": ("direction", values[order]),
        "active_direction": (("parameter", "direction"), vectors),
        "variance": ("output", variance),
    }
    dataset = _dataset(data, factors, evaluations=samples, method="derivatives")
    return dataset.assign_coords(parameter=list(factors.names))


def _evaluated(function: Function, points: np.ndarray) -> np.ndarray:
    """Return the outputs (n, m) at ``points``; :class:`InputError` unless all are finite."""
    outputs = np.asarray(function(points), dtype=float)
    if outputs.ndim == 1:
        outputs = outputs[:, None]
    bad = ~np.isfinite(outputs).all(axis=1)
    if bad.any():
        raise InputError(
            f"sensitivity: the function is not finite at {bad.sum()} of {len(points)} points"
        )
    return outputs


def _base(outputs: np.ndarray, factors: int) -> np.ndarray:
    """Return the outputs at the two independent samples of a variance-based design."""
    block = outputs.reshape(-1, factors + 2, outputs.shape[1])
    return np.concatenate([block[:, 0], block[:, -1]])


def _varies(outputs: np.ndarray) -> np.ndarray:
    """Return whether each output (m,) varies by more than round-off."""
    size = np.abs(outputs).max(axis=0)
    return outputs.std(axis=0) > 1e-12 * np.where(size > 0.0, size, 1.0)


def _dataset(data: dict[str, Any], factors: Factors, **attributes: object) -> xr.Dataset:
    coords = (
        {"factor": list(factors.labels)} if any("factor" in d[0] for d in data.values()) else {}
    )
    return xr.Dataset(data, coords=coords, attrs=attributes)
