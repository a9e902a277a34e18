"""Minimise a smooth function of a few numbers: L-BFGS-B that survives values that are not finite.

A likelihood may be infinite, or its gradient NaN, at a trial point where a solve fails. SciPy's
line search would then return NaN. Such a point gets a value far above all others and no slope, so
that the line search shortens its step.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import Bounds, minimize

_REJECTED = 1e10  # value of a point that is not finite, over the size of the first point's value

ValueAndGradient = Callable[[np.ndarray], tuple[Any, Any]]
"""A point (q,) to the value () and the gradient (q,) there, as ``jax.value_and_grad`` gives."""


class Minimum(NamedTuple):
    """The end of a minimisation.

    x : the point, (q,).
    value : the function's value at ``x``; infinite if no finite value was found.
    converged : whether the optimiser met its tolerance, at a finite value.
    """

    x: np.ndarray
    value: float
    converged: bool


def minimise(
    function: ValueAndGradient,
    start: np.ndarray,
    *,
    low: Any = None,
    high: Any = None,
    iterations: int = 15_000,
    tolerance: float = 2.220446049250313e-09,
) -> Minimum:
    """Return the minimum of ``function`` that L-BFGS-B descends to from ``start``.

    function : value and gradient at a point; either may be infinite or NaN.
    start : the first point, (q,); it may have no entry.
    low, high : bounds of the point, () or (q,), which ``start`` satisfies; ``None`` for none.
    iterations : the largest number of iterations.
    tolerance : relative decrease of the value in one iteration below which the search ends.
    """
    start = np.asarray(start, dtype=float)
    first, _ = arrays = _arrays(function(start))
    rejection_value = _REJECTED * max(1.0, abs(float(first)) if np.isfinite(first) else 1.0)

    def guarded(x: np.ndarray) -> tuple[float, np.ndarray]:
        value, gradient = arrays if np.array_equal(x, start) else _arrays(function(x))
        if np.isfinite(value) and np.isfinite(gradient).all():
            return float(value), gradient
        return rejection_value, np.zeros_like(start)

    if not len(start):
        value, converged, x = guarded(start)[0], True, start
    else:
        bounds = Bounds(-np.inf if low is None else low, np.inf if high is None else high)
        options = {"maxiter": iterations, "ftol": tolerance}
        result = minimize(
            guarded, start, jac=True, method="L-BFGS-B", bounds=bounds, options=options
        )
        value, converged, x = float(result.fun), bool(result.success), result.x
    finite = value < rejection_value
    return Minimum(x, value if finite else np.inf, converged and finite)


def _arrays(result: tuple[Any, Any]) -> tuple[np.ndarray, np.ndarray]:
    value, gradient = result
    return np.asarray(value, dtype=float), np.asarray(gradient, dtype=float)
