"""Modes: where climbs end and what they weigh; those that draws have missed are reported.

Funnels, ridges and light modes are not.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpyro.distributions import Normal

from calibrate.posterior.diagnosis import diagnose
from calibrate.samplers import Density
from calibrate.samplers.modes import (
    MISSED_AT,
    MISSED_BY,
    MOST,
    climb_from,
    curvature,
    explore,
    heavy,
    merged,
    missed_mode,
    modes_at,
    of_account,
    shares,
    unseen,
)
from calibrate.statistical_model.density import prior_draws

KEY = jax.random.key(0)
RNG = np.random.default_rng(0)


def density(log_density, size, spread=3.0):
    """A density given in unconstrained coordinates; its prior only gives the starts."""
    return Density(
        lambda z, data: log_density(z), size, size > 1, 1,
        lambda z: jnp.zeros(()),
        lambda z, data: log_density(z),
        lambda key: spread * jax.random.normal(key, (size,)),
        lambda z: {f"z{i}": z[:, i] for i in range(size)},
        lambda draw: jnp.stack(list(draw.values())),
        tuple(f"z{i}" for i in range(size)),
    )  # fmt: skip


def missed(log_density, draws):
    of = density(log_density, draws.shape[1])
    return missed_mode(
        of, {}, draws, modes_at(of, {}, climb_from(of, {}, prior_draws(of, KEY, 8), draws))
    )


def test_a_climb_tells_the_width_and_the_mass_of_its_mode():
    """Correlated, against the closed form; a slope has no mode."""
    covariance = np.array([[0.04, 0.03], [0.03, 0.09]])
    precision = jnp.asarray(np.linalg.inv(covariance))
    of = density(lambda z: 3.0 - 0.5 * (z - 1.0) @ precision @ (z - 1.0), 2)
    starts = RNG.normal(size=(MOST, 2))
    (mode,) = explore(of, {}, starts)
    assert mode.climbs == 12  # one mode: the first batch is enough
    np.testing.assert_allclose(mode.z, 1.0, atol=1e-5)
    np.testing.assert_allclose(mode.root @ mode.root.T, covariance, rtol=1e-6)
    mass = 3.0 + np.log(2.0 * np.pi) + 0.5 * np.linalg.slogdet(covariance)[1]
    assert mode.log_mass == pytest.approx(mass, abs=1e-8)
    np.testing.assert_allclose(mode.distances(mode.z + mode.root.T[:1]), 1.0)
    assert explore(density(jnp.sum, 2), {}, starts[:2]) == []


def test_a_direction_that_is_flat_but_for_round_off_has_no_mode():
    """Precisions 1e16 apart, as of data without noise, along turned axes, at some places."""
    stiff = jnp.asarray([1e6, 1.7e6, -0.6e6])
    of = density(lambda z: -0.5 * (stiff @ z) ** 2 - 1e-5 * z @ z, 3)
    with np.errstate(all="raise"):
        for place in 1e-3 * RNG.normal(size=(20, 3)):
            smallest, distance = curvature(of, {}, place)[1:]
            assert smallest <= 0.0
            assert np.isnan(distance)


def test_all_climb_where_there_are_several_modes():
    of = density(two(0.2)[0], 2)
    modes = explore(of, {}, 4.0 * RNG.normal(size=(MOST, 2)))
    assert sum(mode.climbs for mode in modes) == MOST
    np.testing.assert_allclose(shares(modes), [0.8, 0.2], rtol=1e-3)
    light = explore(density(two(1e-4)[0], 2), {}, 4.0 * RNG.normal(size=(MOST, 2)))
    assert (len(light), len(of_account(light)), len(heavy(light))) == (2, 1, 1)
    both = merged([*modes, *modes[::-1]])
    assert [mode.climbs for mode in both] == [2 * mode.climbs for mode in modes]
    assert shares([]).shape == (0,)


@pytest.mark.parametrize(
    ("counts", "expected"), [([4, 4], 0.0), ([1, 4], 0.0), ([1, 1, 2], 2.0), ([1, 1, 1], 3.0)]
)
def test_modes_seen_once_tell_of_unseen_ones(counts, expected):
    assert unseen(counts) == expected


def two(weight, apart=4.0, width=0.5):
    """Gaussians at -apart and apart along the first of two coordinates; the second's share."""

    def log_density(z):
        centres = jnp.array([[-apart, 0.0], [apart, 0.0]])
        heights = Normal(centres, width).log_prob(z).sum(axis=1)
        return jax.nn.logsumexp(heights + jnp.log(jnp.array([1.0 - weight, weight])))

    first, second = (
        np.array([s * apart, 0.0]) + width * RNG.normal(size=(500, 2)) for s in (-1, 1)
    )
    return log_density, first, second


@pytest.mark.parametrize("weight", [0.5, 0.2, 0.9])
def test_a_mode_without_draws_is_reported_with_its_mass(weight):
    log_density, first, _ = two(weight)
    found = missed(log_density, first)
    # The mean log density is that of 64 draws, sd 1 / 8.
    assert found[MISSED_BY] == pytest.approx(np.log((1.0 - weight) / weight), abs=0.5)
    place = dict(part.split(" ") for part in found[MISSED_AT].split(", "))
    assert float(place["z0"]) == pytest.approx(4.0, abs=0.01)


def test_nothing_is_reported_where_both_have_draws_or_the_other_is_light():
    log_density, first, second = two(0.5)
    assert missed(log_density, np.concatenate([first, second])) == {MISSED_BY: np.inf}
    log_density, first, _ = two(0.01)
    assert missed(log_density, first) == {MISSED_BY: np.inf}


def test_a_valley_of_density_zero_is_one():
    """As where the forward map has no answer."""
    log_density, first, _ = two(0.5)
    ended = lambda z: jnp.where(jnp.abs(z[0]) < 1.0, -jnp.inf, log_density(z))
    assert missed(ended, first)[MISSED_BY] == pytest.approx(0.0, abs=0.5)


def funnel():
    depth = 3.0 * RNG.normal(size=2000)
    draws = np.stack([depth, np.exp(0.5 * depth) * RNG.normal(size=2000)], axis=1)
    return (
        lambda z: Normal(0.0, 3.0).log_prob(z[0]) + Normal(0.0, jnp.exp(0.5 * z[0])).log_prob(z[1]),
        draws,
    )


def bent_ridge():
    x = RNG.normal(size=2000)
    draws = np.stack([x, x**2 + 0.1 * RNG.normal(size=2000)], axis=1)
    return lambda z: Normal(0.0, 1.0).log_prob(z[0]) + Normal(z[0] ** 2, 0.1).log_prob(z[1]), draws


def gaussian(size):
    sd = np.geomspace(1e-3, 1.0, size)
    return lambda z: Normal(0.0, sd).log_prob(z).sum(), RNG.normal(size=(1000, size)) * sd


def ended():
    """A Gaussian that ends at one sd: no mode inside, and a wall."""
    draws = RNG.normal(size=(4000, 2))
    return lambda z: jnp.where(z[0] > 1.0, Normal(0.0, 1.0).log_prob(z).sum(), -jnp.inf), draws[
        draws[:, 0] > 1.0
    ]


@pytest.mark.parametrize(
    "case", [funnel(), bent_ridge(), gaussian(1), gaussian(8), gaussian(20), ended()]
)
def test_one_mode_of_any_shape_is_not_two(case):
    assert missed(*case) == {MISSED_BY: np.inf}


def test_where_the_density_is_zero_everywhere_nothing_is_found():
    assert missed(lambda z: jnp.full((), -jnp.inf), RNG.normal(size=(50, 2))) == {MISSED_BY: np.inf}


def test_draws_that_do_not_vary_are_left_to_other_checks():
    log_density, _, _ = two(0.5)
    assert missed(log_density, np.zeros((50, 2))) == {MISSED_BY: np.inf}


@pytest.mark.parametrize(
    ("nats", "mass"), [(0.7, "0.5 times"), (-0.7, "2 times"), (-900.0, "many")]
)
def test_the_sentence_names_place_and_mass(nats, mass):
    attributes = {MISSED_BY: nats, MISSED_AT: "mu 71.3"}
    summary = {"mu": {"r_hat": 1.0, "ess_bulk": 1e4, "ess_tail": 1e4}}
    (sentence,) = diagnose({}, {}, summary, attributes)
    assert "mu 71.3" in sentence
    assert f"has {mass}" in sentence
