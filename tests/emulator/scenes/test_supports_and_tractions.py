"""Tractions and elastic supports against hand arithmetic."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import emulator as em
from emulator.core.errors import InputError
from emulator.fem.energy import dead_force, spring_terms, strain_energy
from emulator.geometry.refinement import to_quadratic
from emulator.scenes.loads import Traction
from emulator.scenes.supports import ElasticSupport
from scene_support import block


def quadratic(scene):
    return replace(scene, mesh=to_quadratic(scene.mesh))


@pytest.mark.parametrize("change", [lambda s: s, quadratic], ids=["P1", "P2"])
def test_a_traction_pulls_with_its_value_times_the_area(change):
    scene = change(block(loads=(Traction("right", (1.0, 0.0, -2.0)),)))
    force = dead_force(scene).constant  # the face is 3 x 4 mm
    np.testing.assert_allclose(force.sum(axis=0), [12.0, 0.0, -24.0], atol=1e-12)
    # Its moment about the face's middle vanishes.
    arm = scene.mesh.nodes - [2.0, 1.5, 2.0]
    np.testing.assert_allclose(np.cross(arm, force).sum(axis=0), 0.0, atol=1e-10)


@pytest.mark.parametrize("change", [lambda s: s, quadratic], ids=["P1", "P2"])
def test_springs_store_half_k_u_squared(change):
    spring = ElasticSupport("right", 0.5)
    scene = change(block(supports=(em.Support("left"), spring)))
    (term,) = spring_terms(scene)
    moved = jnp.zeros(scene.held.shape).at[:, 1].set(0.2)
    # 0.5 kPa/mm * 12 mm2 * (0.2 mm)^2 / 2 = 0.12 mN mm
    assert term.total(moved, {}) == pytest.approx(0.12, rel=1e-12)
    sliding = replace(scene, supports=(em.Support("left"), replace(spring, direction="normal")))
    (term,) = spring_terms(sliding)
    assert term.total(moved, {}) == pytest.approx(0.0, abs=1e-15)
    assert term.total(moved[:, jnp.array([1, 0, 2])], {}) == pytest.approx(0.12, rel=1e-12)


def test_a_body_on_springs_alone_sinks_by_its_load_over_their_stiffness():
    # Almost rigid: 12 mN on 0.5 kPa/mm * 12 mm2 give 2 mm.
    scene = block(
        loads=(Traction("right", (1.0, 0.0, 0.0)),), supports=(ElasticSupport("left", 0.5),)
    )
    u = em.Simulator(scene)(jnp.array([1e6, 1e6]))
    np.testing.assert_allclose(u[:, 0], 2.0, rtol=1e-4)


@pytest.mark.slow
def test_springs_of_unknown_stiffness_are_those_of_that_stiffness():
    load = (Traction("right", (0.2, 0.0, 0.1)),)
    known = block(loads=load, supports=(ElasticSupport("left", 0.7),))
    scene = replace(
        known,
        supports=(ElasticSupport("left"),),
        parameters=(*known.parameters, em.Parameter("stiffness", "kPa/mm", 0.1, 10.0, "log")),
    )
    simulator, theta = em.Simulator(scene), jnp.array([3.0, 4.0, 0.7])
    u = simulator(theta)
    np.testing.assert_allclose(u, em.Simulator(known)(theta[:2]), atol=1e-10)
    h = 1e-5
    step = jnp.array([0.0, 0.0, h])
    by_differences = (simulator(theta + step) - simulator(theta - step)) / (2.0 * h)
    np.testing.assert_allclose(simulator.sensitivities(u, theta)[2], by_differences, atol=1e-6)
    assert scene.load_parameters == ()  # a clamp is the same in all load states


@pytest.mark.slow
def test_stiff_springs_clamp():
    load = (Traction("right", (0.2, 0.0, 0.1)),)
    clamped = em.Simulator(block(loads=load))(block().centre)
    sprung = em.Simulator(block(loads=load, supports=(ElasticSupport("left", 1e7),)))(
        block().centre
    )
    np.testing.assert_allclose(sprung, clamped, atol=1e-5)


def test_loads_and_springs_that_are_not_there_cost_nothing():
    count = lambda scene: len(
        jax.make_jaxpr(em.fem.potential_energy(scene))(
            jnp.zeros(scene.held.shape), scene.centre
        ).eqns
    )
    bare = block()
    alone = len(jax.make_jaxpr(strain_energy(bare))(jnp.zeros(bare.held.shape), bare.centre).eqns)
    assert count(bare) == alone
    sprung = block(supports=(em.Support("left"), ElasticSupport("right", 1.0)))
    assert count(sprung) > alone


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ElasticSupport("left", -1.0), "stiffness is -1.0 kPa/mm; it must be above 0"),
        (lambda: ElasticSupport("left", 1.0, "up"), "direction 'up'; use all or normal"),
        (lambda: Traction("left", (1.0, 2.0)), "give 3 finite numbers in kPa"),
        (lambda: em.Support("left", components="xw"), "components 'xw'; name some of x, y and z"),
    ],
)
def test_bad_input_has_one_line(make, message):
    with pytest.raises(InputError, match=message):
        make()
