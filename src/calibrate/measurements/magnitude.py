r"""The magnitude of data against the model's predictions: wrong units, data that are zero.

Predictions :math:`g_s` are made at draws of the prior and at its ends, where they are smallest and
largest. Data :math:`y` is refused as too small when for every one of them

.. math:: \|y\| < \tfrac12 \|g_s\| \quad\text{and}\quad
          \|g_s\| - y \cdot g_s / \|g_s\| > 5 \sigma

and as too large when

.. math:: \|y\| > 2 \|g_s\| \quad\text{and}\quad \|y - g_s\| > \sigma (\sqrt n + 5),

with the noise's standard deviation :math:`\sigma` (the largest plausible one where it is inferred)
and n numbers. The second conditions keep noisy data: however large the noise, data made at
:math:`g_s` meets one of them with a probability below 4e-6. The first conditions keep data from a
corner of the prior that no draw came near. Before data is refused, predictions like it are sought
at more draws, and by descents of :math:`\|y - g(x)\|` from the nearest of them, as a second mode
may be small.

Displacements of any size are refused where the least angle between them and a prediction has a
sine above 0.2 and above the noise that is more than halved, and below a half, once two columns
are swapped or a sign is reversed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import combinations

import jax
import jax.numpy as jnp
import numpy as np

from calibrate.measurements.collection import Observations
from calibrate.measurements.observation import Observation
from calibrate.measurements.points import DisplacementPoints
from emulator.core.errors import InputError
from emulator.core.minimise import minimise
from emulator.core.units import PIXELS, in_pixels, other_units

_DRAWS = 32  # predictions at draws of the prior
PRIOR_DRAWS = 4096  # draws whose extremes approximate the ends of a parameter's prior
_MORE_DRAWS, _DESCENTS, _STEPS = 256, 4, 30  # effort of the search before data is refused
_FACTOR = 2.0
_NOISE_SD = 5.0
_ALONG, _ASTRAY = 0.5, 0.2  # sines of the angle to a prediction: data are along it, or are not
_OVERRULE = "check_scale=False or --no-unit-check overrules"


Predict = Callable[[jax.Array], tuple[Mapping[str, jax.Array], jax.Array]]
"""Maps values (q,) of the unknowns to predictions by observation and whether they are valid."""


def check_magnitudes(
    predict: Predict,
    observe: Observations,
    sd: Mapping[str, float],
    draws: np.ndarray,
    data: Mapping[str, np.ndarray],
    predictions: Mapping[str, np.ndarray],
) -> None:
    """Raise :class:`InputError` where ``data`` is far from every prediction.

    predict : predictions without noise, and whether they are valid.
    observe : the observations.
    sd : the largest plausible sd of each observation's noise and other errors, in its unit.
    draws : draws of the unknowns' prior, (c, q), ``PRIOR_DRAWS`` of them or so.
    data : the data by observation.
    predictions : those of :func:`predict_over_prior`, by observation.
    """
    for name, part in observe.parts.items():

        def fault(among: np.ndarray, name: str = name, part: Observation = part) -> str | None:
            line = complaint(name, part, data[name], among, sd[name])
            if line is None and isinstance(part, DisplacementPoints):
                return _mistaken_columns(observe, name, part, data[name], among, sd[name])
            return line

        if fault(predictions[name]) is None:
            continue
        more = np.concatenate([predictions[name], _closest(predict, name, data[name], draws)])
        if (line := fault(more)) is not None:
            raise InputError(line)


def _mistaken_columns(
    observe: Observations,
    name: str,
    part: DisplacementPoints,
    data: np.ndarray,
    among: np.ndarray,
    sd: float,
) -> str | None:
    """Return a message if displacements are along a prediction once columns are put right."""
    known = np.isfinite(observe.filled(name, data))
    measured = np.flatnonzero(known.any(axis=0))  # one camera sees no uz
    whole = np.ix_(known[:, measured].all(axis=1), measured)
    u, *fields = (observe.filled(name, values)[whole] for values in (data, *among))
    columns = [part.values_in(*part.selection)[0].columns[k] for k in measured]
    apart = _apart(u, fields)
    if apart <= _ASTRAY or _norm(data) * apart <= sd * (np.sqrt(data.size) + _NOISE_SD):
        return None
    mended = {"all signs reversed": -u}
    for k, column in enumerate(columns):
        mended[f"the sign of {column} reversed"] = np.where(np.arange(len(columns)) == k, -u, u)
    for i, k in combinations(range(len(columns)), 2):
        order = np.arange(len(columns))
        order[[i, k]] = k, i
        mended[f"columns {columns[i]} and {columns[k]} swapped"] = u[:, order]
    left, change = min((_apart(other, fields), change) for change, other in mended.items())
    if not (left < _ALONG and _FACTOR * left < apart):
        return None
    return (
        f"{name} data are {100 * apart:.0f} % off any prediction, whatever its size, and "
        f"{100 * left:.0f} % with {change}: put the columns right ({_OVERRULE})"
    )


def _apart(u: np.ndarray, fields: Sequence[np.ndarray]) -> float:
    """Return the least sine of the angle between data (d, c) and a field; 1 if none is along it."""
    sizes = [_norm(u) * _norm(field) for field in fields]
    cosines = [np.sum(u * g) / size for g, size in zip(fields, sizes, strict=True) if size > 0.0]
    return float(np.sqrt(1.0 - np.clip(max(cosines, default=0.0), 0.0, 1.0) ** 2))


def predict_over_prior(
    predict: Callable[[np.ndarray], tuple[Mapping[str, np.ndarray], np.ndarray]],
    observe: Observations,
    draws: np.ndarray,
) -> dict[str, np.ndarray]:
    """Return predictions (s, ...) without noise at draws of the prior and at its ends.

    The ends are taken one unknown at a time, and then together where each makes the prediction
    smaller, or larger.

    predict : maps values (s, q) of the unknowns to predictions and their validity (s,).
    observe : the observations.
    draws : draws of the unknowns' prior, (c, q).

    :class:`InputError` where the forward map has no valid answer at any of them.
    """
    columns = np.arange(draws.shape[1])
    predictions: dict[str, list[np.ndarray]] = {name: [] for name in observe.parts}

    def sizes(rows: np.ndarray) -> dict[str, np.ndarray]:
        """Add the predictions at ``rows`` and return their norms, NaN where there is none."""
        means, valid = predict(rows)
        for name, values in means.items():
            predictions[name] += [*values[valid]]
        return {
            n: np.where(valid, [_norm(v) for v in values], np.nan) for n, values in means.items()
        }

    sizes(draws[:_DRAWS])
    middle, ends = np.median(draws, axis=0), np.stack([draws.min(axis=0), draws.max(axis=0)])
    one_by_one = np.where(np.eye(len(columns), dtype=bool), ends[:, None], middle)
    for norms in sizes(one_by_one.reshape(-1, len(columns))).values():
        low, high = np.reshape(norms, ends.shape)
        smaller = (high < low).astype(int)
        sizes(np.stack([ends[smaller, columns], ends[1 - smaller, columns]]))
    if not all(predictions.values()):
        raise InputError(
            f"the forward map has no valid answer at any of {_DRAWS} draws of the prior; "
            "give a prior inside the range in which it answers"
        )
    return {name: np.stack(values) for name, values in predictions.items()}


def _closest(predict: Predict, name: str, data: np.ndarray, draws: np.ndarray) -> np.ndarray:
    """Return predictions (s, ...) at more draws, and at the ends of descents towards the data."""
    low, high = draws.min(axis=0), draws.max(axis=0)
    width = np.where(high > low, high - low, 1.0)

    def gap(z: jax.Array) -> jax.Array:
        means, valid = predict(low + width * z)
        return jnp.where(valid, jnp.log1p(jnp.sum((means[name] - data) ** 2)), jnp.inf)

    rows = draws[:_MORE_DRAWS]
    means, valid = jax.jit(partial(jax.lax.map, predict))(jnp.asarray(rows))
    at_draws = np.asarray(means[name])[valid := np.asarray(valid)]
    nearest = np.argsort([_norm(row - data) for row in at_draws])[:_DESCENTS]
    value_and_gradient, one = jax.jit(jax.value_and_grad(gap)), jax.jit(predict)
    starts = (rows[valid][nearest] - low) / width
    ends = [minimise(value_and_gradient, z, low=0.0, high=1.0, iterations=_STEPS).x for z in starts]
    answers = [one(jnp.asarray(low + width * z)) for z in ends]
    return np.stack([*at_draws, *(np.asarray(m[name]) for m, fine in answers if bool(fine))])


def complaint(
    name: str, part: Observation, data: np.ndarray, predictions: np.ndarray, sd: float
) -> str | None:
    """Return a message if data (...) are far from all ``predictions`` (s, ...), else None."""
    y, g = np.ravel(data), predictions.reshape(len(predictions), -1)
    norms = np.array([_norm(row) for row in g])
    if not norms.min() > 0.0:
        return None  # predictions include 0: there is no scale to compare with
    size = _norm(y)
    along = np.array([row @ y for row in g / norms[:, None]])
    small = (size < norms / _FACTOR) & (norms - along > _NOISE_SD * sd)
    distances = np.array([_norm(y - row) for row in g])
    large = (size > _FACTOR * norms) & (distances > sd * (np.sqrt(y.size) + _NOISE_SD))
    if not (small.all() or large.all()):
        return None
    largest = np.abs(g).max(axis=1)
    predicted = f"{largest.min():.3g} to {largest.max():.3g} {part.unit}"
    if size == 0.0:
        return f"{name} data are all zero; predictions reach {predicted} ({_OVERRULE})"
    ratio = float(np.sqrt(norms.min() * norms.max())) / size
    word, times = ("smaller", ratio) if ratio > 1.0 else ("larger", 1.0 / ratio)
    return (
        f"{name} data are about {float(f'{times:.1g}'):g} times {word} than predicted (largest "
        f"{np.abs(y).max():.3g} against {predicted}): {_guess(part, size, norms, ratio)} "
        f"({_OVERRULE})"
    )


def _guess(part: Observation, size: float, norms: np.ndarray, ratio: float) -> str:
    """Return the unit that would bring the data to the size of the predictions."""
    fitting = {
        unit: factor
        for unit, factor in other_units(part.unit).items()
        if norms.min() / _FACTOR < factor * size < norms.max() * _FACTOR
    }
    unit = min(fitting, key=lambda other: abs(np.log(fitting[other] / ratio)), default="")
    if in_pixels(part.unit, ratio, fitting.get(unit)):
        return PIXELS
    if not fitting:
        return "check their unit, and that they belong to this scene"
    return f"{unit} instead of {part.unit}? multiply by {fitting[unit]:g}"


def _norm(values: np.ndarray) -> float:
    """Return the Euclidean norm, also of numbers whose squares overflow."""
    largest = float(np.abs(values).max(initial=0.0))
    return largest * float(np.linalg.norm(values / largest)) if largest > 0.0 else 0.0
