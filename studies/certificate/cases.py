"""Wrong maps and wrong draws of every kind, each with the posterior it leads to."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
from scipy.stats import truncnorm
from studies.certificate.problems import (
    APART,
    Map,
    Problem,
    by_quadrature,
    five,
    gaussian,
    mirror,
    moments_of,
    posterior_of,
    sample_grid,
)

import calibrate as cal

DRAWS = 4000


@dataclass(frozen=True)
class Case:
    """A posterior made wrong on purpose.

    kind, size : of the error; ``good`` where the map is good to 0.02 noise sd and nothing else is
    wrong. make : problem -> posterior, FEM's mean and sd.
    """

    problem: str
    kind: str
    size: float
    seed: int
    make: Callable[..., Any]
    good: bool = False
    budget: int | None = None

    @property
    def sampled(self):
        """Whether the map or the noise is what is wrong, and not the draws."""
        kinds = ("few", "stuck", "two_points", "box_cuts", "box_touches")
        return self.kind not in kinds

    @property
    def name(self):
        runs = "" if self.budget is None else f", {self.budget} runs"
        return f"{self.problem}, {self.kind} {self.size:g}, seed {self.seed}{runs}"


def with_map(problem, error, seed, *, noise=1.0, draws=None):
    """Independent draws of the posterior of FEM's map plus ``error``, and FEM's mean and sd.

    ``error`` : theta -> displacements (n, 3) of all nodes; ``noise`` factor on its sd.
    """
    rng = np.random.default_rng([3, seed])
    data = problem.data(seed)
    exact = problem.forward

    def function(theta, nodes):
        return exact.function(theta, nodes) + error(theta)[nodes]

    wrong = Map(problem.scene, function, exact.nodes)
    used = noise * problem.noise
    observe = cal.nodal_displacements(problem.scene, problem.nodes)
    # The closed form has a flat prior.
    flat = {p.name: dist.Uniform(p.low, p.high) for p in problem.scene.parameters}
    prior = None if problem.steps else flat
    # The truth is the posterior in this box.
    bounded = problem.scene.parameter_names if problem.steps else ()
    model = cal.model(wrong, observe, cal.GaussianNoise(sd=used), prior, bounded=bounded)
    if problem.steps:
        points, predictions = problem.grid()
        truth = moments_of(by_quadrature(problem, predictions, data, problem.noise), points)
        weights = by_quadrature(problem, problem.on_grid(wrong, points), data, used)
        if draws is not None:
            weights = draws(points, weights)
        chosen = sample_grid(problem, weights, DRAWS, rng)
    else:
        mean, covariance = gaussian(problem, exact, data, problem.noise)
        truth = mean, np.sqrt(np.diag(covariance))
        chosen = rng.multivariate_normal(*gaussian(problem, wrong, data, used), size=DRAWS)
    return posterior_of(model, data, chosen), truth


def pattern(problem: Problem, seed: int) -> np.ndarray:
    """An error of size 1 at every node and component (n, 3): where mu or a drives it, or random."""
    rng = np.random.default_rng([4, seed])
    if seed % 2:
        return rng.choice([-1.0, 1.0], size=(len(problem.scene.mesh.nodes), 3))
    step = np.zeros(len(problem.truth))
    step[seed // 2 % len(step)] = 1e-3
    moved = problem.forward(jnp.asarray(problem.truth + step)) - problem.forward(
        jnp.asarray(problem.truth)
    )
    return np.sign(np.asarray(moved))


def principal(problem: Problem, seed: int):
    """FEM's posterior mean, and the direction along which it is widest, in sd: theta -> ()."""
    data = problem.data(seed)
    if problem.steps:
        points, predictions = problem.grid()
        weights = by_quadrature(problem, predictions, data, problem.noise)
        mean = weights @ points
        covariance = ((points - mean) * weights[:, None]).T @ (points - mean)
    else:
        mean, covariance = gaussian(problem, problem.forward, data, problem.noise)
    sd = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance / np.outer(sd, sd))
    along = vectors[:, -1] / sd / np.sqrt(values[-1])
    return lambda theta: along @ (theta - mean)


def constant(problem, size, seed):
    error = size * problem.noise * pattern(problem, seed)
    return with_map(problem, lambda _: jnp.asarray(error), seed)


def growing(problem, size, seed):
    error, along = size * problem.noise * pattern(problem, seed), principal(problem, seed)
    return with_map(problem, lambda theta: error * along(theta), seed)


def rough(problem, size, seed):
    """Waves in theta much shorter than the posterior is wide, of random phase at every node."""
    rng = np.random.default_rng([5, seed])
    shape = (len(problem.scene.mesh.nodes), 3)
    phase = rng.uniform(0.0, 2.0 * np.pi, shape)
    waves = 2.0 * np.pi / np.array([1.1, 0.9])
    error = size * problem.noise * np.sqrt(2.0)
    return with_map(problem, lambda theta: error * jnp.sin(waves @ theta + phase), seed)


def hides(problem, size, seed):
    """``size`` mm wrong above the posterior's mean of the first parameter."""
    data = problem.data(seed)
    points, predictions = problem.grid()
    middle = by_quadrature(problem, predictions, data, problem.noise) @ points[:, 0]
    step = size * pattern(problem, seed)
    return with_map(problem, lambda theta: jnp.where(theta[0] > middle, step, 0.0), seed)


def bump(problem, size, seed):
    """``size`` mm wrong in a ball that holds no mass: it moves nothing."""
    along = principal(problem, seed)
    step = size * pattern(problem, seed)
    return with_map(
        problem, lambda theta: jnp.where(jnp.abs(along(theta) - 9.0) < 2.0, 1.0, 0.0) * step, seed
    )


def spoiled(problem, size, seed):
    """Every sensitivity wrong by a random ``size`` of itself, as from spoiled weights."""
    rng = np.random.default_rng([7, seed])
    factor = jnp.asarray(size * rng.normal(size=(len(problem.scene.mesh.nodes), 3)))
    nodes, truth = problem.forward.nodes, jnp.asarray(problem.scene.centre)

    def error(theta):
        return factor * (problem.forward.function(theta, nodes)
                         - problem.forward.function(truth, nodes))  # fmt: skip

    return with_map(problem, error, seed)


def wrong_noise(problem, size, seed):
    return with_map(problem, _nothing(problem), seed, noise=size)


def stuck(problem, size, seed):
    """All chains in one of two modes (``size`` 1), or one of four in the other (2)."""
    posterior, truth = with_map(
        problem, _nothing(problem), seed, draws=lambda x, w: _half(w, x[:, 0] > 75.0)
    )
    if size == 2:
        draws = np.stack(list(posterior.draws().values()), axis=1)
        draws[: DRAWS // 4, 0] = 150.0 - draws[: DRAWS // 4, 0]
        posterior = posterior_of(posterior.model, posterior.data["displacement"], draws)
    return posterior, truth


def _half(weights, kept):
    return np.where(kept, weights, 0.0) / weights[kept].sum()


def hidden_mode(problem, size, seed):
    """The map is ``size`` mm wrong within 4 sd of one of two modes: no draw is there."""
    rng, data = np.random.default_rng([8, seed]), problem.data(seed)
    straight = five()
    along, up = mirror(straight)
    # Given what is even, the rest is Gaussian; the flat prior's density of x is APART / |x| there.
    shifted = replace(straight, truth=problem.truth)
    even = gaussian(shifted, straight.forward, data, problem.noise)
    at = rng.multivariate_normal(*even, size=40 * DRAWS)
    value = along @ straight.truth
    square = APART**2 + 2.0 * APART * (at @ along - value)
    x = np.sqrt(np.maximum(square, 1e-12))
    weights = (square > 0.0) / x
    rows = rng.choice(len(at), size=DRAWS, p=weights / weights.sum())
    modes = [at + (sign * x - (at @ along - value))[:, None] * up for sign in (1.0, -1.0)]
    points = np.concatenate([mode[rows] for mode in modes])
    truth = points.mean(axis=0), points.std(axis=0)
    other, whiten = modes[1][rows].mean(axis=0), np.linalg.inv(np.cov(modes[1][rows].T))
    step = size * pattern(problem, seed)

    def error(theta):
        off = theta - other
        return step * jnp.where(off @ whiten @ off < 16.0 * len(other), 1.0, 0.0)

    exact = problem.forward
    wrong = Map(
        problem.scene, lambda theta, nodes: exact.function(theta, nodes) + error(theta)[nodes],
        exact.nodes,
    )  # fmt: skip
    flat = {p.name: dist.Uniform(p.low, p.high) for p in problem.scene.parameters}
    observe = cal.nodal_displacements(problem.scene, problem.nodes)
    model = cal.model(wrong, observe, cal.GaussianNoise(sd=problem.noise), flat)
    return posterior_of(model, data, modes[0][rows]), truth


def two_points(problem, size, seed):  # noqa: ARG001 - as every case
    """Draws with FEM's mean and covariance, each at one of two places along every axis."""
    posterior, truth = with_map(problem, _nothing(problem), seed)
    draws = np.stack(list(posterior.draws().values()), axis=1)
    rng = np.random.default_rng([9, seed])
    mean, root = draws.mean(axis=0), np.linalg.cholesky(np.cov(draws.T))
    signs = rng.choice([-1.0, 1.0], size=draws.shape)
    moved = mean + (signs + 0.02 * rng.normal(size=signs.shape)) @ root.T
    return posterior_of(posterior.model, posterior.data["displacement"], moved), truth


def box_cuts(problem, size, seed):
    """FEM's map in a box whose ends are ``size`` sd above the best values of 1 to 3 parameters.

    The truth is the posterior without a box, which is only a guess.
    """
    rng, data = np.random.default_rng([10, seed]), problem.data(seed)
    mean, covariance = gaussian(problem, problem.forward, data, problem.noise)
    sd = np.sqrt(np.diag(covariance))
    low, high = mean - 12.0 * sd, mean + 12.0 * sd
    ended = rng.permutation(len(sd))[: 1 + seed % 3]
    upper = rng.random(len(sd)) < 0.5
    for k in ended:
        (high if upper[k] else low)[k] = mean[k] + (size if upper[k] else -size) * sd[k]
    chosen = in_box(mean, covariance, low, high, rng)
    parameters = tuple(
        replace(p, low=float(a), high=float(b), scale="uniform")
        for p, a, b in zip(problem.scene.parameters, low, high, strict=True)
    )
    exact = replace(problem.forward, scene=replace(problem.scene, parameters=parameters))
    observe = cal.nodal_displacements(exact.scene, problem.nodes)
    model = cal.model(exact, observe, cal.GaussianNoise(sd=problem.noise))
    return posterior_of(model, data, chosen), (mean, sd)


def in_box(mean, covariance, low, high, rng, sweeps=200):
    """Draws (s, p) of a Gaussian in a box: as many Gibbs samplers, side by side."""
    precision = np.linalg.inv(covariance)
    x = np.clip(np.tile(mean, (DRAWS, 1)), low, high)
    sd = np.diag(precision) ** -0.5
    for _ in range(sweeps):
        for k in range(len(mean)):
            others = (x - mean) @ precision[k] - (x[:, k] - mean[k]) * precision[k, k]
            at = mean[k] - others / precision[k, k]
            ends = (low[k] - at) / sd[k], (high[k] - at) / sd[k]
            x[:, k] = truncnorm.rvs(*ends, loc=at, scale=sd[k], random_state=rng)
    return x


def box_touches(problem, size, seed):
    """The same, called by another name: a box that ends in the tail changes little."""
    return box_cuts(problem, size, seed)


def few(problem, size, seed):
    """``size`` draws in four chains; above 100 they are correlated by 0.98 from one to the next."""
    posterior, truth = with_map(problem, _nothing(problem), seed)
    draws = np.stack(list(posterior.draws().values()), axis=1)[: int(size)]
    if size > 100:
        draws = draws[np.minimum(np.arange(len(draws)) // 50 * 50, len(draws) - 1)]
        rng = np.random.default_rng(seed)
        draws = draws * (1.0 + 1e-6 * rng.normal(size=draws.shape))
    return posterior_of(posterior.model, posterior.data["displacement"], draws), truth


def _nothing(problem):
    zero = jnp.zeros((len(problem.scene.mesh.nodes), 3))
    return lambda _: zero


def cases(quick: bool = False) -> list[Case]:
    """Every kind on every problem it makes sense on."""
    found = []

    def add(problems, make, sizes, seeds, *, good_below=-np.inf, budget=None):
        for problem in problems:
            for size in sizes:
                for seed in seeds[:1] if quick else seeds:
                    found.append(
                        Case(problem, make.__name__, size, seed, make, size <= good_below, budget)
                    )

    two = ("beam", "five")
    good = 0.02
    if quick:
        add(("five",), constant, (0.0, 1.0), (0,), good_below=good)
        add(("modes",), stuck, (1,), (0,))
        return found
    add(two, constant, (0.0,), (0, 1, 2), good_below=good)
    add(two, constant, (0.02, 0.1, 0.3, 1.0), (0, 1), good_below=good)
    add(two, growing, (0.02, 0.05, 0.1, 0.3), (0,), good_below=good)
    add(("beam",), rough, (0.02, 0.1, 0.3, 1.0), (0, 1), good_below=good)
    add(("five",), bump, (1.0, 20.0), (0, 1), good_below=100.0)
    add(two, spoiled, (1e-4, 1e-2, 1e-1), (0,), good_below=1e-4)
    add(two, wrong_noise, (0.4, 0.6, 0.85, 1.2, 1.7, 2.5), (0,))
    add(two, few, (40, 2000), (0,))
    add(("beam", "modes"), hides, (1.0, 5.0), (0, 1, 2, 3))
    add(("modes",), stuck, (1, 2), (0, 1))
    add(("modes",), constant, (0.0, 0.02), (0, 1), good_below=good)
    add(("hidden",), hidden_mode, (1.0, 5.0), tuple(range(8)))
    add(two, two_points, (1,), (0, 1, 2))
    add(("five",), box_cuts, (0.2, 0.0, -0.5, -1.0, -1.5), tuple(range(6)))
    add(("five",), box_touches, (1.5, 1.75, 2.0, 2.5, 3.0), tuple(range(6)), good_below=3.0)
    for budget in (50, 80):
        add(("beam", "modes"), hides, (1.0, 5.0), (0, 1), budget=budget)
        add(("hidden",), hidden_mode, (5.0,), tuple(range(8)), budget=budget)
        add(("modes",), stuck, (1,), (0, 1), budget=budget)
    return found
