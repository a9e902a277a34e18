r"""What data would determine, before there is any: Fisher information.

With :math:`g(x)` the data without noise as a function of the unknowns :math:`x = \log\theta`
(:math:`\theta` itself where it may be 0 or below), and :math:`I_\varepsilon` the information of the
noise about its mean, the data hold the information

.. math:: F = J^T I_\varepsilon J, \qquad J = \partial g / \partial x, \qquad
          I_\varepsilon = -\partial^2_\mu \log p(y \mid \mu)\big|_{y = \mu}

about x, and with a prior of covariance P the posterior's covariance is about
:math:`(F + P^{-1})^{-1}`. Gaussian noise of covariance C has :math:`I_\varepsilon = C^{-1}`; for
Student's t this is the curvature at its centre, somewhat more than its information. F is averaged
over draws of the prior, or taken at one theta.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from calibrate.identifiability.combinations import combinations, prior_table
from calibrate.noise.information import information_about_means
from calibrate.observations import Observations
from calibrate.statistical_model import Model
from emulator.errors import InputError

_DRAWS = 64


def expected_precision(
    model: Model, at: Mapping[str, float] | None = None, *, draws: int = _DRAWS
) -> dict[str, Any]:
    """What ``model``'s observations would determine, before any data; plain JSON.

    Parameters
    ----------
    at : unknowns by name where the information is taken; its mean over ``draws`` draws of the
        prior by default.

    Returns
    -------
    sd : per unknown, its expected posterior sd relative to the prior's, in log theta where all
        unknowns are positive.
    combinations : as of :func:`~calibrate.identifiability.identify`; empty where an unknown may be
        0 or below.

    Raises
    ------
    InputError
        The forward map has no answer at any of the draws, or noise has no known sd.
    """
    if any(model.noise_sites.values()):
        raise InputError(
            "identifiability: give every noise a known sd, as in GaussianNoise(sd=...)"
        )
    names, prior = model.states.unknowns, prior_table(model)
    positive = bool((prior > 0.0).all())
    where = prior[:draws] if at is None else np.array([[at[name] for name in names]])
    information = np.mean(informations(model, where, log=positive), axis=0)
    before = np.atleast_2d(np.cov(np.log(prior) if positive else prior, rowvar=False))
    after = np.linalg.inv(information + np.linalg.inv(before))
    ratio = np.sqrt(np.diagonal(after) / np.diagonal(before))
    return {
        "sd": dict(zip(names, ratio.tolist(), strict=True)),
        "combinations": combinations(names, after, before) if positive else [],
    }


def informations(model: Model, values: np.ndarray, *, log: bool) -> np.ndarray:
    """Fisher information (s, q, q) of the model's data at ``values`` (s, q), valid ones only."""
    sensitivity = sensitivities(model, model.observe, log=log)
    curvature = jax.jit(partial(information_about_means, model.noise))
    found = []
    for x in np.log(values) if log else values:
        means, J, valid = sensitivity(jnp.asarray(x))
        if valid:
            found.append(np.asarray(J.T @ curvature(means) @ J))
    if not found:
        raise InputError("identifiability: the forward map has no valid answer at any draw")
    return np.stack(found)


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
