"""Natural monotonicity, and the forces it is judged by."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import emulator as em
from emulator.fem.condensation import Volumes, consistent, linearise, residuals
from emulator.fem.energy import pair_products
from emulator.geometry.generators.box import box
from emulator.geometry.generators.ellipsoid import land_ventricle
from emulator.geometry.refinement import to_quadratic
from emulator.mechanics.laws import find_law
from emulator.scenes import Parameter, Scene, Support
from emulator.scenes.loads import CavityPressure, FollowerPressure


def guccione(mesh, load, held, exponents) -> Scene:
    """Problems 1 and 2 of Land et al. (2015), nearly incompressible, fibres along x."""
    return Scene(
        name="land",
        mesh=mesh,
        law=find_law("guccione"),
        parameters=(Parameter("C", "kPa", 1.0, 20.0, "log"),),
        loads=(load,),
        supports=(Support(held),),
        constants=dict(zip(("b_f", "b_t", "b_fs", "kappa"), exponents, strict=True)),
        fibres=np.tile([1.0, 0.0, 0.0], (len(mesh.elements), 1)),
        dilatation="mean",
    )


@pytest.fixture
def beam_scene():
    mesh = to_quadratic(box((10.0, 1.0, 1.0), (6, 1, 1)))
    return guccione(mesh, FollowerPressure("bottom", 0.004), "left", (8.0, 2.0, 4.0, 1e4))


@pytest.mark.slow
def test_an_eliminated_force_is_the_force_where_it_was_linearised(beam_scene):
    rng = np.random.default_rng(0)
    u = jnp.asarray(0.01 * rng.normal(size=beam_scene.held.shape))
    theta = jnp.array([2.0])
    there = consistent(beam_scene, u, theta)
    volumes = Volumes(there.change + 0.01, there.pressure - 3.0)
    at = jax.jit(lambda u: linearise(beam_scene, u, volumes, theta))(u)
    there = jax.jit(lambda u: residuals(beam_scene, u, volumes, theta))(u)
    force = at.couplings.eliminated(there)
    np.testing.assert_allclose(force, at.force, rtol=1e-9)


@pytest.mark.slow
def test_an_eliminated_force_falls_with_the_square_of_the_step(beam_scene):
    """Where a Newton step leads, the eliminated force is what the tangent left out."""
    rng = np.random.default_rng(1)
    u = jnp.asarray(0.01 * rng.normal(size=beam_scene.held.shape))
    theta = jnp.array([2.0])
    volumes = jax.jit(lambda u: consistent(beam_scene, u, theta))(u)
    at = jax.jit(lambda u: linearise(beam_scene, u, volumes, theta))(u)
    move = jnp.asarray(0.01 * rng.normal(size=u.shape))
    local = move[beam_scene.discretisation.connectivity]
    pull = pair_products(at.tangent, local)

    @jax.jit
    def gap(fraction):
        after = at.couplings.advance(volumes, local, fraction)
        there = residuals(beam_scene, u + fraction * move, after, theta)
        force = at.couplings.eliminated(there)
        return jnp.linalg.norm(force - at.force - fraction * pull)

    gaps = [float(gap(fraction)) for fraction in (1e-2, 1e-3)]
    assert gaps[0] / gaps[1] == pytest.approx(100.0, rel=0.2)


@pytest.mark.slow
def test_the_cantilever_of_land_is_reached_from_rest(beam_scene):
    solution = em.Simulator(beam_scene).solve(jnp.array([2.0]))
    assert solution.converged
    assert solution.iterations <= 40  # 48 when only elements were guarded


@pytest.mark.slow
def test_the_ellipsoid_of_land_is_reached_from_rest():
    mesh = land_ventricle(rings=4, around=10, layers=1, order=2)
    load = CavityPressure("endocardium", 10.0)
    scene = guccione(mesh, load, "base", (1.0, 1.0, 1.0, 1e5))
    solution = em.Simulator(scene).solve(jnp.array([10.0]))
    assert solution.converged
    assert solution.iterations <= 40  # 57 when only elements were guarded; 165 on a finer mesh
