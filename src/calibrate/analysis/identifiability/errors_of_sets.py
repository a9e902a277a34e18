r"""Errors that many numbers share, in data sets that are not measured yet.

Data sets differ in them: modes that depend on where points were seen, as pins', are made of the
mean :math:`g(x_r)` of each set, and errors of all sets are then one, with a leading axis. They are
marginalised (:mod:`calibrate.statistical_model.error_modes`): y is Gaussian about g(x) with

.. math:: S_r(\alpha) = C + V_r V_r^T + \alpha^2 U_r U_r^T, \qquad V_r = V(g(x_r)),

the covariance of the noise, of errors of known size and of those whose size :math:`\alpha` is
inferred, in the data's units squared; what is a share of the prediction follows x itself. Fitting
measured data knows no :math:`g(x_r)` and takes the data for it where points were seen
(:mod:`calibrate.statistical_model.shared_errors`).

Before data a size that is inferred is integrated over its prior, with distribution function
:math:`\Phi`, by K values that are equally probable:

.. math:: p(y \mid x) = \frac1K \sum_{k=1}^K N\left(y;\, g(x),\, S_r(\alpha_k)\right), \qquad
          \alpha_k = \Phi^{-1}\left(\tfrac{k - 1/2}{K}\right).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import logsumexp

from calibrate.statistical_model.error_modes import ErrorModes, Means

_SIZES = 32

Errors = Callable[[Mapping[str, Any]], ErrorModes | None]
"""From data without noise by name to the errors besides noise that a model has about it."""


def of_each(errors: Errors, means: Mapping[str, jax.Array]) -> ErrorModes | None:
    """Errors of each data set, as one with a leading axis, from means (r, ...) by name."""
    arrays = {name: np.asarray(values) for name, values in means.items()}
    count = len(next(iter(arrays.values())))
    each = [errors({name: values[k] for name, values in arrays.items()}) for k in range(count)]
    leaves = zip(*(jax.tree.leaves(error) for error in each), strict=True)
    return jax.tree.unflatten(jax.tree.structure(each[0]), [_stacked(alike) for alike in leaves])


def _stacked(arrays: Sequence[Any]) -> np.ndarray:
    """One array of several, with zeros where one has fewer rows: such a mode changes nothing."""
    shape = np.max([np.shape(array) for array in arrays], axis=0).astype(int)
    found = np.zeros((len(arrays), *shape))
    for k, array in enumerate(arrays):
        corner: tuple[int | slice, ...] = (k, *(slice(size) for size in np.shape(array)))
        found[corner] = array
    return found


def sizes_of(error: ErrorModes | None, count: int = _SIZES) -> jax.Array:
    """Sizes (count, 1) that are inferred, each as probable; (count, 0) where none is."""
    priors = [] if error is None else list(error.priors.values())
    if not priors:
        return jnp.zeros((count, 0))
    (prior,) = priors
    return prior.icdf((jnp.arange(count) + 0.5) / count)[:, None]


def log_ratio(error: ErrorModes, theta: jax.Array, residual: Means, means: Means) -> jax.Array:
    """What an error adds to the log likelihood of ``residual`` at ``theta`` (q,), shape ()."""
    sizes = sizes_of(error) if error.priors else jnp.zeros((1, 0))

    def at(size: jax.Array) -> jax.Array:
        return error.log_ratio(jnp.concatenate([theta, size]), residual, means)

    each = jax.vmap(at)(sizes)
    return logsumexp(each) - jnp.log(len(sizes))
