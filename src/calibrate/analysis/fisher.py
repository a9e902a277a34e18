r"""Fisher information of the data about the unknowns, errors that many numbers share included.

With :math:`g(x)` the data without noise as a function of the unknowns :math:`x = \log\theta`
(:math:`\theta` itself where it may be 0 or below), and S the covariance of the data about it, the
data hold the information

.. math:: F = J^T S^{-1} J, \qquad J = \partial g / \partial x, \qquad S = C + \alpha^2 V V^T

about x, with the noise's covariance C and, where many numbers share errors, their modes V and
size :math:`\alpha` (:mod:`calibrate.model_error.marginal`, which has :math:`S^{-1}` by
Woodbury's identity). With a normal prior of covariance P the posterior's covariance is about
:math:`(F + P^{-1})^{-1}`. S is in the data's units squared, F in one over those of x squared: none
for :math:`\log\theta`. How S changes with x is left out of F. For noise that is not Gaussian
:math:`C^{-1}` is the curvature :math:`-\partial^2_\mu \log p(y \mid \mu)` at :math:`y = \mu`: for
Student's t somewhat more than its information.

Data sets that are not measured yet differ in their shared errors: modes that depend on where points
were seen, as pins' modes do, are made of the mean :math:`g(x_r)` of each set, so that the errors of
all sets are one object with a leading axis. They are marginalised: y is Gaussian about g(x) with

.. math:: S_r(\alpha) = C + V_r V_r^T + \alpha^2 U_r U_r^T, \qquad V_r = V(g(x_r)),

the covariance of the noise, of errors of known size and of errors whose size :math:`\alpha` is
inferred, in the data's units squared. An error that is a share of the prediction follows x itself.
A fit to measured data does not know :math:`g(x_r)` and takes the data for it where points were seen
(:mod:`calibrate.model_error.kinds`).

Before data, a size that is inferred is integrated over its prior, with distribution function
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
from jax.flatten_util import ravel_pytree
from jax.scipy.special import logsumexp

from calibrate.measurements import Observations
from calibrate.model_error.marginal import Means, ModelError
from calibrate.noise import Noise, information_about_means
from calibrate.statistical_model import Model
from emulator.core.errors import InputError

At = Callable[[jax.Array, ModelError | None, jax.Array], tuple[jax.Array, jax.Array]]
"""The function of x (q,), the shared errors (or ``None``) and their unknowns (m,) that returns the
information F (q, q), and whether the map is valid at x."""


def information_at(
    model: Model, observe: Observations, noise: Mapping[str, Noise], *, log: bool
) -> At:
    """Return F of data ``observe`` with ``noise`` of known sd, as a function of x.

    Both may be other than the model's: a measurement to add, in all of its load states or some.

    Raises
    ------
    InputError
        A load state that the model does not have.
    """
    names, known = model.states.unknowns, model.states.states
    for state in observe.states:
        if state not in known:
            problem = f"load state '{state}' is unknown" if state else "no load state is named"
            raise InputError(f"{problem}; known: {', '.join(filter(None, known)) or 'none'}")
    rows = np.array([known.index(state) for state in observe.states])
    forward = model.full.at(observe.nodes)

    def data(x: jax.Array) -> tuple[jax.Array, tuple[dict[str, jax.Array], jax.Array]]:
        values = dict(zip(names, jnp.exp(x) if log else x, strict=True))
        thetas = model.states.thetas(values)[rows]
        predictions = [forward.evaluate(theta) for theta in thetas]
        means = observe(jnp.stack([p.displacement for p in predictions]), thetas)
        valid = jnp.all(jnp.stack([p.valid for p in predictions]))
        return ravel_pytree(means)[0], (means, valid)

    def at(x: jax.Array, error: ModelError | None, sizes: jax.Array) -> tuple[jax.Array, jax.Array]:
        J, (means, valid) = jax.jacfwd(data, has_aux=True)(x)
        about_means = information_about_means(noise, means)
        if error is not None:
            unknowns = jnp.concatenate([jnp.exp(x) if log else x, sizes])
            about_means = error.information_left(about_means, unknowns, means)
        return J.T @ about_means @ J, valid

    return at


_SIZES = 32

Errors = Callable[[Mapping[str, Any]], ModelError | None]
"""The function of data without noise, by name, that returns the model's errors besides noise."""


def of_each(errors: Errors, means: Mapping[str, jax.Array]) -> ModelError | None:
    """Return the errors of all data sets, stacked along a leading axis; means (r, ...) by name."""
    arrays = {name: np.asarray(values) for name, values in means.items()}
    count = len(next(iter(arrays.values())))
    each = [errors({name: values[k] for name, values in arrays.items()}) for k in range(count)]
    leaves = zip(*(jax.tree.leaves(error) for error in each), strict=True)
    return jax.tree.unflatten(jax.tree.structure(each[0]), [_stacked(alike) for alike in leaves])


def _stacked(arrays: Sequence[Any]) -> np.ndarray:
    """Return the arrays stacked, with zeros for missing rows: a mode of zeros changes nothing."""
    shape = np.max([np.shape(array) for array in arrays], axis=0).astype(int)
    stack = np.zeros((len(arrays), *shape))
    for k, array in enumerate(arrays):
        corner: tuple[int | slice, ...] = (k, *(slice(size) for size in np.shape(array)))
        stack[corner] = array
    return stack


def sizes_of(error: ModelError | None, count: int = _SIZES) -> jax.Array:
    """Return equally probable sizes (count, 1) of the error; (count, 0) if its size is known."""
    priors = [] if error is None else list(error.priors.values())
    if not priors:
        return jnp.zeros((count, 0))
    (prior,) = priors
    return prior.icdf((jnp.arange(count) + 0.5) / count)[:, None]


def log_ratio(error: ModelError, theta: jax.Array, residual: Means, means: Means) -> jax.Array:
    """Return an error's share () of the log likelihood of ``residual`` at ``theta`` (q,)."""
    sizes = sizes_of(error) if error.priors else jnp.zeros((1, 0))

    def at(size: jax.Array) -> jax.Array:
        return error.log_ratio(jnp.concatenate([theta, size]), residual, means)

    each = jax.vmap(at)(sizes)
    return logsumexp(each) - jnp.log(len(sizes))
