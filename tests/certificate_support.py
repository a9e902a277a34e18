"""Posteriors of linear maps with exact draws, for tests of certificates."""

import arviz_base
import jax.numpy as jnp
import numpy as np

import calibrate as cal
from calibrate.posterior import Posterior
from linear_support import linear_forward

NODES = [3, 11, 20]
TRUTH = np.array([72.0, 68.0])


def linear_model(beam, sd=0.1, forward=None, nodes=NODES):
    forward = linear_forward(beam, size=0.02) if forward is None else forward
    return cal.model(forward, cal.nodal_displacements(beam, nodes), cal.GaussianNoise(sd=sd))


def exact_data(model, seed=0, sd=0.1):
    """Data of ``TRUTH`` (3, 3) with noise."""
    mean = np.asarray(model.forward(jnp.asarray(TRUTH)))
    return mean + sd * np.random.default_rng(seed).normal(size=mean.shape)


def grid_of(steps=400):
    """Points (g, 2) of the beam's box, 50 to 100 kPa in both moduli."""
    axis = 50.0 + 50.0 * (np.arange(steps) + 0.5) / steps
    return np.stack(np.meshgrid(axis, axis, indexing="ij"), -1).reshape(-1, 2)


def quadrature(forward, data, sd=0.1, points=None, nodes=NODES):
    """Weights (g,) of :func:`grid_of`'s points under a log-uniform prior."""
    points = grid_of() if points is None else points
    at = forward.at(np.array(nodes))
    A, b = np.asarray(at.matrix).reshape(-1, 2), np.asarray(at.shift).ravel()
    log = -0.5 * ((points @ A.T + b - data.ravel()) ** 2).sum(1) / sd**2 - np.log(points).sum(1)
    weights = np.exp(log - log.max())
    return weights / weights.sum()


def posterior_of(model, data, theta, chains=4, diverging=0):
    """A Posterior whose draws are ``theta`` (s, p)."""
    shape = (chains, len(theta) // chains)
    flags = np.zeros(shape, dtype=bool)
    flags.flat[:diverging] = True
    draws = {n: theta[:, k].reshape(shape) for k, n in enumerate(model.names)}
    tree = arviz_base.from_dict({"posterior": draws, "sample_stats": {"diverging": flags}})
    tree.attrs["run"] = "{}"
    return Posterior(tree, model, model.check_data(data))


def exact_posterior(model, data, sd=0.1, count=4000, seed=1, keep=None):
    """Independent draws of ``model``'s posterior, by quadrature; ``keep`` chooses among points."""
    points, rng = grid_of(), np.random.default_rng(seed)
    weights = quadrature(model.full, data, sd, points)
    if keep is not None:
        weights = np.where(keep(points), weights, 0.0)
    rows = rng.choice(len(points), size=count, p=weights / weights.sum())
    jitter = rng.uniform(-0.0625, 0.0625, size=(count, 2))
    return posterior_of(model, data, points[rows] + jitter)
