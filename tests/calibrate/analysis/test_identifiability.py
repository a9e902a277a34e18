"""Identifiability against closed forms of a linear-Gaussian model."""

from dataclasses import replace

import arviz_base
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
import pytest

import calibrate as cal
import emulator as em
from calibrate.analysis import expected
from calibrate.analysis.expected import expected_precision, next_measurement
from calibrate.analysis.identifiability import (
    identify,
    prior_table,
    profile_likelihood,
    stress_band,
    stresses,
)
from calibrate.posterior import Posterior
from emulator.core.errors import InputError
from linear_support import about_zero, closed_form, linear_forward

NODES = np.array([3, 11, 20])
NOISE = 0.1


@pytest.fixture(scope="module")
def forward(beam):
    return linear_forward(beam)


def model_of(beam, forward, mean, sd, noise=NOISE):
    prior = {n: dist.Normal(m, s) for n, m, s in zip(("mu", "lam"), mean, sd, strict=True)}
    observe = cal.nodal_displacements(beam, NODES)
    return cal.model(forward, observe, cal.GaussianNoise(sd=noise), prior, check_scale=False)


def exact_posterior(model, forward, data, mean, sd, count=4000):
    """Independent draws of the closed-form posterior, as a :class:`Posterior`."""
    middle, covariance = closed_form(forward, NODES, data, NOISE, mean, sd)
    x = np.random.default_rng(5).multivariate_normal(middle, covariance, (1, count))
    tree = arviz_base.from_dict({"posterior": {"mu": x[..., 0], "lam": x[..., 1]}})
    return Posterior(tree, model, {"displacement": jnp.asarray(data)}), middle, covariance


@pytest.fixture(scope="module")
def case(beam, forward):
    """Unknowns around zero, where nothing is taken in logarithms."""
    mean, sd = np.array([0.0, 1.0]), np.array([20.0, 30.0])
    beam = about_zero(beam, "mu", "lam")
    forward = replace(forward, scene=beam)
    model = model_of(beam, forward, mean, sd)
    data = np.asarray(forward.at(NODES)(jnp.array([3.0, -4.0])))
    return model, *exact_posterior(model, forward, data, mean, sd), mean, sd


def test_expected_precision_is_the_closed_form(case, forward):
    model, _, _, covariance, _, sd = case
    found = expected_precision(model)
    assert found["combinations"] == []
    wanted = np.sqrt(np.diagonal(covariance)) / sd
    # The prior's own covariance is that of its draws.
    np.testing.assert_allclose(list(found["sd"].values()), wanted, rtol=0.05)


@pytest.mark.slow
def test_posteriors_are_averaged_in_the_box_of_the_prior(beam, forward):
    """Data that sees mu + lam alone, by sums over a grid: a box ends where a Gaussian does not."""
    alike = forward.matrix.copy()
    alike[..., 1] = alike[..., 0]
    size = np.linalg.norm(alike[NODES][..., 0])
    ends, noise = (50.0, 100.0), 2.0
    prior = {name: dist.Uniform(*ends) for name in ("mu", "lam")}
    observe = cal.nodal_displacements(beam, NODES)
    model = cal.model(
        replace(forward, matrix=alike), observe, cal.GaussianNoise(noise * size), prior,
        check_scale=False,
    )  # fmt: skip
    found = expected_precision(model, data_sets=200)
    rng, grid = np.random.default_rng(2), np.linspace(*ends, 301)
    mu, lam = np.meshgrid(grid, grid)
    sds = []
    for truth in rng.uniform(*ends, (400, 2)).sum(axis=1):
        weight = np.exp(-0.5 * ((mu + lam - truth - noise * rng.normal()) / noise) ** 2)
        weight /= weight.sum()
        sds.append(np.sqrt(np.sum(weight * np.log(mu) ** 2) - np.sum(weight * np.log(mu)) ** 2))
    wanted = np.mean(sds) / np.log(grid).std()
    for ratio in found["sd"].values():
        assert ratio == pytest.approx(wanted, rel=0.06)
    # A number has one combination, here nearly the product.
    (only,) = found["combinations"]
    assert set(only["exponents"]) == {"mu", "lam"}


def test_too_few_draws_promise_no_more_than_the_linear_map(case, monkeypatch):
    """Two draws that carry all weight have next to no spread."""
    model, _, _, covariance, _, sd = case
    monkeypatch.setattr(expected, "_AROUND", 4)
    found = expected_precision(model, data_sets=8)
    wanted = np.sqrt(np.diagonal(covariance)) / sd
    np.testing.assert_allclose(list(found["sd"].values()), wanted, rtol=0.05)


def test_in_logarithms_it_names_the_combination_the_data_fixes(beam, forward):
    """Data that sees mu - lam only, near mu = lam: their ratio, mu^1 lam^-1."""
    alike = forward.matrix.copy()
    alike[..., 1] = -alike[..., 0]
    blind = replace(forward, matrix=alike)
    model = model_of(beam, blind, (75.0, 75.0), (5.0, 5.0), noise=1e-3)
    found = expected_precision(model, at={"mu": 75.0, "lam": 75.0})
    exponents = found["combinations"][0]["exponents"]
    assert exponents["mu"] == -exponents["lam"]
    assert abs(exponents["mu"]) == 1.0
    relative = 1e-3 / 75.0 / np.linalg.norm(alike[NODES][..., 0])
    assert found["combinations"][0]["known_to"] == pytest.approx(relative, rel=1e-3)


def posterior_of_draws(model, draws):
    tree = arviz_base.from_dict({"posterior": {n: x[None] for n, x in draws.items()}})
    return Posterior(tree, model, {})


def test_logarithms_follow_the_declared_scale_not_the_sign_of_draws(beam, forward):
    """One scale is uniform and reaches below 0; the prior of the other has a tail below 0."""
    scene = about_zero(beam, "lam")
    model = model_of(scene, replace(forward, scene=scene), (75.0, 0.0), (32.0, 20.0))
    rng = np.random.default_rng(1)
    draws = {"mu": np.exp(rng.normal(4.0, 0.01, 2000)), "lam": rng.normal(0.0, 2.0, 2000)}
    found = identify(posterior_of_draws(model, draws))
    table = prior_table(model)
    assert 3900 < len(table) < 4096  # 1 % of the prior of mu has no logarithm
    spreads = [np.log(table[:, 0]).std(ddof=1), table[:, 1].std(ddof=1)]
    assert found["contraction"]["mu"] == pytest.approx(1.0 - 0.01 / spreads[0], abs=1e-3)
    assert found["contraction"]["lam"] == pytest.approx(1.0 - 2.0 / spreads[1], abs=5e-3)
    (only,) = found["combinations"]
    assert only["exponents"] == {"mu": 1.0}
    assert only["known_to"] == pytest.approx(0.01, rel=0.05)
    # What is said before there is data is on the same scales.
    before = expected_precision(model, at={"mu": 75.0, "lam": 1.0})
    A = forward.matrix[NODES].reshape(-1, 2) * [75.0, 1.0]
    prior = np.cov(np.stack([np.log(table[:, 0]), table[:, 1]]))
    wanted = np.linalg.inv(A.T @ A / NOISE**2 + np.linalg.inv(prior))
    ratio = np.sqrt(np.diagonal(wanted) / np.diagonal(prior))
    np.testing.assert_allclose(list(before["sd"].values()), ratio, rtol=1e-6)


def test_a_uniform_scale_above_0_enters_relative_to_its_mean(beam, forward):
    """The product mu lam is known: exponents 1 and 1, whichever scale lam is declared on."""
    mu, lam = beam.parameters
    scene = replace(beam, parameters=(mu, replace(lam, scale="uniform")))
    rng = np.random.default_rng(1)
    mu = 75.0 * np.exp(rng.normal(0.0, 0.03, 4000))
    draws = {"mu": mu, "lam": 75.0**2 / mu * np.exp(rng.normal(0.0, 0.001, 4000))}
    for each in (beam, scene):
        model = model_of(each, replace(forward, scene=each), (75.0, 75.0), (5.0, 5.0))
        best = identify(posterior_of_draws(model, draws))["combinations"][0]
        assert best["exponents"] == {"mu": 1.0, "lam": 1.0}
        assert best["known_to"] == pytest.approx(0.001, rel=0.5)


def test_an_unknown_noise_is_refused(beam, forward):
    observe = cal.nodal_displacements(beam, NODES)
    model = cal.model(forward, observe, cal.GaussianNoise(sd_scale=0.1))
    with pytest.raises(InputError, match="displacement must be of known sd; noise_sd is"):
        expected_precision(model)


@pytest.mark.slow
def test_gains_of_the_next_measurement_are_the_closed_form(case, beam, forward):
    _, posterior, _, covariance, *_ = case
    candidates = {
        "again": (cal.nodal_displacements(beam, NODES), cal.GaussianNoise(sd=NOISE)),
        "coarse": (cal.nodal_displacements(beam, NODES), cal.GaussianNoise(sd=100.0)),
        "elsewhere": (cal.nodal_displacements(beam, [40]), cal.GaussianNoise(sd=NOISE)),
    }
    found = next_measurement(posterior, candidates)
    assert list(found)[-1] == "coarse"
    assert found["coarse"].bits == pytest.approx(0.0, abs=1e-3)
    for name, nodes in (("again", NODES), ("elsewhere", [40])):
        A = forward.matrix[nodes].reshape(-1, 2)
        after = np.linalg.inv(np.linalg.inv(covariance) + A.T @ A / NOISE**2)
        bits = 0.5 * np.log2(np.linalg.det(covariance) / np.linalg.det(after))
        assert found[name].bits == pytest.approx(bits, abs=0.05)
        ratio = np.sqrt(np.diagonal(after) / np.diagonal(covariance))
        np.testing.assert_allclose(list(found[name].sd.values()), ratio, rtol=0.05)
    with pytest.raises(InputError, match="load state 'top' is unknown"):
        next_measurement(posterior, {"volume@top": candidates["again"]})


@pytest.mark.parametrize(("name", "k"), [("mu", 0), ("lam", 1)])
def test_profiles_of_a_linear_model_are_parabolas(case, forward, name, k):
    """The interval is that of least squares, whatever the prior."""
    _, posterior, *_ = case
    A = forward.matrix[NODES].reshape(-1, 2)
    y = (np.asarray(posterior.data["displacement"]) - forward.shift[NODES]).ravel()
    spread = np.sqrt(np.linalg.inv(A.T @ A / NOISE**2)[k, k])
    best = np.linalg.lstsq(A, y, rcond=None)[0][k]
    found = profile_likelihood(posterior, name)
    wanted = 0.5 * ((found.values - best) / spread) ** 2
    np.testing.assert_allclose(found.drop, wanted - wanted.min(), atol=1e-3)
    assert found.low == pytest.approx(best - 1.96 * spread, rel=0.02, abs=0.1)
    assert found.high == pytest.approx(best + 1.96 * spread, rel=0.02, abs=0.1)
    with pytest.raises(InputError, match="'nu' is not inferred; inferred: mu, lam"):
        profile_likelihood(posterior, "nu")


def test_a_flat_profile_has_no_ends(beam, forward):
    """Data that sees mu only says nothing about lam, whatever its prior."""
    blind = forward.matrix.copy()
    blind[..., 1] = 0.0
    only = replace(forward, matrix=blind)
    mean, sd = np.array([0.0, 0.0]), np.array([20.0, 30.0])
    data = np.asarray(only.at(NODES)(jnp.array([3.0, -4.0])))
    model = model_of(beam, only, mean, sd)
    posterior, *_ = exact_posterior(model, only, data, mean, sd)
    found = profile_likelihood(posterior, "lam", points=7)
    assert found.drop.max() < 1e-6
    assert (found.low, found.high) == (-np.inf, np.inf)


def test_stress_of_a_neo_hookean_body(case):
    """Along an isochoric stretch: mu (lambda^2 - 1 / lambda), whatever lambda's Lame constant."""
    model, *_ = case
    scene, stretch = model.forward.scene, np.array([0.8, 1.0, 1.3])
    found = stresses(scene, jnp.array([70.0, 55.0]), jnp.array([0.0, 1.0, 0.0]), stretch)
    np.testing.assert_allclose(found, 70.0 * (stretch**2 - 1.0 / stretch), atol=1e-12)


def test_the_band_is_that_of_its_draws(beam, forward):
    mean, sd = np.array([75.0, 75.0]), np.array([2.0, 3.0])
    model = model_of(beam, forward, mean, sd)
    data = np.asarray(forward.at(NODES)(jnp.array([75.0, 75.0])))
    posterior, *_ = exact_posterior(model, forward, data, mean, sd)
    band = stress_band(posterior, "cross-fibre", stretches=[1.0, 1.2])
    draws = posterior.draws()["mu"][np.linspace(0, 3999, 500).astype(int)]
    np.testing.assert_allclose(band.low[1], np.quantile(draws, 0.05) * (1.44 - 1.0 / 1.2))
    assert band.low[0] == band.high[0] == 0.0
    with pytest.raises(InputError, match="direction 'sheet' is unknown; known: fibre, cross-fibre"):
        stress_band(posterior, "sheet")
    with pytest.raises(InputError, match="stretches must be above 0"):
        stress_band(posterior, stretches=[0.0])


def test_fibres_are_stiffer_than_what_lies_across_them():
    scene = em.scenes.left_ventricle(rings=4, around=8, layers=1, order=1)
    along, across = (
        stresses(scene, scene.centre, jnp.eye(3)[k], np.array([1.0, 1.15])) for k in (0, 1)
    )
    assert float(along[0]) == pytest.approx(0.0, abs=1e-9)
    assert along[1] > 2.0 * across[1] > 0.0
