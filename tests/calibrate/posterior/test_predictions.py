"""Data replicated at draws of the posterior and of the prior, and predictions elsewhere."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import calibrate as cal
import emulator as em
from calibrate.analysis.sbc import sbc
from calibrate.posterior import predictions
from calibrate.posterior.predictions import prior_replicates
from certificate_support import exact_data, linear_model, posterior_of
from linear_support import linear_forward


@pytest.fixture(scope="module")
def posterior(beam):
    rng = np.random.default_rng(0)
    model = linear_model(beam)
    return posterior_of(model, exact_data(model), rng.uniform(60.0, 80.0, (40, 2)))


def test_another_load_and_another_observation_are_predicted_at_every_draw(beam, posterior):
    tip = cal.nodal_displacements(beam, [7, 40])
    name = beam.parameter_names[0]
    found = posterior.predict({name: 71.0}, tip)
    assert found.shape == (40, 2, 3)
    for theta, told in zip(posterior.thetas(), found, strict=True):
        u = posterior.model.full(theta.at[0].set(71.0))
        np.testing.assert_allclose(told, u[np.array([7, 40])], rtol=1e-12)
    unchanged = posterior.predict({}, tip)
    assert np.abs(unchanged - found).max() > 0.0


def test_a_loop_over_loads_compiles_once(beam, posterior):
    observe, traced = cal.nodal_displacements(beam, [40]), []

    class Counting(type(observe)):
        def __call__(self, u, theta):
            traced.append(u)
            return super().__call__(u, theta)

    counting = Counting(observe.nodes, observe.points)
    for mu in (60.0, 70.0, 80.0):
        posterior.predict({"mu": mu}, counting)
    assert len(traced) == 1


def test_a_prediction_of_what_was_observed_is_the_model_s_mean(posterior):
    (observe,) = posterior.model.observe.parts.values()
    found = posterior.predict({}, observe)
    for theta, told in zip(posterior.thetas(), found, strict=True):
        np.testing.assert_allclose(told, posterior.model.forward(theta), rtol=1e-12)


def test_a_fem_posterior_predicts_by_solves(beam, simulator):
    tip = cal.nodal_displacements(beam, [40])
    model = cal.model(em.fem_forward(simulator), tip, cal.GaussianNoise(sd=0.2))
    thetas = np.array([[70.0, 60.0], [65.0, 80.0]])
    data = np.zeros((1, 3))
    found = posterior_of(model, data, thetas, chains=1).predict({"mu": 75.0}, tip)
    for row, told in zip(thetas, found, strict=True):
        theta = beam.theta(**dict(zip(beam.parameter_names, row, strict=True)) | {"mu": 75.0})
        np.testing.assert_allclose(told, simulator(theta)[np.array([40])], atol=1e-8)


@pytest.mark.parametrize(
    ("known", "wrong"),
    [
        ({"presure": 1.0}, "'presure' is no parameter; there are mu, lam"),
        ({"mu": float("nan")}, "mu is nan; give a finite number"),
        ({"mu": float("inf")}, "mu is inf; give a finite number"),
    ],
)
def test_what_is_known_is_checked(beam, posterior, known, wrong):
    with pytest.raises(em.InputError, match=wrong):
        posterior.predict(known, cal.nodal_displacements(beam, [7]))


def test_an_observation_of_another_mesh_is_refused(posterior, ventricle):
    other = cal.nodal_displacements(ventricle, [len(ventricle.mesh.nodes) - 1])
    with pytest.raises(em.InputError, match="not of scene"):
        posterior.predict({}, other)


def test_draws_at_which_the_map_has_no_answer_are_named(beam):
    emulator = em.load("once_clamped_beam")
    tip = cal.nodal_displacements(emulator.scene, [40])
    model = cal.model(emulator.cache(), tip, cal.GaussianNoise(sd=0.2))
    data = np.asarray(model.forward(emulator.scene.centre))
    inside = posterior_of(model, data, np.tile(emulator.scene.centre, (8, 1)), 2)
    assert np.isfinite(inside.predict({}, tip)).all()
    with pytest.raises(em.InputError, match="has no answer at 8 of 8 theta"):
        inside.predict({"mu": 1e4}, tip)


def test_an_observation_without_nodes_is_predicted(beam, posterior):
    found = posterior.predict({"mu": 75.0}, cal.MeasuredParameter(beam, "mu"))
    np.testing.assert_array_equal(found.ravel(), 75.0)


def test_prior_predictions_that_are_fewer_than_asked_for_are_told(beam):
    """A map without an answer in a large part of its box."""
    forward = replace(linear_forward(beam), limit=68.0)
    tip = cal.nodal_displacements(beam, [40])
    model = cal.model(forward, tip, cal.GaussianNoise(sd=0.2), check_scale=False)
    data = np.asarray(model.forward(jnp.array([60.0, 60.0])))
    options = cal.samplers.NUTSOptions(warmup=20, draws=20, chains=1)
    found = cal.sample(model, data, options=options)
    count = found.tree["prior"].sizes["draw"]
    assert 50 < count < 400
    sentence = f"the prior predicts {count} data sets in place of 500"
    assert any(told.startswith(sentence) for told in found.warnings())
    with pytest.raises(em.InputError, match=r"calibration: the prior predicts \d+ data sets in "):
        sbc(model, 20)
    everywhere = prior_replicates(linear_model(beam), jax.random.key(0))
    assert predictions.shortfall(len(everywhere.draws["mu"])) == []
