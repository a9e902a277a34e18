"""A forward map linear in theta, whose posterior is known in closed form."""

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist

import calibrate as cal
from emulator.fem.solution import Solution, Status
from emulator.fem.unloading import unchecked
from emulator.scenes.scene import all_nodes
from emulator.surrogates.protocol import Prediction, fingerprint_of


@dataclass(frozen=True, eq=False)
class LinearForward:
    """u = A theta + b at every node; ``limit`` makes theta above it invalid."""

    scene: object
    nodes: np.ndarray
    matrix: np.ndarray
    shift: np.ndarray
    limit: float = np.inf

    kind = label = "linear"

    @property
    def fingerprint(self):
        return fingerprint_of(self.scene.fingerprint, self.nodes, self.matrix, self.shift)

    def __call__(self, theta):
        return jnp.tensordot(self.matrix, theta, axes=1) + self.shift

    def evaluate(self, theta):
        return Prediction(self(theta), jnp.all(theta < self.limit))

    def at(self, nodes):
        return replace(self, nodes=nodes, matrix=self.matrix[nodes], shift=self.shift[nodes])


def linear_forward(scene, seed=0, size=0.01, bias=0.0, of=LinearForward, **more) -> LinearForward:
    rng = np.random.default_rng(seed)
    count = len(scene.mesh.nodes)
    matrix = size * rng.normal(size=(count, 3, len(scene.parameters)))
    return of(scene, all_nodes(scene), matrix, np.full((count, 3), bias), **more)


def about_zero(scene, *names):
    """``scene`` with these parameters on a uniform scale, in a range that no scene may have."""
    parameters = (
        replace(each, low=-each.high, scale="uniform") if each.name in names else each
        for each in scene.parameters
    )
    return unchecked(scene, parameters=tuple(parameters))


class Step:
    """``forward``, 1 mm off where mu is above ``edge``."""

    kind = label = fingerprint = "step"

    def __init__(self, forward, edge):
        self.forward, self.edge = forward, edge
        self.nodes, self.scene = forward.nodes, forward.scene

    def at(self, nodes):
        return Step(self.forward.at(nodes), self.edge)

    def __call__(self, theta):
        return self.forward(theta) + jnp.where(theta[0] > self.edge, 1.0, 0.0)

    def evaluate(self, theta):
        return self.forward.evaluate(theta)._replace(displacement=self(theta))


def closed_form(forward, nodes, data, sd, mean, prior_sd):
    """Mean and covariance of theta given data under a Gaussian prior."""
    A = forward.matrix[nodes].reshape(-1, len(mean))
    y = (np.asarray(data) - forward.shift[nodes]).ravel()
    precision = A.T @ A / sd**2 + np.diag(1.0 / prior_sd**2)
    covariance = np.linalg.inv(precision)
    return covariance @ (A.T @ y / sd**2 + mean / prior_sd**2), covariance


PRIOR_MEAN, PRIOR_SD = np.array([70.0, 75.0]), np.array([5.0, 8.0])


def linear_problem(scene, forward=None):
    """A linear-Gaussian model of three displacements of a scene, and data: (model, data)."""
    forward = linear_forward(scene) if forward is None else forward
    prior = {
        name: dist.Normal(m, s)
        for name, m, s in zip(scene.parameter_names, PRIOR_MEAN, PRIOR_SD, strict=True)
    }
    observe = cal.nodal_displacements(scene, [3, 11, 20])
    model = cal.model(forward, observe, cal.GaussianNoise(sd=0.1), prior)
    noise = 0.1 * np.random.default_rng(0).normal(size=(3, 3))
    exact = linear_forward(scene).at(observe.nodes)(jnp.array([72.0, 68.0]))
    return model, np.asarray(exact) + noise


class LinearSimulator:
    """Stands for FEM: a map that converges wherever it is valid."""

    class system:
        forces = ("no energy: nothing to ask about stability",)

    def __init__(self, forward):
        self.forward, self.scene, self.solves = forward, forward.scene, 0

    def solve(self, theta, start=None):
        self.solves += 1
        u, valid = self.forward.evaluate(theta)
        status = Status.CONVERGED if bool(valid) else Status.ITERATION_LIMIT
        return Solution(u, jnp.array(status), *[jnp.array(0.0)] * 4)

    def sensitivities(self, u, theta):
        return jnp.moveaxis(jax.jacfwd(self.forward)(theta), -1, 0)


@dataclass(frozen=True, eq=False)
class Even(LinearForward):
    """A forward map that is even in mu about 75: theta and its mirror image predict the same."""

    def __call__(self, theta):
        return jnp.ones((len(self.nodes), 3)) * ((theta[0] - 75.0) / 10.0) ** 2


def share_and_evidence():
    """Share of the upper mode, and log evidence, of the model with two modes."""
    mu = np.linspace(30.0, 120.0, 900_001)
    z = (1.0 - ((mu - 75.0) / 10.0) ** 2) / 0.1
    height = 3 * (-0.5 * z**2 - np.log(0.1 * np.sqrt(2 * np.pi)))
    height += -0.5 * ((mu - 73.0) / 9.0) ** 2 - np.log(9.0 * np.sqrt(2 * np.pi))
    density = np.exp(height)
    total = density.sum() * (mu[1] - mu[0])
    return density[mu > 75].sum() * (mu[1] - mu[0]) / total, np.log(total)


@dataclass(frozen=True, eq=False)
class Bent(LinearForward):
    """A forward map that sees one number, Young's modulus, of theta."""

    def __call__(self, theta):
        mu, lam = theta[0], theta[1]
        value = mu * (3 * lam + 2 * mu) / (lam + mu)
        return jnp.ones((len(self.nodes), 3)) * value / 200.0


def bent_problem(beam):
    """Model and data whose posterior is a curve a thousandth wide across the whole box."""
    forward = linear_forward(beam, of=Bent)
    model = cal.model(forward, cal.nodal_displacements(beam, [3, 4, 5]), cal.GaussianNoise(sd=1e-3))
    return model, np.asarray(forward.at(np.array([3, 4, 5]))(jnp.array([70.0, 70.0])))
