"""Sensitivity of functions whose indices are known in closed form."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
import pytest
from scipy.stats import truncnorm

from calibrate.analysis.sensitivity import Factors, analyse, densities, quantiles
from calibrate.priors import truncated_normal
from emulator.core.errors import InputError

THREE = Factors(("x1", "x2", "x3"))


def ishigami(points: np.ndarray) -> np.ndarray:
    z = np.pi * (2.0 * points - 1.0)
    return np.sin(z[:, 0]) + 7.0 * np.sin(z[:, 1]) ** 2 + 0.1 * z[:, 2] ** 4 * np.sin(z[:, 0])


def ishigami_slopes(points: np.ndarray) -> np.ndarray:
    def one(x: jax.Array) -> jax.Array:
        z = jnp.pi * (2.0 * x - 1.0)
        return jnp.sin(z[0]) + 7.0 * jnp.sin(z[1]) ** 2 + 0.1 * z[2] ** 4 * jnp.sin(z[0])

    return np.asarray(jax.vmap(jax.grad(one))(points))[:, None]


def test_ishigami() -> None:
    """Closed form: Ishigami and Homma (1990) with a = 7, b = 0.1."""
    found = analyse(THREE, ishigami, samples=1024)
    first, total = (found[name][:, 0].values for name in ("first", "total"))
    near = [found[f"{name}_half_width"][:, 0].values for name in ("first", "total")]
    assert (np.abs(first - [0.3139, 0.4424, 0.0]) < near[0]).all()
    assert (np.abs(total - [0.5576, 0.4424, 0.2437]) < near[1]).all()
    assert found.attrs["evaluations"] == 1024 * 5
    assert found["variance"].values == pytest.approx([13.845], rel=0.02)


def test_sobol_s_g() -> None:
    """Sobol' (1993): first-order variances 1 / (3 (1 + a)^2)."""
    a = np.array([0.0, 1.0, 4.5, 9.0])

    def g(points: np.ndarray) -> np.ndarray:
        return np.prod((np.abs(4.0 * points - 2.0) + a) / (1.0 + a), axis=1)

    own = 1.0 / (3.0 * (1.0 + a) ** 2)
    variance = np.prod(1.0 + own) - 1.0
    total = own * np.array([np.prod(1.0 + np.delete(own, k)) for k in range(4)]) / variance
    found = analyse(Factors(("a", "b", "c", "d")), g, samples=1024)
    for name, expected in (("first", own / variance), ("total", total)):
        off = np.abs(found[name][:, 0] - expected)
        assert (off < found[f"{name}_half_width"][:, 0] + 1e-3).all()


def test_derivatives_bound_the_total_index() -> None:
    total = analyse(THREE, ishigami, samples=512)["total"][:, 0]
    found = analyse(THREE, ishigami, method="derivatives", samples=512, derivative=ishigami_slopes)
    assert (found["bound_on_total"][:, 0].values > total.values).all()
    # E (dg/dx1)^2 = (2 pi)^2 / 2 E (1 + 0.1 z^4)^2.
    z = np.pi
    mean = 1.0 + 0.2 * z**4 / 5.0 + 0.01 * z**8 / 9.0
    assert float(found["nu"][0, 0]) == pytest.approx(2.0 * np.pi**2 * mean, rel=0.02)


def test_the_active_subspace_of_a_ridge() -> None:
    along = np.array([0.6, 0.0, -0.8])

    def ridge(points: np.ndarray) -> np.ndarray:
        return np.exp(points @ along)

    def slopes(points: np.ndarray) -> np.ndarray:
        return (ridge(points)[:, None] * along)[:, None]

    found = analyse(THREE, ridge, method="derivatives", samples=64, derivative=slopes)
    assert np.allclose(np.abs(found["active_direction"][:, 0]), np.abs(along))
    assert found["active_value"][1] < 1e-12 * found["active_value"][0]


def test_several_outputs_together_and_those_that_do_not_vary() -> None:
    """y1 = x1, y2 = 3 x2, y3 constant: of the variances' sum x1 has a tenth."""

    def outputs(points: np.ndarray) -> np.ndarray:
        return np.column_stack([points[:, 0], 3.0 * points[:, 1], np.full(len(points), 2.0)])

    found = analyse(THREE, outputs, samples=256)
    assert np.allclose(found["total_together"], [0.1, 0.9, 0.0], atol=0.02)
    assert np.isnan(found["first"][:, 2]).all()
    assert np.allclose(found["total"][:, :2], [[1.0, 0.0], [0.0, 1.0], [0.0, 0.0]], atol=0.05)


def test_groups_vary_together() -> None:
    factors = Factors(THREE.names, {"pair": ("x1", "x3")})
    assert factors.labels == ("pair", "x2")
    found = analyse(factors, ishigami, samples=1024)
    assert list(found["factor"].values) == ["pair", "x2"]
    # x1 and x3 together: everything but x2, with which neither interacts.
    assert np.allclose(found["first"][:, 0], [0.5576, 0.4424], atol=0.05)
    assert np.allclose(found["total"][:, 0], [0.5576, 0.4424], atol=0.05)


def test_morris_of_a_plane() -> None:
    """Elementary effects of a plane are its slopes, without spread."""
    found = analyse(THREE, lambda x: x @ np.array([1.0, -2.0, 0.0]), method="morris", samples=8)
    assert np.allclose(found["mu_star"][:, 0], [1.0, 2.0, 0.0])
    assert np.allclose(found["sigma"][:, 0], 0.0, atol=1e-12)


def test_seeds() -> None:
    runs = [analyse(THREE, ishigami, samples=64, seed=seed) for seed in (0, 0, 1)]
    assert runs[0].identical(runs[1])
    assert not runs[0].identical(runs[2])


def test_priors_that_are_not_uniform() -> None:
    """A sum of normals: each one's share is its variance's; slopes follow from the density."""
    prior = {"x1": dist.Normal(1.0, 2.0), "x2": truncated_normal(0.0, 1.0, -1.0, 3.0)}
    names = tuple(prior)
    factors = Factors(names)
    at = jax.jit(lambda points: quantiles(prior, names, points))

    def function(points: np.ndarray) -> np.ndarray:
        return np.asarray(at(points).sum(axis=-1))

    found = analyse(factors, function, samples=1024)
    variances = [4.0, truncnorm(-1.0, 3.0).var()]
    share = np.array(variances) / sum(variances)
    assert np.allclose(found["total"][:, 0], share, atol=0.03)
    points = jnp.array([[0.2, 0.7], [0.6, 0.1]])
    step = jnp.array([1e-5, 0.0])
    slope = (at(points + step) - at(points - step)) / 2e-5
    density = jax.jit(lambda theta: densities(prior, names, theta))(at(points))
    assert np.allclose(slope[:, 0] * density[:, 0], 1.0, rtol=1e-6)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"method": "magic"}, "method 'magic' is unknown; known: sobol, morris"),
        ({"samples": 100}, "a power of two"),
        ({"samples": 1}, "give 2 or more"),
        ({"method": "derivatives"}, "needs the derivative"),
    ],
)
def test_what_cannot_be_done(change: dict, words: str) -> None:
    with pytest.raises(InputError, match=words):
        analyse(THREE, ishigami, **change)


def test_outputs_that_are_not_finite() -> None:
    with pytest.raises(InputError, match="not finite at 320 of 320 points"):
        analyse(THREE, lambda x: np.full(len(x), np.nan), samples=64)


@pytest.mark.parametrize(
    ("groups", "words"),
    [
        ({"g": ("x9",)}, "'x9' is none of x1, x2, x3"),
        ({"g": ("x1",), "h": ("x1",)}, "'x1' is in two groups"),
        ({"x2": ("x1",)}, "'x2' is a parameter's name"),
    ],
)
def test_groups_that_are_none(groups: dict, words: str) -> None:
    with pytest.raises(InputError, match=words):
        Factors(THREE.names, groups)
