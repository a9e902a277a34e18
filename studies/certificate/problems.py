"""Calibration problems whose FEM posterior is known, and wrong maps for them.

A cheap exact map stands for FEM, so that the true posterior comes from quadrature or a closed form:

beam   : the shipped emulator of the once-clamped beam (1e-9 mm from FEM); (mu, lam) lie on a thin,
         bent ridge; quadrature.
five   : a map linear in the ventricle's five parameters; closed form.
modes  : a map even in mu - 75 kPa: two modes; quadrature.
hidden : five's map, even in one direction: two modes, 12 sd apart; Gaussian in what is even.
"""

from dataclasses import dataclass, field, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from studies.common.twins import spread_nodes

import calibrate as cal
import emulator as em


@dataclass(frozen=True, eq=False)
class Map:
    """A forward map from a function of theta to displacements (n, 3), for all nodes or some."""

    scene: Any
    function: Any
    nodes: np.ndarray
    kind = label = "study"

    @property
    def fingerprint(self):
        return f"{self.scene.fingerprint} {id(self.function)} {hash(self.nodes.tobytes())}"

    def __call__(self, theta):
        return self.function(theta, self.nodes)

    def evaluate(self, theta):
        return em.Prediction(self(theta), jnp.array(True))

    def at(self, nodes):
        return replace(self, nodes=nodes)


class System:
    forces = ("no energy to ask",)


class ExactSimulator:
    """Stands for FEM: a map that is taken to be exact."""

    system = System()

    def __init__(self, forward):
        self.scene, self._solve = forward.scene, jax.jit(forward)
        self._slopes = jax.jit(jax.jacfwd(forward))

    def solve(self, theta, start=None):  # noqa: ARG002 - as FEM takes it
        u = self._solve(theta)
        return em.fem.Solution(u, jnp.array(em.fem.Status.CONVERGED), *[jnp.array(0.0)] * 4)

    def sensitivities(self, u, theta):  # noqa: ARG002 - as FEM takes it
        return jnp.moveaxis(self._slopes(theta), -1, 0)


@dataclass(frozen=True, eq=False)
class Problem:
    """FEM's map, what is observed with which noise sd (mm), the true theta, and where to integrate.

    low, high, steps : of the quadrature; ``None`` where the posterior is Gaussian.
    """

    name: str
    forward: Map
    nodes: np.ndarray
    noise: float
    truth: np.ndarray
    low: tuple[float, ...] = ()
    high: tuple[float, ...] = ()
    steps: tuple[int, ...] = ()
    cache: dict = field(default_factory=dict)

    @property
    def scene(self):
        return self.forward.scene

    def data(self, seed):
        exact = np.asarray(self.forward.at(self.nodes)(jnp.asarray(self.truth)))
        return exact + np.random.default_rng([2, seed]).normal(0.0, self.noise, exact.shape)

    def grid(self):
        """Points (g, p) of the quadrature, their log prior, and FEM's predictions there (g, m)."""
        if not self.cache:
            axes = [
                a + (np.arange(n) + 0.5) * (b - a) / n
                for a, b, n in zip(self.low, self.high, self.steps, strict=True)
            ]
            points = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, len(axes))
            self.cache.update(points=points, exact=self.on_grid(self.forward, points))
        return self.cache["points"], self.cache["exact"]

    def on_grid(self, forward, points):
        at = forward.at(self.nodes)
        flat = jax.jit(lambda t: jax.lax.map(lambda x: at(x).ravel(), t, batch_size=512))
        return np.asarray(flat(jnp.asarray(points)))

    def log_prior(self, points):
        scales = [p.scale for p in self.scene.parameters]
        return -sum(np.log(points[:, k]) for k, s in enumerate(scales) if s == "log")


def moments_of(weights, points):
    mean = weights @ points
    return mean, np.sqrt(weights @ (points - mean) ** 2)


def by_quadrature(problem, predictions, data, sd):
    """Weights (g,) of the grid under predictions (g, m)."""
    points, _ = problem.grid()
    log = problem.log_prior(points) - 0.5 * ((predictions - data.ravel()) ** 2).sum(1) / sd**2
    weights = np.exp(log - log.max())
    return weights / weights.sum()


def gaussian(problem, forward, data, sd):
    """Mean and covariance of a linear map's posterior under a flat prior, from its values."""
    at, p = forward.at(problem.nodes), len(problem.truth)
    base = np.asarray(at(jnp.zeros(p))).ravel()
    columns = [np.asarray(at(jnp.eye(p)[k])).ravel() - base for k in range(p)]
    A = np.stack(columns, axis=1)
    covariance = sd**2 * np.linalg.inv(A.T @ A)
    return covariance @ A.T @ (data.ravel() - base) / sd**2, covariance


def sample_grid(problem, weights, count, rng):
    """Independent draws (count, p), uniform within a cell."""
    points, _ = problem.grid()
    widths = (np.array(problem.high) - problem.low) / problem.steps
    rows = rng.choice(len(points), size=count, p=weights)
    return points[rows] + widths * rng.uniform(-0.5, 0.5, size=(count, len(widths)))


def posterior_of(model, data, draws, chains=4, diverging=0):
    """A Posterior from draws (s, p) of theta."""
    import arviz_base

    shape = (chains, len(draws) // chains)
    flags = np.zeros(shape, dtype=bool)
    flags.flat[:diverging] = True
    names = model.forward.scene.parameter_names
    tree = arviz_base.from_dict(
        {
            "posterior": {n: draws[:, k].reshape(shape) for k, n in enumerate(names)},
            "sample_stats": {"diverging": flags},
        }
    )
    return cal.Posterior(tree, model, model.check_data(data))


# ---- problems ----------------------------------------------------------------------------------
def beam():
    emulator = em.load("once_clamped_beam", kind="series").cache()
    observe = spread_nodes(emulator.scene, 20, 0)
    forward = Map(emulator.scene, Restricted(emulator), np.arange(emulator.scene.node_count))
    truth = np.array([73.0, 61.0])
    return Problem("beam", forward, observe, 0.2, truth, (60.0, 50.0), (86.0, 100.0), (1500, 120))


class Restricted:
    """An emulator as a function of theta and nodes, restricted once for each set of nodes."""

    def __init__(self, emulator):
        self.emulator, self.known = emulator, {}

    def __call__(self, theta, nodes):
        key = np.asarray(nodes).tobytes()
        if key not in self.known:
            self.known[key] = self.emulator.at(nodes)
        return self.known[key](theta)


def linear(scene, matrix, shift, feature=lambda theta: theta):
    def function(theta, nodes):
        return jnp.tensordot(matrix[nodes], feature(theta), axes=1) + shift[nodes]

    return Map(scene, function, np.arange(scene.node_count))


def five():
    scene = em.scenes.left_ventricle(rings=4, around=8, layers=1, order=1)
    rng = np.random.default_rng(5)
    low, high = (np.array([getattr(p, e) for p in scene.parameters]) for e in ("low", "high"))
    # Every parameter is known to about 4 % of its range, with correlations.
    matrix = rng.normal(size=(len(scene.mesh.nodes), 3, 5)) + rng.normal(size=(1, 3, 5))
    matrix *= 0.2 / (0.04 * (high - low) * np.sqrt(60.0))
    forward = linear(scene, matrix, np.zeros((len(scene.mesh.nodes), 3)))
    nodes = spread_nodes(scene, 20, 1)
    return Problem("five", replace(forward), nodes, 0.2, 0.5 * (low + high))


APART = 6.0  # sd of each mode of ``hidden`` from the plane between them


def hidden():
    """Data see the square of the widest direction of ``five``, scaled to the slope 1 at a mode."""
    problem = five()
    along, up = mirror(problem)
    centre, linear_ = problem.truth, problem.forward

    def function(theta, nodes):
        x = along @ (theta - centre)
        even = 0.5 * (x**2 / APART - APART)
        return linear_.function(theta + (even - x) * up, nodes)

    forward = replace(linear_, function=function)
    return Problem("hidden", forward, problem.nodes, problem.noise, centre + APART * up)


def mirror(problem):
    """Direction ``along`` (p,) in which ``x = along . (theta - truth)`` has sd 1, and a step of it.

    ``up`` (p,) changes x by 1 and whatever is independent of x in the posterior by nothing.
    """
    _, covariance = gaussian(problem, problem.forward, problem.data(0), problem.noise)
    along = np.eye(len(covariance))[0] / np.sqrt(covariance[0, 0])
    return along, covariance @ along


def modes():
    scene = em.scenes.once_clamped_beam(cells=(4, 2, 2), order=1)
    rng = np.random.default_rng(6)
    matrix = rng.normal(size=(len(scene.mesh.nodes), 3, 2)) * np.array([0.004, 0.03])
    forward = linear(scene, matrix, np.zeros((len(scene.mesh.nodes), 3)), lambda t: fold(t))
    nodes = spread_nodes(scene, 10, 2)
    truth = np.array([87.0, 70.0])
    return Problem("modes", forward, nodes, 0.2, truth, (50.0, 50.0), (100.0, 100.0), (700, 300))


def fold(theta):
    """Even in mu - 75 kPa."""
    return jnp.array([(theta[0] - 75.0) ** 2, theta[1]])
