r"""Fisher information of the data about the unknowns.

With :math:`g(x)` the data without noise as a function of the unknowns :math:`x = \log\theta`
(:math:`\theta` itself where it may be 0 or below), and :math:`I_\varepsilon` the information of the
noise about its mean, the data hold the information

.. math:: F = J^T I_\varepsilon J, \qquad J = \partial g / \partial x, \qquad
          I_\varepsilon = -\partial^2_\mu \log p(y \mid \mu)\big|_{y = \mu}

about x, and with a normal prior of covariance P the posterior's covariance is about
:math:`(F + P^{-1})^{-1}`. Gaussian noise of covariance C has :math:`I_\varepsilon = C^{-1}`; for
Student's t this is the curvature at its centre, somewhat more than its information.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from calibrate.noise.information import information_about_means
from calibrate.observations import Observations
from calibrate.statistical_model import Model
from emulator.errors import InputError


def informations(model: Model, values: np.ndarray, *, log: bool) -> np.ndarray:
    """Fisher information (s, q, q) of the model's data at ``values`` (s, q), valid ones only."""
    sensitivity = sensitivities(model, model.observe, log=log)
    curvature = jax.jit(partial(_information, model))
    found = []
    for x in np.log(values) if log else values:
        means, J, valid = sensitivity(jnp.asarray(x))
        if valid:
            found.append(np.asarray(J.T @ curvature(means, np.exp(x) if log else x) @ J))
    if not found:
        raise InputError("identifiability: the forward map has no valid answer at any draw")
    return np.stack(found)


def _information(model: Model, means: dict[str, jax.Array], unknowns: jax.Array) -> jax.Array:
    """Information (d, d) of the data about its means, less what errors besides noise take of it.

    An error of unknown size has its prior's mean.
    """
    found = information_about_means(model.noise, means)
    if model.error is None:
        return found
    sizes = [jnp.asarray(prior.mean) for prior in model.error.priors.values()]
    return model.error.information_left(found, jnp.concatenate([unknowns, jnp.array(sizes)]))


def sensitivities(
    model: Model, observe: Observations, *, log: bool
) -> Callable[[jax.Array], tuple[dict[str, jax.Array], jax.Array, jax.Array]]:
    """Data by name, its Jacobian (d, q) over all data, and its validity, from x (q,); compiled.

    ``observe`` may be other observations than the model's, of all of its load states or some.
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

    def both(x: jax.Array) -> tuple[dict[str, jax.Array], jax.Array, jax.Array]:
        J, (means, valid) = jax.jacfwd(data, has_aux=True)(x)
        return means, J, valid

    return jax.jit(both)
