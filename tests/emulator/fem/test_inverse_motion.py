"""Inverse motion: its equations are those of the scene on the stress-free mesh."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import emulator as em
from emulator.core.errors import InputError
from emulator.fem.assembly import System
from emulator.fem.inverse_motion import InverseSystem, carried_back, from_rest
from emulator.fem.unloading import scene_at_rest, system_at_rest
from emulator.geometry.generators.ellipsoid import human_ventricle
from emulator.geometry.refinement import to_quadratic
from emulator.mechanics.laws import find_law
from emulator.scenes.fibre_rules import Helix
from emulator.scenes.loads import (
    CavityPressure,
    DeadPressure,
    FollowerPressure,
    Force,
    Gravity,
    GravityVector,
    PublishedPressure,
    Traction,
)
from emulator.scenes.supports import ElasticSupport
from law_support import ARGUMENTS
from scene_support import block

SLIDING = ElasticSupport("right", 0.7, "normal")
LOADS = {
    "gravity": Gravity(density=50.0, direction=(1.0, 0.0, -1.0)),
    "gravity_vector": GravityVector(density=50.0),
    "traction": Traction("right", (0.3, 0.1, -0.2)),
    "dead_pressure": DeadPressure("right", 0.4),
    "follower_pressure": FollowerPressure("right"),
    "force": Force("corner", (0.01, 0.0, -0.02), "amount"),
}


def some_way(scene, size=0.01, seed=0):
    """A displacement to a stress-free shape that inverts nothing; supports stay."""
    span = np.ptp(scene.mesh.nodes, axis=0).min()
    way = size * span * np.random.default_rng(seed).normal(size=scene.held.shape)
    return jnp.where(scene.held, 0.0, way)


def loaded_block(load, change=lambda mesh: mesh, supports=(em.Support("left"),)):
    scene = block(supports=supports)
    corner = {"corner": np.array([len(scene.mesh.nodes) - 1])}
    mesh = change(replace(scene.mesh, node_sets={**scene.mesh.node_sets, **corner}))
    values = {"pressure": 0.4, "amount": 3.0, "gravity_x": 3.0, "gravity_y": 0.0, "gravity_z": -9.0}
    constants = {} if load is None else {q.name: values[q.name] for q in load.quantities}
    loads = () if load is None else (load,)
    return replace(scene, mesh=mesh, loads=loads, constants=constants)


def ventricle(law="holzapfel_ogden", order=1, dilatation="pointwise"):
    """A very coarse one, of any law; stiffness varies."""
    mesh = human_ventricle(3, 6, 1)
    mesh = to_quadratic(mesh) if order == 2 else mesh
    law, rule = find_law(law), Helix((60.0, -60.0))
    fibres, sheets = rule.directions(mesh)
    values = dict(zip(law.parameters, ARGUMENTS[law.name], strict=True))
    name = law.parameters[0]
    return em.Scene(
        name="ventricle",
        mesh=mesh,
        law=law,
        parameters=(
            em.Parameter(name, law.quantities[0].unit, 0.5 * values[name], 2 * values[name]),
        ),
        constants={**{k: v for k, v in values.items() if k != name}, "pressure": 1.0},
        loads=(CavityPressure("endocardium"),),
        supports=(em.Support("base"),),
        fibres=fibres if law.fibres else None,
        sheets=sheets if law.sheets else None,
        dilatation=dilatation,
    )


def both_residuals(scene):
    """Of inverse motion, and of the scene on the stress-free mesh; with their size."""
    w, theta = some_way(scene), scene.centre
    inverse = jax.jit(InverseSystem(scene).residual)(w, theta)
    ordinary = System(scene_at_rest(scene, w))
    return inverse, jax.jit(ordinary.residual)(-w, theta)


def assert_equal_equations(scene):
    inverse, ordinary = both_residuals(scene)
    np.testing.assert_allclose(inverse, ordinary, atol=1e-12 * float(jnp.abs(ordinary).max()))


@pytest.mark.parametrize("load", LOADS)
def test_loads_on_the_loaded_shape_are_those_of_the_shape_at_rest(load):
    assert_equal_equations(loaded_block(LOADS[load]))


@pytest.mark.parametrize("load", ["traction", "dead_pressure", "follower_pressure", "gravity"])
@pytest.mark.slow
def test_so_are_those_on_curved_facets(load):
    assert_equal_equations(loaded_block(LOADS[load], to_quadratic))


@pytest.mark.parametrize("springs", [ElasticSupport("right", 0.7), SLIDING], ids=["all", "normal"])
def test_springs_are_at_rest_where_the_body_is(springs):
    assert_equal_equations(loaded_block(None, supports=(em.Support("left"), springs)))


KINDS = [
    ("holzapfel_ogden", 1, "pointwise"),
    ("holzapfel_ogden", 2, "mean"),
    *(
        pytest.param(*kind, marks=pytest.mark.slow)
        for kind in (
            ("holzapfel_ogden_orthotropic", 1, "pointwise"),
            ("guccione", 1, "pointwise"),
            ("small_strain", 1, "pointwise"),
            ("holzapfel_ogden", 2, "pointwise"),
            ("holzapfel_ogden", 1, "patch"),
            ("holzapfel_ogden_orthotropic", 2, "mean"),
        )
    ),
]


@pytest.mark.parametrize(("law", "order", "dilatation"), KINDS)
def test_the_equations_are_those_of_the_scene_at_rest(law, order, dilatation):
    assert_equal_equations(ventricle(law, order, dilatation))


def assert_tangent(scene):
    """That the tangent times a direction is the residual's derivative along it."""
    system, theta = InverseSystem(scene), scene.centre
    direction = some_way(scene, seed=1)

    @jax.jit
    def products(w):
        along = jax.jvp(lambda w: system.residual(w, theta), (w,), (direction,))[1]
        return along, system.pattern.product(system.tangent(w, theta), system.restrict(direction))

    derivative, product = products(some_way(scene))
    np.testing.assert_allclose(product, derivative, atol=1e-12 * float(jnp.abs(derivative).max()))


@pytest.mark.parametrize(
    ("law", "order", "dilatation"),
    [KINDS[0], pytest.param(*KINDS[1], marks=pytest.mark.slow), *KINDS[2:]],
)
def test_the_tangent_is_the_derivative_of_the_residual(law, order, dilatation):
    assert_tangent(ventricle(law, order, dilatation))


slowly = [pytest.param(load, marks=pytest.mark.slow) for load in ("gravity", "dead_pressure")]


@pytest.mark.parametrize("load", ["traction", *slowly])
def test_the_tangent_has_loads_that_depend_on_the_shape_at_rest(load):
    assert_tangent(loaded_block(LOADS[load], supports=(em.Support("left"), SLIDING)))


@pytest.mark.parametrize("load", [LOADS["gravity"], LOADS["traction"], LOADS["dead_pressure"]])
def test_a_system_on_a_traced_mesh_is_that_of_the_mesh(load):
    scene = loaded_block(load, supports=(em.Support("left"), SLIDING))
    w, u = some_way(scene), some_way(scene, seed=1)
    there = jax.jit(
        lambda w, u: system_at_rest(System(scene), w, scene.centre).residual(u, scene.centre)
    )
    expected = System(scene_at_rest(scene, w)).residual(u, scene.centre)
    np.testing.assert_allclose(there(w, u), expected, atol=1e-12)


def test_directions_are_carried_back_as_lines_of_the_tissue():
    h = jnp.asarray(0.2 * np.random.default_rng(0).normal(size=(3, 3)))
    f = jnp.eye(3) + h
    fibre, sheet = jnp.linalg.qr(jnp.asarray(np.random.default_rng(1).normal(size=(3, 3))))[0][:2]
    back = carried_back(h, jnp.stack([fibre, sheet]))
    F = jnp.eye(3) + from_rest(h)
    np.testing.assert_allclose(F @ f, np.eye(3), atol=1e-14)
    along = F @ back[0]
    np.testing.assert_allclose(along / jnp.linalg.norm(along), fibre, atol=1e-14)
    np.testing.assert_allclose(back @ back.T, np.eye(2), atol=1e-14)
    # The sheet stays in the plane of both lines.
    plane = jnp.cross(f @ fibre, f @ sheet)
    assert float(jnp.vdot(plane, back[1])) == pytest.approx(0.0, abs=1e-14)


def test_a_load_that_says_nothing_of_the_loaded_shape_is_refused():
    grid = block().discretisation
    with pytest.raises(InputError, match="cannot be unloaded from a load of kind 'published_press"):
        PublishedPressure("right", 0.1).on_loaded(grid)
    with pytest.raises(InputError, match="force on 'right' is spread along an edge by its length"):
        Force("right", (1.0, 0.0, 0.0)).on_loaded(grid)
