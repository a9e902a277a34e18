r"""Data against what the model can predict: units that are wrong by factors, data that is zero.

Predictions :math:`g_s` are made at draws of the prior and at its ends, where they are smallest and
largest. Data :math:`y` is refused as too small when for every one of them

.. math:: \|y\| < \tfrac12 \|g_s\| \quad\text{and}\quad
          \|g_s\| - y \cdot g_s / \|g_s\| > 5 \sigma

and as too large when

.. math:: \|y\| > 2 \|g_s\| \quad\text{and}\quad \|y - g_s\| > \sigma (\sqrt n + 5),

with the noise's standard deviation :math:`\sigma` (the largest plausible one where it is inferred)
and n numbers. The second conditions keep noisy data: however large the noise, data made at
:math:`g_s` meets one of them with a probability below 4e-6. The first conditions keep data from a
corner of the prior that no draw came near. Before data is refused it is looked for: at more draws,
and by descents of :math:`\|y - g(x)\|` from the nearest, as a second mode may be small.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import minimize

from calibrate.measurements.collection import Observations
from calibrate.measurements.observation import Observation
from emulator.core.errors import InputError

_DRAWS = 32  # predictions at draws of the prior
PRIOR_DRAWS = 4096  # whose extremes stand for the ends of a parameter's prior
_MORE_DRAWS, _DESCENTS, _STEPS = 256, 4, 30  # before data is refused
_FACTOR = 2.0
_NOISE_SD = 5.0
_OVERRULE = "check_scale=False or --no-unit-check overrules"


Predict = Callable[[jax.Array], tuple[Mapping[str, jax.Array], jax.Array]]
"""Maps values (q,) of the unknowns to predictions by observation and whether they are valid."""


def check_magnitudes(
    predict: Predict,
    observe: Observations,
    sd: Mapping[str, float],
    draws: np.ndarray,
    data: Mapping[str, np.ndarray],
) -> None:
    """Raise :class:`InputError` where ``data`` is far from every prediction.

    Parameters
    ----------
    sd : largest plausible one of each observation's noise and other errors, in its unit.
    draws : (c, q) of the unknowns' prior, ``PRIOR_DRAWS`` of them or so.
    """
    predictions = predict_over_prior(predict, observe, draws)
    for name, part in observe.parts.items():
        about = name, part, data[name]
        if complaint(*about, predictions[name], sd[name]) is None:
            continue
        more = _nearer(predict, name, data[name], draws)
        known = np.concatenate([predictions[name], more])
        found = complaint(*about, known, sd[name])
        if found is not None:
            raise InputError(found)


def _nearer(predict: Predict, name: str, data: np.ndarray, draws: np.ndarray) -> np.ndarray:
    """Predictions (s, ...) at more draws, and at the ends of descents towards the data."""

    def gap(x: jax.Array) -> jax.Array:
        means, valid = predict(x)
        return jnp.where(valid, jnp.log1p(jnp.sum((means[name] - data) ** 2)), jnp.inf)

    rows = draws[:_MORE_DRAWS]
    means, valid = jax.jit(partial(jax.lax.map, predict))(jnp.asarray(rows))
    known, valid = np.asarray(means[name]), np.asarray(valid)
    gaps = np.where(valid, [_norm(row - data) for row in known], np.inf)
    both = jax.jit(jax.value_and_grad(gap))
    ends = [draws.min(axis=0), draws.max(axis=0)]
    width = np.where(ends[1] > ends[0], ends[1] - ends[0], 1.0)

    def scaled(z: np.ndarray) -> tuple[float, np.ndarray]:
        value, slope = both(jnp.asarray(ends[0] + width * z))
        return float(value), np.nan_to_num(np.asarray(slope) * width)

    reached = [
        ends[0] + width * minimize(
            scaled, (rows[k] - ends[0]) / width, jac=True, method="L-BFGS-B",
            bounds=[(0.0, 1.0)] * len(width), options={"maxiter": _STEPS},
        ).x
        for k in np.argsort(gaps)[:_DESCENTS]
        if np.isfinite(gaps[k])
    ]  # fmt: skip
    one = jax.jit(predict)
    ended = [one(jnp.asarray(x)) for x in reached]
    return np.stack([*known[valid], *(np.asarray(m[name]) for m, fine in ended if bool(fine))])


def predict_over_prior(
    predict: Predict, observe: Observations, draws: np.ndarray
) -> dict[str, np.ndarray]:
    """Predictions (s, ...) without noise at draws of the prior and at its ends, by observation.

    The ends are taken one unknown at a time, and then together where each makes the prediction
    smaller, or larger.

    Raises
    ------
    InputError
        The forward map has no valid answer at any of them.
    """
    one = jax.jit(predict)
    found: dict[str, list[np.ndarray]] = {name: [] for name in observe.parts}

    def sizes(values: np.ndarray) -> dict[str, float]:
        means, valid = one(jnp.asarray(values))
        if not bool(valid):
            return dict.fromkeys(found, np.nan)
        for name, mean in means.items():
            found[name].append(np.asarray(mean))
        return {name: _norm(np.asarray(mean)) for name, mean in means.items()}

    middle, ends = np.median(draws, axis=0), np.stack([draws.min(axis=0), draws.max(axis=0)])
    for values in draws[:_DRAWS]:
        sizes(values)
    reached = {name: np.empty(ends.shape) for name in found}
    for end, k in np.ndindex(ends.shape):
        values = middle.copy()
        values[k] = ends[end, k]
        for name, size in sizes(values).items():
            reached[name][end, k] = size
    columns = np.arange(ends.shape[1])
    for by_end in reached.values():
        smaller = (by_end[1] < by_end[0]).astype(int)
        sizes(ends[smaller, columns])
        sizes(ends[1 - smaller, columns])
    if not all(found.values()):
        raise InputError(
            f"the forward map has no valid answer at any of {_DRAWS} draws of the prior; "
            "give a prior inside the range in which it answers"
        )
    return {name: np.stack(values) for name, values in found.items()}


def complaint(
    name: str, part: Observation, data: np.ndarray, predictions: np.ndarray, sd: float
) -> str | None:
    """A line where data (...) is far from all of ``predictions`` (s, ...), else None."""
    y, g = np.ravel(data), predictions.reshape(len(predictions), -1)
    norms = np.array([_norm(row) for row in g])
    if not norms.min() > 0.0:
        return None  # a body that may be at rest explains data of any size
    size, count = _norm(y), y.size
    along = np.array([row @ y for row in g / norms[:, None]])
    small = (size < norms / _FACTOR) & (norms - along > _NOISE_SD * sd)
    apart = np.array([_norm(y - row) for row in g])
    large = (size > _FACTOR * norms) & (apart > sd * (np.sqrt(count) + _NOISE_SD))
    return _complaint(name, part, y, g, norms) if small.all() or large.all() else None


def _complaint(
    name: str, part: Observation, y: np.ndarray, g: np.ndarray, norms: np.ndarray
) -> str:
    """What the data looks like, in one line."""
    largest = np.abs(g).max(axis=1)
    predicted = f"{largest.min():.3g} to {largest.max():.3g} {part.unit}"
    size = _norm(y)
    if size == 0.0:
        return f"{name} data are all zero; predictions reach {predicted} ({_OVERRULE})"
    ratio = float(np.sqrt(norms.min() * norms.max())) / size
    word, times = ("smaller", ratio) if ratio > 1.0 else ("larger", 1.0 / ratio)
    guess = _guess(part, size, norms, ratio)
    return (
        f"{name} data are about {float(f'{times:.1g}'):g} times {word} than predicted "
        f"(largest {np.abs(y).max():.3g} against {predicted}): {guess} ({_OVERRULE})"
    )


def _guess(part: Observation, size: float, norms: np.ndarray, ratio: float) -> str:
    """The unit that would bring the data to the size of the predictions."""
    fitting = {
        unit: factor
        for unit, factor in part.other_units.items()
        if norms.min() / _FACTOR < factor * size < norms.max() * _FACTOR
    }
    if not fitting:
        return "check their unit, and that they belong to this scene"
    unit = min(fitting, key=lambda other: abs(np.log(fitting[other] / ratio)))
    return f"{unit} instead of {part.unit}? multiply by {fitting[unit]:g}"


def _norm(values: np.ndarray) -> float:
    """Euclidean norm, also of numbers whose squares overflow."""
    largest = float(np.abs(values).max(initial=0.0))
    return largest * float(np.linalg.norm(values / largest)) if largest > 0.0 else 0.0
