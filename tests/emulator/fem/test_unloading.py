"""Unloading: loading what it finds leads back; two methods agree; derivatives; failures named."""

import re
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import emulator as em
from calibrate.cli import main
from cli_support import answer
from emulator.core.errors import InputError, SolverError
from emulator.fem.assembly import System
from emulator.fem.energy import volume_ratio
from emulator.fem.solution import Status
from emulator.fem.unloading import system_at_rest
from emulator.geometry.generators.ellipsoid import human_ventricle
from emulator.geometry.generators.sphere import sphere_octant
from emulator.geometry.io import write_mesh
from emulator.mechanics.laws.neo_hookean import bulk_modulus
from emulator.scenes.loads import KPA_PER_MMHG, Force
from emulator.verify.incompressible import INNER, MU, OUTER, pressure_at, sphere_scene
from scene_support import between_plates, block

MET = 1e-8  # mm


def some_theta(scene, count, seed=0):
    """Theta (count, p) anywhere in the box, at 4 to 15 mmHg."""
    rng = np.random.default_rng(seed)
    theta = scene.from_unit(jnp.asarray(rng.uniform(size=(count, len(scene.parameters)))))
    where = scene.parameter_names.index("pressure")
    return theta.at[:, where].set(KPA_PER_MMHG * rng.uniform(4.0, 15.0, count))


def missed(unloaded, theta):
    """Largest distance in mm of the unloaded shape, loaded from rest, from the mesh it came of."""
    again = em.Simulator(unloaded.scene).solve(theta).require_converged()
    return float(jnp.abs(again.displacement - unloaded.start).max())


@pytest.fixture(scope="module")
def unloader(ventricle):
    return em.fem.Unloader(ventricle)


def test_the_unloaded_shape_loaded_from_rest_is_the_mesh(unloader, ventricle):
    (theta,) = some_theta(ventricle, 1, seed=2)
    unloaded = unloader.solve(theta).require_converged()
    assert missed(unloaded, theta) < MET
    assert float(jnp.abs(unloaded.displacement).max()) > 1.0
    assert not np.asarray(unloaded.displacement)[ventricle.held].any()
    shape = unloaded.scene
    assert shape.mesh.facet_sets.keys() == ventricle.mesh.facet_sets.keys()
    assert (shape.loads, shape.supports) == (ventricle.loads, ventricle.supports)
    assert shape.fingerprint != ventricle.fingerprint


def test_a_body_loaded_and_unloaded_is_itself(ventricle, unloader):
    (theta,) = some_theta(ventricle, 1, seed=1)
    u = em.Simulator(ventricle).solve(theta).require_converged().displacement
    # Fibres of the loaded tissue are those at rest, carried along.
    F = jnp.eye(3) + ventricle.gradients(u)
    along = jnp.einsum("mqij,mqj->mqi", F, ventricle.fibres_at_points)
    fibres = np.asarray(along / jnp.linalg.norm(along, axis=-1, keepdims=True))
    mesh = replace(ventricle.mesh, nodes=ventricle.mesh.nodes + np.asarray(u))
    image = replace(ventricle, mesh=mesh, fibres=fibres, fibre_rule=None, origin={})
    unloaded = em.fem.unload(image, theta).require_converged()
    np.testing.assert_allclose(unloaded.displacement, -u, atol=MET)
    np.testing.assert_allclose(unloaded.scene.fibres, ventricle.fibres, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("order", "dilatation"), [(1, "pointwise"), (1, "patch"), (2, "pointwise"), (2, "mean")]
)
def test_so_it_is_at_any_theta(order, dilatation):
    scene = em.scenes.left_ventricle(4, 8, 1, order=order)
    scene = replace(scene, dilatation=dilatation, origin={})
    unloader = em.fem.Unloader(scene)
    for theta in some_theta(scene, 5, seed=4):
        assert missed(unloader.solve(theta), theta) < MET


@pytest.mark.slow
def test_so_it_is_on_the_default_ventricle():
    scene = em.scenes.left_ventricle()
    unloader = em.fem.Unloader(scene)
    for theta in some_theta(scene, 3):
        assert missed(unloader.solve(theta), theta) < MET


@pytest.mark.slow
@pytest.mark.parametrize(("order", "dilatation"), [(1, "pointwise"), (2, "mean")])
def test_the_fixed_point_is_the_shape_of_inverse_motion(order, dilatation):
    scene = replace(em.scenes.left_ventricle(4, 8, 1, order=order), dilatation=dilatation)
    one, other = (em.fem.Unloader(scene, method) for method in ("inverse", "fixed_point"))
    found = one.solve(scene.centre).require_converged()
    again = other.solve(scene.centre).require_converged()
    np.testing.assert_allclose(found.displacement, again.displacement, atol=1e-6)
    assert int(found.factorisations) < int(again.factorisations)
    assert float(again.residual) < 1e-7


@pytest.mark.slow
def test_a_liver_on_springs_is_unloaded_from_its_weight():
    scene = em.scenes.liver(shells=2)
    assert missed(em.fem.unload(scene, scene.centre), scene.centre) < MET


@pytest.mark.slow
def test_a_sphere_is_unloaded_by_its_radial_integral():
    # Loaded radii of a sphere of 10 and 15 mm whose inner surface is stretched by 1.2.
    stretch, cells = 1.2, (4, 3)
    inner = stretch * INNER
    outer = (OUTER**3 + inner**3 - INNER**3) ** (1.0 / 3.0)
    scene = replace(sphere_scene(cells), mesh=sphere_octant(inner, outer, cells, 1.5, order=2))
    theta = jnp.array([MU, bulk_modulus(MU, 0.4999), pressure_at(stretch)])
    mesh = em.fem.unload(scene, theta).scene.mesh
    for name, radius in (("inner", INNER), ("outer", OUTER)):
        found = np.linalg.norm(mesh.nodes[mesh.node_set(name)], axis=1)
        assert found.mean() == pytest.approx(radius, rel=0.005)


def differences(way, theta, direction, step=1e-4):
    """Central difference of ``way`` along ``direction``, and its size."""
    found = (way(theta + step * direction) - way(theta - step * direction)) / (2.0 * step)
    return found, float(jnp.abs(found).max())


PART = jnp.array([0.3, -0.2, 0.5, 0.1, -0.4])  # of theta, a direction


def test_derivatives_are_those_of_the_shape(unloader, ventricle):
    theta = ventricle.centre
    way = lambda theta: unloader.solve(theta).displacement
    difference, size = differences(way, theta, PART * theta)
    along = jax.jvp(way, (theta,), (PART * theta,))[1]
    np.testing.assert_allclose(along, difference, atol=1e-6 * size)


@pytest.mark.slow
def test_so_they_are_backwards_and_within_a_program(unloader, ventricle):
    theta = ventricle.centre
    way = jax.jit(lambda theta: unloader.solve(theta).displacement)
    difference, size = differences(way, theta, PART * theta)
    along = jax.jvp(way, (theta,), (PART * theta,))[1]
    np.testing.assert_allclose(along, difference, atol=1e-6 * size)
    rows = unloader.sensitivities(unloader.solve(theta), theta)
    np.testing.assert_allclose(jnp.tensordot(PART * theta, rows, 1), along, atol=1e-9 * size)
    weights = jnp.asarray(np.random.default_rng(0).normal(size=along.shape))
    slope = jax.grad(lambda theta: jnp.vdot(weights, way(theta)))(theta)
    assert float(slope @ (PART * theta)) == pytest.approx(float(jnp.vdot(weights, along)), rel=1e-9)


@pytest.mark.slow
def test_derivatives_with_mean_dilatation_and_of_the_fixed_point():
    scene = replace(em.scenes.left_ventricle(4, 8, 1), dilatation="mean", origin={})
    theta = scene.centre
    for method, close in (("inverse", 1e-6), ("fixed_point", 1e-4)):
        unloader = em.fem.Unloader(scene, method)
        way = lambda theta: unloader.solve(theta).displacement  # noqa: B023
        difference, size = differences(way, theta, PART * theta)
        along = jax.jvp(way, (theta,), (PART * theta,))[1]
        np.testing.assert_allclose(along, difference, atol=close * size)


def test_a_shape_that_such_tissue_would_not_stay_in_is_told(unloader, ventricle):
    # At 13 mmHg this soft and coarse body, unloaded, has the mesh as an unstable equilibrium.
    theta = jnp.array([0.37, 1.47, 3.16, 1.03, 1.75])
    unloaded = unloader.solve(theta).require_converged()
    assert not em.Simulator(unloaded.scene).is_stable(unloaded.start, theta)
    assert missed(unloaded, theta) > 1.0


def test_no_load_no_way(unloader, ventricle):
    unloaded = unloader.solve(ventricle.centre.at[-1].set(0.0)).require_converged()
    assert not np.asarray(unloaded.displacement).any()


def test_failures_have_names(unloader, ventricle):
    crushed = unloader.solve(ventricle.centre.at[-1].set(1e6))
    assert not crushed.converged
    assert Status(int(crushed.status)) in (
        Status.LOAD_LIMIT, Status.INVERTED_ELEMENT, Status.ITERATION_LIMIT,
    )  # fmt: skip
    assert np.isfinite(crushed.displacement).all()
    with pytest.raises(SolverError, match="unloading: .*up to 0 % of the load .pressure 0 kPa. c"):
        crushed.scene  # noqa: B018
    nowhere = unloader.solve(ventricle.centre.at[0].set(jnp.nan))
    assert Status(int(nowhere.status)) is Status.INVALID_INPUT
    assert np.isfinite(nowhere.displacement).all()


SOFT = """
law = "neo_hookean"
mesh = "lv.vtu"
[[supports]]
node_set = "base"
[[loads]]
kind = "cavity_pressure"
facet_set = "endocardium"
parameter = "pressure"
[parameters.mu]
unit = "kPa"
range = [0.5, 20]
[parameters.pressure]
unit = "kPa"
range = [0, 200]
[constants]
lam = 30.0
"""


def test_how_much_of_a_load_that_is_too_high_could_be_taken_off(tmp_path, capsys):
    write_mesh(tmp_path / "lv.vtu", human_ventricle(4, 8, 1))
    (tmp_path / "lv.toml").write_text(SOFT)
    words = ["unload", tmp_path / "lv.toml", "--theta", "mu=1", "pressure=150"]
    code, result = answer(capsys, *words)
    assert (code, result["status"]) == (1, "load_limit")
    assert 0.0 < result["load_reached"] < 0.1
    assert result["taken_off"] == {"pressure": 150.0 * result["load_reached"]}
    assert main(list(map(str, words))) == 1
    share, amount = 100.0 * result["load_reached"], result["taken_off"]["pressure"]
    line = f"up to {share:.3g} % of the load (pressure {amount:.3g} kPa) could be taken off"
    assert capsys.readouterr().out.splitlines()[1] == line
    scene = em.find_scene(str(tmp_path / "lv.toml"))
    most = em.fem.unload(scene, scene.theta(mu=1.0, pressure=150.0))
    with pytest.raises(SolverError, match=re.escape(line)):
        most.require_converged()
    assert em.fem.unload(scene, jnp.array([1.0, amount])).converged


@pytest.mark.slow
def test_corners_may_invert_where_no_mesh_is_asked_for():
    """Corners of flat elements turn over long before the points at which stress is evaluated."""
    scene, theta = em.scenes.left_ventricle(4, 8, 1), jnp.array([0.2, 1.0, 3.0, 1.0, 100.0])
    most = em.fem.unload(scene, theta)
    assert most.converged
    assert volume_ratio(scene, most.displacement).min() > 0.1
    with pytest.raises(InputError, match="28 of 156 elements of the stress-free mesh are inverted"):
        _ = most.scene
    view = system_at_rest(System(scene), most.displacement, theta)
    assert view.relative_residual(most.start, theta) < 1e-10


REFUSED = [
    (between_plates(), "a support moves the body"),
    (
        replace(block(), loads=(Force("right", (1.0, 0.0, 0.0)),)),
        "force on 'right' is spread along an edge",
    ),
]


@pytest.mark.parametrize(("scene", "fault"), REFUSED)
def test_what_is_refused_says_why(scene, fault):
    with pytest.raises(InputError, match=f"scene 'block.*': .*{fault}"):
        em.fem.Unloader(scene)


def test_a_method_and_a_theta_that_are_not_there(ventricle, unloader):
    with pytest.raises(InputError, match="method of unloading 'luck' is unknown; known: inverse"):
        em.fem.unload(ventricle, ventricle.centre, method="luck")
    with pytest.raises(InputError, match=r"theta has shape \(3,\); expected \(5,\)"):
        unloader.solve(jnp.zeros(3))
