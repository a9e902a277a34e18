"""Algorithm 1 as the paper trains it: on the energy alone."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import emulator as em
from emulator.core.errors import InputError, SolverError
from emulator.fem.campaign.designs import uniform
from emulator.geometry.refinement import to_quadratic
from emulator.surrogates import Architecture
from emulator.training import paper, recipe, train
from emulator.training.job import Job
from emulator.training.optimiser import with_weights
from emulator.training.paper import Paper, prepare

SMALL = Architecture(steps=2, latent=8, hidden=(16, 16))


def test_the_recipe_is_the_papers():
    problem = recipe("paper")
    assert (problem.batch, problem.steps, problem.runs) == (1, 100_000, 0)
    with pytest.raises(InputError, match="batch is 0; it must be 1 or more"):
        Paper(batch=0)


def test_rates_are_the_released_codes(beam):
    rate = prepare(Paper(), Job(beam, SMALL)).training.rate
    rates = [float(rate(jnp.asarray(k), jnp.asarray(100))) for k in (0, 49, 50, 99)]
    assert rates == pytest.approx([1e-4, 1e-4, 1e-5, 1e-5])


def test_a_step_descends_the_mean_energy(beam, simulator):
    """Its loss and its slope along a direction of all weights, by the scene's energy itself."""
    problem = prepare(Paper(batch=4, seed=3), Job(beam, SMALL))
    thetas = uniform(beam, 4, jax.random.fold_in(jax.random.key(3), 7))
    Pi = em.fem.potential_energy(beam)
    centre = Pi(simulator(beam.centre), beam.centre)

    def mean_energy(weights):
        forward = with_weights(problem.emulator, weights).cache()
        return sum(Pi(forward(t), t) for t in thetas) / 4.0 / abs(centre)

    weights = problem.emulator.network.weights
    loss, gradient, same = problem.training.descend(weights, jnp.asarray(7))
    assert same is weights
    assert float(loss) == pytest.approx(float(mean_energy(weights)), rel=1e-5)
    leaves, structure = jax.tree.flatten(weights)
    rng = np.random.default_rng(0)
    along = [jnp.asarray(rng.normal(size=leaf.shape), leaf.dtype) for leaf in leaves]
    step = 1e-4

    def moved(sign):
        shifted = [w + sign * step * d for w, d in zip(leaves, along, strict=True)]
        return float(mean_energy(jax.tree.unflatten(structure, shifted)))

    slope = sum(
        float(jnp.vdot(g, d)) for g, d in zip(jax.tree.leaves(gradient), along, strict=True)
    )
    assert slope == pytest.approx((moved(1.0) - moved(-1.0)) / (2.0 * step), rel=5e-2)


@pytest.mark.slow
def test_training_lowers_the_error_and_the_energy(tmp_path):
    """From rest, on a mesh with nodes amid edges."""
    linear = em.scenes.once_clamped_beam(cells=(2, 1, 1), order=1)
    scene = replace(linear, mesh=to_quadratic(linear.mesh), origin={})
    plan = Paper(steps=600, batch=4, learning_rate=3e-3)
    emulator = train(scene, plan, tmp_path, architecture=SMALL)
    assert emulator.network.graph.real == len(scene.mesh.nodes)
    thetas = uniform(scene, 8, jax.random.key(1))
    Pi = jax.vmap(em.fem.potential_energy(scene))
    predicted = emulator.cache()(thetas)
    assert float(Pi(predicted, thetas).mean()) < 0.0  # of rest
    exact = jnp.stack([em.Simulator(scene)(theta) for theta in thetas])
    left = jnp.linalg.norm(predicted - exact, axis=-1).mean()
    assert left < 0.8 * jnp.linalg.norm(exact, axis=-1).mean()


@pytest.mark.slow
@pytest.mark.parametrize(("rate", "exponent"), [(1e-3, 1.0), (1.0, 1.0), (1e-3, 10.0)])
def test_training_without_barriers_ends_honestly(rate, exponent, tmp_path, monkeypatch):
    """In a named error, or in a poor network whose error bar is right (Eq. 21 to 23 are left out)."""
    monkeypatch.setattr(paper, "Barriers", lambda: None)
    scene = em.scenes.left_ventricle(4, 8, 1, order=1)
    stiffer = tuple(
        replace(p, low=exponent * p.low, high=exponent * p.high) if p.name in ("b", "b_f") else p
        for p in scene.parameters
    )
    scene = replace(scene, parameters=stiffer, origin={})
    plan = Paper(steps=60, learning_rate=rate)
    if rate == 1.0:
        with pytest.raises(SolverError, match="lower the learning rate"):
            train(scene, plan, tmp_path)
        return
    emulator = train(scene, plan, tmp_path)
    forward, simulator = emulator.cache(), em.Simulator(scene)
    bar = em.ErrorBar(forward, simulator)
    for theta in em.fem.sobol(scene, 4, 11):
        away = np.asarray(forward(theta) - simulator(theta))
        estimate = bar(theta)
        assert np.isfinite(away).all()
        if estimate.valid:
            true = np.median(np.linalg.norm(away, axis=1))
            assert 1.0 / 3.0 < float(estimate.median) / true < 3.0
