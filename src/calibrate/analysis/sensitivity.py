r"""Sensitivity of the outputs of a forward map, or of any function of independent parameters.

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
import xarray as xr
from SALib.analyze import morris as morris_analysis
from SALib.analyze import sobol as sobol_analysis
from SALib.sample import morris as morris_design
from SALib.sample import sobol as sobol_design
from scipy.stats import norm, qmc

from calibrate.measurements import Observation, Observations, observations
from calibrate.measurements.outputs import FIELD, Outputs
from calibrate.priors import Prior, bisect, bounds, box_prior, dependence_of
from calibrate.statistical_model.prior_range import fit_to
from emulator.core.errors import InputError, check_known, check_seed
from emulator.surrogates.protocol import ForwardMap

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
        A group that names another's parameter, an unknown one, or all of them.
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
        if len(self.names) > len(self.labels) == 1:
            raise InputError(
                f"group of parameters: '{self.labels[0]}' has them all, so that nothing is left to "
                "compare it with; leave one out"
            )

    @cached_property
    def group_of(self) -> tuple[str, ...]:
        """The group each parameter is in, (p,); its own name where it is in none."""
        of = {name: group for group, members in self.groups.items() for name in members}
        return tuple(of.get(name, name) for name in self.names)

    @property
    def labels(self) -> tuple[str, ...]:
        """The names of groups and single parameters, in the order of their first parameters."""
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
    inside, columns = jnp.clip(points, _EDGE, 1.0 - _EDGE), []
    for k, distribution in enumerate(prior[name] for name in names):
        try:
            columns.append(distribution.icdf(inside[..., k]))
        except NotImplementedError:
            low, high = bounds(distribution)
            if not np.isfinite([low, high]).all():
                raise InputError(
                    f"prior {type(distribution).__name__} has neither quantiles nor finite ends"
                ) from None
            columns.append(bisect(distribution.cdf, inside[..., k], low, high))
    return jnp.stack(columns, axis=-1)


def densities(prior: Prior, names: Sequence[str], theta: jax.Array) -> jax.Array:
    """Return each parameter's density (..., p) at ``theta`` (..., p): dx/dtheta of its point x."""
    columns = [jnp.exp(prior[name].log_prob(theta[..., k])) for k, name in enumerate(names)]
    return jnp.stack(columns, axis=-1)


METHODS = ("sobol", "morris", "derivatives")
"""Variance-based indices, screening, and derivative-based measures."""

Function = Callable[[np.ndarray], np.ndarray]
"""Points (n, p) of the unit cube to outputs (n, m)."""
Derivative = Callable[[np.ndarray], np.ndarray]
"""Points (n, p) of the unit cube to derivatives (n, m, p)."""

CONFIDENCE = 0.95
_DEVIATIONS = norm.ppf(0.5 * (1.0 + CONFIDENCE))  # half-width of the interval of a normal, in sd
_RESAMPLES = 100
_LEVELS = 4  # levels of Morris' grid
_FEW = 100  # numbers of an observation whose indices are told one by one


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
    points = _design(factors, method, samples, seed)
    if method == "derivatives" and derivative is None:
        raise InputError("method 'derivatives' needs the derivative of the function")
    outputs = np.asarray(function(points), dtype=float).reshape(len(points), -1)
    slopes = derivative(points) if method == "derivatives" and derivative else None
    return _analysed(factors, method, seed, points, outputs, slopes)


def _design(factors: Factors, method: str, samples: int, seed: int) -> np.ndarray:
    """Return the points (n, p) of the unit cube at which the method evaluates a function."""
    check_known(method, METHODS, "method")
    check_seed(seed, "sensitivity")
    if samples < 2 or (method == "sobol" and samples & (samples - 1)):
        raise InputError(
            f"sensitivity: {samples} samples; give 2 or more, for sobol a power of two"
        )
    if method == "sobol":
        return sobol_design.sample(factors.problem, samples, calc_second_order=False, seed=seed)
    if method == "morris":
        return morris_design.sample(factors.problem, samples, num_levels=_LEVELS, seed=seed)
    sequence = qmc.Sobol(len(factors.names), rng=seed)
    return sequence.random_base2((samples - 1).bit_length())[:samples]


def _analysed(
    factors: Factors,
    method: str,
    seed: int,
    points: np.ndarray,
    outputs: np.ndarray,
    slopes: np.ndarray | None,
) -> xr.Dataset:
    """Return the sensitivity of ``outputs`` (n, m) at the ``points`` of a design."""
    bad = ~np.isfinite(outputs).all(axis=1)
    if bad.any():
        raise InputError(
            f"sensitivity: the function is not finite at {bad.sum()} of {len(points)} points"
        )
    if slopes is not None:
        data, coords = _by_derivatives(outputs, slopes), {"parameter": list(factors.names)}
    else:
        coords = {"factor": list(factors.labels)}
        if method == "sobol":
            data = _by_variance(factors, outputs, seed)
        else:
            data = _by_screening(factors, points, outputs, seed)
    return xr.Dataset(data, coords=coords, attrs={"evaluations": len(points), "method": method})


def _by_variance(factors: Factors, outputs: np.ndarray, seed: int) -> dict[str, Any]:
    shape = len(factors.labels), outputs.shape[1]
    block = outputs.reshape(-1, shape[0] + 2, shape[1])
    # The variance is that of the design's two independent samples.
    variance = np.concatenate([block[:, 0], block[:, -1]]).var(axis=0)
    results = {
        # SALib takes the seed 0 for none.
        k: sobol_analysis.analyze(
            factors.problem, outputs[:, k], calc_second_order=False, num_resamples=_RESAMPLES,
            conf_level=CONFIDENCE, keep_resamples=True, seed=seed + 1,
        )
        for k in np.flatnonzero(_varies(outputs))
    }  # fmt: skip
    weights = variance * _varies(outputs)
    data: dict[str, Any] = {"variance": ("output", variance)}
    for name, key in (("first", "S1"), ("total", "ST")):
        values, half, resampled = np.full(shape, np.nan), np.full(shape, np.nan), 0.0
        for k, result in results.items():
            values[:, k], half[:, k] = result[key], result[f"{key}_conf"]
            resampled = resampled + variance[k] * result[f"{key}_conf_all"]
        together, spread = np.full(shape[0], np.nan), np.zeros(shape[0])
        if weights.any():
            together = np.nansum(values * weights, axis=1) / weights.sum()
            spread = np.std(resampled, axis=0, ddof=1) / weights.sum()
        data |= {
            name: (("factor", "output"), values),
            f"{name}_half_width": (("factor", "output"), half),
            f"{name}_together": ("factor", together),
            f"{name}_together_half_width": ("factor", _DEVIATIONS * spread),
        }
    return data


def _by_screening(
    factors: Factors, points: np.ndarray, outputs: np.ndarray, seed: int
) -> dict[str, Any]:
    names = {"mu_star": "mu_star", "sigma": "sigma", "mu_star_half_width": "mu_star_conf"}
    effects = {name: np.full((len(factors.labels), outputs.shape[1]), np.nan) for name in names}
    for k, output in enumerate(outputs.T):
        result = morris_analysis.analyze(
            factors.problem, points, output, num_resamples=_RESAMPLES, conf_level=CONFIDENCE,
            num_levels=_LEVELS, seed=seed + 1,
        )  # fmt: skip
        for name, key in names.items():
            effects[name][:, k] = np.ma.filled(np.ma.asarray(result[key], dtype=float), np.nan)
    data: dict[str, Any] = {name: (("factor", "output"), x) for name, x in effects.items()}
    return data | {
        "mu_star_together": ("factor", np.sqrt(np.mean(effects["mu_star"] ** 2, axis=1)))
    }


def _by_derivatives(outputs: np.ndarray, slopes: np.ndarray) -> dict[str, Any]:
    if not np.isfinite(slopes).all():
        raise InputError("sensitivity: derivatives are not finite")
    variance, total = outputs.var(axis=0), outputs.var(axis=0).sum()
    square = np.mean(slopes**2, axis=0).T  # (p, m)
    with np.errstate(divide="ignore", invalid="ignore"):
        bound = np.where(_varies(outputs), square / (np.pi**2 * variance), np.nan)
        together = square.sum(axis=1) / (np.pi**2 * total) if total > 0.0 else square[:, 0] * np.nan
    spread = np.std(slopes**2, axis=0, ddof=1).T / np.sqrt(len(slopes))
    matrix = np.einsum("nkp,nkq->pq", slopes, slopes) / len(slopes)
    values, vectors = np.linalg.eigh(matrix)
    order = np.argsort(values)[::-1]
    vectors = vectors[:, order]
    vectors *= np.where(vectors[np.abs(vectors).argmax(axis=0), np.arange(len(values))] < 0, -1, 1)
    dims = ("parameter", "output")
    return {
        "nu": (dims, square),
        "nu_half_width": (dims, _DEVIATIONS * spread),
        "bound_on_total": (dims, bound),
        "bound_on_total_together": ("parameter", together),
        "active_value": ("direction", values[order]),
        "active_direction": (("parameter", "direction"), vectors),
        "variance": ("output", variance),
    }


def _varies(outputs: np.ndarray) -> np.ndarray:
    """Return whether each output (m,) varies by more than round-off."""
    size = np.abs(outputs).max(axis=0)
    return outputs.std(axis=0) > 1e-12 * np.where(size > 0.0, size, 1.0)


def sensitivity(
    forward: ForwardMap,
    observe: Observation | Observations | None = None,
    *,
    prior: Prior | None = None,
    method: str = "sobol",
    samples: int = 512,
    groups: Mapping[str, Sequence[str]] | None = None,
    field: bool = False,
    seed: int = 0,
) -> xr.DataTree:
    """Return the sensitivity of each observation to each parameter.

    Parameters
    ----------
    forward : the forward map over all nodes.
    prior : the prior of independent parameters; by default uniform over the scene's box, on its
        scales.
    method, samples : the arguments of :func:`analyse`.
    groups : the parameters that vary together, by the group's name.
    field : whether the size of every node's displacement is analysed, too.

    Returns
    -------
    A node for each observation, called like it, and ``field``; each a Dataset of
    :func:`analyse` whose ``output`` runs over the observation's
    numbers, or over the mesh's nodes, and whose attributes have the unit.

    Raises
    ------
    InputError
        Nothing to analyse; several load states; correlated parameters; a prior that leaves the
        range in which the map answers.
    """
    scene = forward.scene
    if observe is None and not field:
        raise InputError("sensitivity: give something to observe, or ask for the field")
    several = None if observe is None else observations(observe)
    if several is not None and several.states != ("",):
        raise InputError("sensitivity: observations of several load states; take one at a time")
    prior = _independent(forward, box_prior(scene) if prior is None else prior)
    factors = Factors(scene.parameter_names, dict(groups or {}))
    datasets = {}
    outputs = Outputs(forward, several, field=field, what="sensitivity")
    points = _design(factors, method, samples, seed)
    thetas = quantiles(prior, factors.names, jnp.asarray(points))
    values, slopes = outputs.values(thetas), None
    if method == "derivatives":
        density = np.asarray(densities(prior, factors.names, thetas))
        slopes = outputs.slopes(thetas) / density[:, None, :]
    for name, entries in outputs.places.items():
        some = None if slopes is None else slopes[:, entries]
        data = _analysed(factors, method, seed, points, values[:, entries], some)
        unit = several.parts[name].unit if several is not None and name != FIELD else "mm"
        datasets[name] = data.assign_attrs(unit=unit)
        if name == FIELD:  # its output is the node of that number
            datasets[name] = datasets[name].assign_coords(output=outputs.nodes)
    about = {"forward": forward.label, "scene": scene.name, "method": method, "seed": seed}
    return xr.DataTree.from_dict({"/": xr.Dataset(attrs=about), **datasets})


def _independent(forward: ForwardMap, prior: Prior) -> Prior:
    """Return the prior within the range of the map; refuse one that correlates parameters."""
    dependence = dependence_of(prior)
    if dependence is not None and np.any(dependence.correlation != np.eye(len(dependence.names))):
        raise InputError(
            f"sensitivity: the prior correlates {', '.join(dependence.names)}; shares of the "
            "variance are defined for independent parameters, e.g. --prior box"
        )
    return fit_to(forward, prior)[0]


def indices_to_json(indices: xr.DataTree) -> dict[str, Any]:
    """Return the indices of all numbers together, and of each where they are few, as plain JSON."""
    result = {str(name): value for name, value in indices.attrs.items()}
    for node, child in indices.children.items():
        data = child.to_dataset()
        few = data.sizes["output"] <= _FEW
        result[node] = {name: data.attrs[name] for name in ("unit", "evaluations")} | {
            str(name): values.values.tolist()
            for name, values in data.variables.items()
            if few or "output" not in values.dims
        }
    return result
