"""Fibres that parameters turn: the angle's meaning, exact derivatives, finer meshes, files."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import emulator as em
from emulator.accuracy.mesh_error import mesh_error
from emulator.catalogue import find_scene
from emulator.core.errors import InputError
from emulator.fem.energy import potential_energy
from emulator.fem.fields import element_fields
from emulator.fem.inverse_motion import InverseSystem
from emulator.geometry.generators.box import box
from emulator.mechanics.laws import find_law
from emulator.scenes import Parameter, Scene, Support
from emulator.scenes.effects import effects_of
from emulator.scenes.fibre_rules import Helix, Uniform
from emulator.scenes.finer import finer
from emulator.scenes.loads import ActiveTension, CavityPressure
from emulator.scenes.tissue import FibreAngles
from scene_file_support import HEART

KNOWN = {"a": 0.3, "b": 2.0, "a_f": 5.0, "b_f": 2.0, "pressure": 0.9}


@pytest.fixture(scope="module")
def turning():
    """A ventricle whose helix angles are parameters."""
    return em.scenes.left_ventricle(4, 8, 1, order=1, angles=("inner", "outer"))


@pytest.fixture(scope="module")
def fixed():
    """The same ventricle with known angles."""
    return em.scenes.left_ventricle(4, 8, 1, order=1, angles=(63.0, -51.0))


def test_angles_turn_fibres_to_where_the_rule_lays_them(turning, fixed):
    theta = turning.theta(**KNOWN, inner=63.0, outer=-51.0)
    found = np.asarray(turning.tissue_at(theta).directions)
    np.testing.assert_allclose(found, fixed.fibres_at_points, atol=1e-12)
    u = 0.01 * jax.random.normal(jax.random.key(0), turning.held.shape) * ~turning.held
    one = potential_energy(turning)(u, theta)
    other = potential_energy(fixed)(u, fixed.theta(**KNOWN))
    assert one == pytest.approx(float(other), rel=1e-12)


@pytest.mark.slow
def test_equilibria_and_their_derivatives(turning, fixed):
    simulator = em.fem.Simulator(turning)
    theta = turning.theta(**KNOWN, inner=63.0, outer=-51.0)
    u = simulator(theta)
    np.testing.assert_allclose(u, em.fem.Simulator(fixed)(fixed.theta(**KNOWN)), atol=1e-10)
    slopes = simulator.sensitivities(u, theta)
    for name in ("inner", "outer"):
        k = turning.parameter_names.index(name)
        step = jnp.zeros(len(theta)).at[k].set(0.05)
        by_difference = (simulator(theta + step) - simulator(theta - step)) / 0.1
        np.testing.assert_allclose(slopes[k], by_difference, atol=1e-7)


def test_sheets_turn_with_the_fibres_and_stay_across():
    scene = em.scenes.left_ventricle(3, 6, 1, angles=("inner", -60.0))
    n = scene.angles[0].axis
    sheets = np.cross(n, scene.fibres)
    law = find_law("holzapfel_ogden_orthotropic")
    more = {"a_s": 1.0, "b_s": 1.0, "a_fs": 0.2, "b_fs": 1.0}
    both = replace(scene, law=law, sheets=sheets, constants={**scene.constants, **more}, origin={})
    found = np.asarray(both.tissue_at(both.theta(**KNOWN, inner=50.0)).directions)
    assert np.abs(np.einsum("mqi,mqi->mq", found[:, :, 0], found[:, :, 1])).max() < 1e-12
    np.testing.assert_allclose(np.linalg.norm(found, axis=-1), 1.0, atol=1e-12)
    np.testing.assert_allclose(np.cross(n, found[:, :, 0]), found[:, :, 1], atol=1e-12)


def orthotropic(rule, *names):
    """A coarse ventricle of an orthotropic law with directions by ``rule``."""
    scene = em.scenes.left_ventricle(3, 6, 1, order=1, angles=(60.0, -60.0))
    fibres, sheets = rule.directions(scene.mesh)
    more = {"a_s": 2.0, "b_s": 2.0, "a_fs": 0.5, "b_fs": 1.0}
    return replace(
        scene,
        law=find_law("holzapfel_ogden_orthotropic"),
        parameters=(*scene.parameters, *(Parameter(name, "deg", -90.0, 90.0) for name in names)),
        constants={**scene.constants, **more},
        fibres=fibres,
        sheets=sheets,
        fibre_rule=rule,
        angles=rule.angles_in(scene.mesh),
        origin={},
    )


def test_sheet_angles_turn_sheets_about_the_fibres():
    names = ("in", "out", "s_in", "s_out")
    scene = orthotropic(Helix(names[:2], sheet_angles=names[2:]), *names)
    values = dict(zip(names, (63.0, -51.0, 30.0, -20.0), strict=True))
    found = np.asarray(scene.tissue_at(scene.theta(**KNOWN, **values)).directions)
    laid = Helix((63.0, -51.0), sheet_angles=(30.0, -20.0)).directions(scene.mesh)
    np.testing.assert_allclose(found[:, 0, 0], laid[0], atol=1e-12)
    np.testing.assert_allclose(found[:, 0, 1], laid[1], atol=1e-12)
    depth, normal = scene.angles[1].shares["out"][:, 0], scene.angles[1].axis[:, 0]
    angle = np.deg2rad(30.0 - 50.0 * depth)
    np.testing.assert_allclose(np.sum(laid[1] * normal, axis=1), np.cos(angle), atol=1e-12)
    right_handed = np.sum(np.cross(laid[0], normal) * laid[1], axis=1)
    np.testing.assert_allclose(right_handed, np.sin(angle), atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("solver", [em.Simulator, em.fem.Unloader])
def test_slopes_in_sheet_angles_are_those_of_differences(solver):
    rule = Helix((60.0, -60.0), sheet_angles=("s_in", "s_out"))
    scene = orthotropic(rule, "s_in", "s_out")
    solves = solver(scene)
    theta = scene.theta(**KNOWN, s_in=30.0, s_out=-20.0)
    u = solves.solve(theta).require_converged()
    point = u if solver is em.fem.Unloader else u.displacement
    slopes = solves.sensitivities(point, theta)
    for name in ("s_in", "s_out"):
        k = scene.parameter_names.index(name)
        step = jnp.zeros(len(theta)).at[k].set(0.05)
        ends = [solves.solve(theta + s * step).require_converged().displacement for s in (1, -1)]
        by_difference = (ends[0] - ends[1]) / 0.1
        largest = jnp.abs(by_difference).max()
        assert largest > 1e-5  # mm a degree: they matter
        np.testing.assert_allclose(slopes[k], by_difference, atol=1e-6 * float(largest))


def test_sheet_angles_without_sheets(fixed):
    rule = Helix((63.0, -51.0), sheet_angles=("s_in", 0.0))
    parameters = (*fixed.parameters, Parameter("s_in", "deg", -90.0, 90.0))
    with pytest.raises(InputError, match="sheet angles turn sheets, and its law takes none"):
        replace(fixed, parameters=parameters, angles=rule.angles_in(fixed.mesh))
    scene = orthotropic(rule, "s_in")
    without = [e.without for e in effects_of(scene).values() if e.without.sheets is None]
    assert without
    assert all("s_in" not in each.parameter_names for each in without)


def test_a_block_about_an_axis():
    rule = Uniform((1.0, 0.0, 0.0), angle="alpha", about=(0.0, 0.0, 2.0))
    mesh = box((1.0, 1.0, 1.0), (1, 1, 1))
    angles, fibres = rule.angles_in(mesh), rule.directions(mesh)[0]
    law, block = find_law("holzapfel_ogden"), Support("left")
    scene = Scene(
        "cube", mesh, law, (Parameter("alpha", "deg", 0.0, 90.0),), (), (block,),
        {"a": 1.0, "b": 1.0, "a_f": 1.0, "b_f": 1.0, "kappa": 10.0},
        fibres=fibres, fibre_rule=rule, angles=angles,
    )  # fmt: skip
    found = np.asarray(scene.tissue_at(scene.theta(alpha=30.0)).directions)
    np.testing.assert_allclose(found, np.broadcast_to([np.sqrt(0.75), 0.5, 0.0], found.shape))
    assert scene.load_parameters == ()


def test_angles_are_part_of_what_a_scene_is(turning):
    shares = dict(turning.angles[0].shares)
    other = replace(
        turning, angles=(FibreAngles(turning.angles[0].axis, {**shares, "inner": shares["outer"]}),)
    )
    assert other.fingerprint != turning.fingerprint
    back = replace(turning, angles=(FibreAngles(-turning.angles[0].axis, shares),))
    assert back.fingerprint != turning.fingerprint
    assert (
        replace(turning, angles=(FibreAngles(turning.angles[0].axis, shares),)).fingerprint
        == turning.fingerprint
    )


def test_a_finer_mesh_lays_them_anew(turning):
    fine = finer(turning).scene
    expected = Helix(("inner", "outer")).angles_in(fine.mesh)[0]
    np.testing.assert_allclose(fine.angles[0].axis, expected.axis)
    np.testing.assert_allclose(fine.angles[0].shares["inner"], expected.shares["inner"])
    with pytest.raises(InputError, match="without the rule that made them have no finer mesh"):
        mesh_error(replace(turning, fibre_rule=None))


@pytest.mark.parametrize(
    ("axis", "shares", "message"),
    [
        (2.0, {}, "axes of fibre angles are not unit vectors"),
        (1.0, {"inner": np.ones(3)}, r"share of fibre angle 'inner' has shape \(3,\)"),
        (1.0, {"b": None}, "'b'"),
        (1.0, {"inner": np.nan}, "share of fibre angle 'inner' .* is not finite"),
    ],
)
def test_angles_that_do_not_fit(turning, axis, shares, message):
    given = dict(turning.angles[0].shares)
    for name, share in shares.items():
        fits = given["inner"] if share is None else share * np.ones_like(given["inner"])
        given[name] = share if np.ndim(share) else fits
    with pytest.raises(InputError, match=message):
        replace(turning, angles=(FibreAngles(axis * turning.angles[0].axis, given),))


def test_a_law_without_fibres_has_nothing_to_turn(turning, beam):
    with pytest.raises(InputError, match="fibre angles turn fibres, and it has none"):
        replace(beam, angles=turning.angles)


def test_from_a_file(tmp_path):
    from emulator.geometry.generators.ellipsoid import human_ventricle
    from emulator.geometry.io import write_mesh

    mesh = human_ventricle(4, 8, 1)
    write_mesh(tmp_path / "heart.vtu", mesh)
    text = HEART.format(rule="helix", options='angles = ["inner", -60]')
    text = text.replace("lv_endocardium", "endocardium").replace("rv_endocardium", "epicardium")
    inner = '[parameters.inner]\nunit = "deg"\nrange = [40, 80]\n[parameters.pressure]'
    (tmp_path / "heart.toml").write_text(text.replace("[parameters.pressure]", inner))
    scene = find_scene(str(tmp_path / "heart.toml"))
    assert scene.parameter_names == ("inner", "pressure")
    found = np.asarray(scene.tissue_at(scene.theta(inner=60.0, pressure=1.0)).directions)
    laid = Helix((60.0, -60.0)).directions(scene.mesh)[0]
    np.testing.assert_allclose(found[:, 0], laid, atol=1e-12)
    (tmp_path / "heart.toml").write_text(text)
    with pytest.raises(InputError, match="needs 'inner'"):
        find_scene(str(tmp_path / "heart.toml"))


def test_without_fibres_angles_are_left_out(turning):
    for name, effect in effects_of(turning).items():
        without = effect.without
        assert bool(without.angles) == (without.fibres is not None), name
        assert ("inner" in without.parameter_names) == bool(without.angles), name


@pytest.mark.parametrize("transverse", [0.0, 0.3])
@pytest.mark.slow
def test_muscle_pulls_along_fibres_that_turn(turning, fixed, transverse):
    """Energy of elements against springs, its slope by an angle, and the force on a loaded mesh."""
    loads = (*fixed.loads, ActiveTension(20.0, transverse=transverse))
    pulled, known = (replace(each, loads=loads, origin={}) for each in (turning, fixed))
    theta, numbers = pulled.theta(**KNOWN, inner=63.0, outer=-51.0), known.theta(**KNOWN)
    u = 0.5 * jax.random.normal(jax.random.key(0), turning.held.shape) * ~turning.held
    energy, by_springs = potential_energy(pulled), potential_energy(known)
    assert energy(u, theta) == pytest.approx(float(by_springs(u, numbers)), rel=1e-12)
    force = jax.grad(by_springs)(u, numbers)
    np.testing.assert_allclose(jax.grad(energy)(u, theta), force, atol=1e-10 * jnp.abs(force).max())
    step = jnp.zeros(len(theta)).at[turning.parameter_names.index("inner")].set(0.01)
    slope = (energy(u, theta + step) - energy(u, theta - step)) / 0.02
    assert jax.grad(energy, 1)(u, theta) @ step / 0.01 == pytest.approx(float(slope), rel=1e-6)
    loaded, by_rows = (InverseSystem(each, "cholesky") for each in (known, pulled))
    w = 0.2 * u
    found = by_rows.external_force(w, theta)
    right = loaded.external_force(w, numbers)
    np.testing.assert_allclose(found, right, atol=1e-12 * jnp.abs(right).max())


@pytest.mark.slow
@pytest.mark.parametrize("angles", [("inner", "outer"), (63.0, -51.0)])
def test_one_of_two_bodies_contracts(angles):
    """The filling heart and the contracting one are where each is alone."""
    alone = em.scenes.left_ventricle(3, 6, 1, order=1, angles=angles)
    alone = replace(alone, loads=(*alone.loads, ActiveTension(10.0)), origin={})
    at_rest = replace(alone, loads=alone.loads[:1])
    bodies = em.side_by_side({"filling": alone.mesh, "systole": alone.mesh}, gap=20.0)
    sets = dict(bodies.mesh.facet_sets)
    for wall in ("endocardium", "epicardium"):
        sets[wall] = np.concatenate([sets[f"{name}.{wall}"] for name in bodies.names])
    mesh, rule = replace(bodies.mesh, facet_sets=sets), Helix(angles)
    cavities = (CavityPressure(f"{name}.endocardium") for name in bodies.names)
    both = replace(
        alone,
        mesh=mesh,
        fibres=rule.directions(mesh)[0],
        angles=rule.angles_in(mesh),
        loads=(*cavities, ActiveTension(10.0, within="systole")),
        supports=tuple(Support(f"{name}.base") for name in bodies.names),
        fibre_rule=rule,
    )
    values = {**KNOWN, **({"inner": 63.0, "outer": -51.0} if both.angles else {})}
    u = em.Simulator(both)(both.theta(**values))
    for name, scene in (("filling", at_rest), ("systole", alone)):
        right = em.Simulator(scene)(scene.theta(**values))
        np.testing.assert_allclose(u[bodies.nodes(name)], right, atol=1e-8)
    stress = element_fields(both, u, both.theta(**values))["cauchy_stress"]
    right = element_fields(alone, right, alone.theta(**values))["cauchy_stress"]
    np.testing.assert_allclose(stress[bodies.elements("systole")], right, atol=1e-6)


@pytest.mark.slow
def test_an_imaged_heart_contracts_along_fibres_that_turn(turning, fixed):
    """Equilibria are those of the same angles as numbers, slopes those of differences."""
    image = {"loaded_by": {"pressure": "imaged", "tension": "slack"}, "origin": {}}
    tension, hearts = Parameter("tension", "kPa", 0.0, 40.0), []
    for each in (turning, fixed):
        parameters = (*each.parameters, tension)
        constants = {**each.constants, "imaged": 0.8, "slack": 0.0}
        loads = (*each.loads, ActiveTension())
        hearts.append(
            replace(each, parameters=parameters, constants=constants, loads=loads, **image)
        )
    scene, known = hearts
    values = {**KNOWN, "pressure": 1.2, "tension": 12.0}
    theta = scene.theta(**values, inner=63.0, outer=-51.0)
    simulator = em.fem.Simulator(scene)
    v = simulator.solve(theta).require_converged().displacement
    np.testing.assert_allclose(v, em.fem.Simulator(known)(known.theta(**values)), atol=1e-8)
    slopes = simulator.sensitivities(v, theta)
    for name, width in (("inner", 0.05), ("tension", 0.01)):
        k = scene.parameter_names.index(name)
        step = jnp.zeros(len(theta)).at[k].set(width)
        by_difference = (simulator(theta + step) - simulator(theta - step)) / (2.0 * width)
        np.testing.assert_allclose(slopes[k], by_difference, atol=1e-6)
