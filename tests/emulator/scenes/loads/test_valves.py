"""Pressure in a cavity whose openings are closed by valves: exact for any motion of the rims."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import emulator as em
from emulator.core.errors import InputError
from emulator.fem.assembly import System
from emulator.fem.energy import local_terms
from emulator.fem.inverse_motion import InverseSystem
from emulator.fem.loaded import LoadedEquilibrium
from emulator.fem.unloading import scene_at_rest
from emulator.geometry.facets import Cavity
from emulator.geometry.generators.ellipsoid import human_ventricle
from emulator.geometry.refinement import to_quadratic
from emulator.scenes.loads import CavityPressure, ValvePressure
from emulator.scenes.supports import ElasticSupport
from scene_support import block


def heart(order=1, load=ValvePressure):
    """A coarse ventricle on springs along its base."""
    mesh = human_ventricle(3, 6, 1)
    return em.Scene(
        name="heart",
        mesh=to_quadratic(mesh) if order == 2 else mesh,
        law=em.find_law("neo_hookean_split"),
        parameters=(em.Parameter("mu", "kPa", 5.0, 20.0),),
        constants={"kappa": 50.0, "pressure": 1.0},
        loads=(load("endocardium"),),
        supports=(ElasticSupport("base", 0.5),),
    )


def moved(scene, size=1.0, seed=0):
    return size * jnp.asarray(np.random.default_rng(seed).normal(size=scene.held.shape))


def work(scene, u):
    return sum(term.total(u, {"pressure": jnp.array(1.0)}) for term in local_terms(scene))


@pytest.mark.parametrize("order", [1, 2])
def test_its_work_is_minus_p_times_the_change_of_the_volume(order):
    scene = heart(order)
    cavity, u = Cavity(scene.mesh, "endocardium"), moved(scene)
    change = 1000.0 * (cavity(u[cavity.nodes]) - cavity.rest)
    assert float(work(scene, u)) == pytest.approx(-float(change), rel=1e-11)


def test_a_closed_surface_is_neither_pushed_nor_turned():
    scene = heart(2)
    u = moved(scene)
    force = -jax.grad(lambda u: work(scene, u))(u)
    size = float(jnp.abs(force).sum())
    np.testing.assert_allclose(force.sum(axis=0), 0.0, atol=1e-13 * size)
    moment = np.cross(scene.mesh.nodes + u, force).sum(axis=0)
    np.testing.assert_allclose(moment, 0.0, atol=1e-11 * size)


def test_its_equations_on_the_loaded_shape_are_those_of_the_shape_at_rest():
    scene = heart()
    w, theta = moved(scene, 0.2), scene.centre
    inverse = jax.jit(InverseSystem(scene).residual)(w, theta)
    ordinary = jax.jit(System(scene_at_rest(scene, w)).residual)(-w, theta)
    np.testing.assert_allclose(inverse, ordinary, atol=1e-12 * float(jnp.abs(ordinary).max()))


def test_valves_pull_on_their_rims():
    """Without them the pressure lifts nothing: with springs, the base is pulled up by p A."""
    lifts = []
    for load in (ValvePressure, None):
        scene = heart()
        if load is None:
            scene = replace(scene, loads=(em.loads.FollowerPressure("endocardium"),))
        solution = em.Simulator(scene).solve(scene.centre)
        assert solution.converged
        base = scene.mesh.node_set("base")
        lifts.append(float(solution.displacement[base, 2].mean()))
    assert lifts[0] > lifts[1]
    assert abs(lifts[0]) < 0.1 * abs(lifts[1])  # balanced pressure: springs carry no net force


def both_ventricles():
    """A coarse heart imaged under both pressures, on springs along its base and its outside."""
    scene = em.scenes.biventricle(4, 12, (1, 1), order=1)
    return replace(
        scene,
        loads=(ValvePressure("lv_endocardium"),
               ValvePressure("rv_endocardium", parameter="right_pressure")),
        supports=(ElasticSupport("base", 0.5), ElasticSupport("epicardium", 0.1, direction="normal")),
        parameters=(em.Parameter("a", "kPa", 0.5, 3.0), em.Parameter("pressure", "kPa", 0.1, 2.0),
                    em.Parameter("right_pressure", "kPa", 0.05, 0.6),
                    em.Parameter("imaged", "kPa", 0.1, 1.0)),
        constants={"kappa": 25.0, "b": 4.0, "a_f": 10.0, "b_f": 4.0, "imaged_right": 0.15},
        loaded_by={"pressure": "imaged", "right_pressure": "imaged_right"}, origin={},
    )  # fmt: skip


@pytest.mark.slow
def test_both_ventricles_unloaded_and_loaded_again_meet_their_mesh():
    scene = both_ventricles()
    loaded = LoadedEquilibrium(scene, em.fem.NewtonOptions())
    rng = np.random.default_rng(0)
    for _ in range(30):
        a, imaged = rng.uniform(0.5, 3.0), rng.uniform(0.1, 1.0)
        theta = scene.theta(a=a, pressure=imaged, imaged=imaged, right_pressure=0.15)
        at_rest = loaded.unloaded(theta).require_converged().displacement
        again = loaded.solve(theta, at_rest).require_converged()  # from rest
        np.testing.assert_allclose(again.displacement, 0.0, atol=1e-8)


@pytest.mark.slow
def test_slopes_of_both_volumes_are_those_of_differences():
    scene, step = both_ventricles(), 1e-4
    simulator = em.Simulator(scene)
    theta = scene.theta(a=1.2, pressure=1.1, imaged=0.5, right_pressure=0.3)
    for name in ("lv_endocardium", "rv_endocardium"):
        cavity = Cavity(scene.mesh, name)

        def volume(theta, cavity=cavity):
            return cavity(simulator.solve(theta).displacement[cavity.nodes])

        slopes = jax.grad(volume)(theta)
        for k, size in enumerate(theta):
            along = step * float(size) * jnp.eye(len(theta))[k]
            difference = (volume(theta + along) - volume(theta - along)) / (2.0 * along[k])
            assert float(slopes[k]) == pytest.approx(float(difference), rel=1e-6)


def test_what_it_refuses():
    scene = block()
    with pytest.raises(InputError, match="encloses no volume"):
        replace(scene, loads=(ValvePressure("right", 0.1),))
    with pytest.raises(InputError, match="is not held"):
        heart(load=CavityPressure)
