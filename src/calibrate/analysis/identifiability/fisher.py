r"""Fisher information of the data about the unknowns.

With :math:`g(x)` the data without noise as a function of the unknowns :math:`x = \log\theta`
(:math:`\theta` itself where it may be 0 or below), and S the covariance of the data about it, the
data hold the information

.. math:: F = J^T S^{-1} J, \qquad J = \partial g / \partial x, \qquad S = C + \alpha^2 V V^T

about x, with the noise's covariance C and, where many numbers share errors, the modes V and the
size :math:`\alpha` of these (:mod:`calibrate.statistical_model.error_modes`, which has
:math:`S^{-1}` by Woodbury's identity). With a normal prior of covariance P the posterior's
covariance is about :math:`(F + P^{-1})^{-1}`. S is in the data's units squared, F in one over
those of x squared: none for :math:`\log\theta`. How S changes with x is left out of F.

For noise that is not Gaussian :math:`C^{-1}` is the curvature
:math:`-\partial^2_\mu \log p(y \mid \mu)` at :math:`y = \mu`: for Student's t somewhat more than
its information.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from calibrate.measurements import Observations
from calibrate.noise import Noise
from calibrate.noise.information import information_about_means
from calibrate.statistical_model import Model
from calibrate.statistical_model.error_modes import ErrorModes
from emulator.core.errors import InputError

At = Callable[[jax.Array, ErrorModes | None, jax.Array], tuple[jax.Array, jax.Array]]
"""From x (q,), the errors that numbers share, if any, and the unknowns (m,) of these: F (q, q), and
whether the map is valid there."""


def information_at(
    model: Model, observe: Observations, noise: Mapping[str, Noise], *, log: bool
) -> At:
    """F of data ``observe`` with ``noise`` of known sd, as a function of x.

    Both may be other than the model's: a measurement to add, in all of its load states or some.

    Raises
    ------
    InputError
        A load state that the model does not have.
    """
    names, known = model.states.unknowns, model.states.states
    for state in observe.states:
        if state not in known:
            given = f"load state '{state}' is unknown" if state else "no load state is named"
            raise InputError(f"{given}; known: {', '.join(filter(None, known)) or 'none'}")
    rows = np.array([known.index(state) for state in observe.states])
    forward = model.full.at(observe.nodes)

    def data(x: jax.Array) -> tuple[jax.Array, tuple[dict[str, jax.Array], jax.Array]]:
        values = dict(zip(names, jnp.exp(x) if log else x, strict=True))
        thetas = model.states.thetas(values)[rows]
        predictions = [forward.evaluate(theta) for theta in thetas]
        means = observe(jnp.stack([p.displacement for p in predictions]), thetas)
        valid = jnp.all(jnp.stack([p.valid for p in predictions]))
        return ravel_pytree(means)[0], (means, valid)

    def at(x: jax.Array, error: ErrorModes | None, sizes: jax.Array) -> tuple[jax.Array, jax.Array]:
        J, (means, valid) = jax.jacfwd(data, has_aux=True)(x)
        about_means = information_about_means(noise, means)
        if error is not None:
            unknowns = jnp.concatenate([jnp.exp(x) if log else x, sizes])
            about_means = error.information_left(about_means, unknowns, means)
        return J.T @ about_means @ J, valid

    return at
