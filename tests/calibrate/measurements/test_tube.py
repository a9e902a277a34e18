"""Tubes: closed forms of pressure and force, FEM of a real one, tables that are wrong."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import calibrate as cal
import emulator as em
from calibrate.measurements import observations_from_json, parse_observation
from calibrate.measurements.data import read_measurements, write_data
from emulator.core.errors import InputError
from emulator.geometry.generators.box import box
from emulator.scenes.supports.dirichlet import Support
from emulator.verify.homogeneous import SOLUTIONS

MU = 7.0
SECTOR = em.specimens.Tube(2.0, (0.8,), opening_angle=90.0, points=20)
COLUMNS = {"inner_radius": np.array([1.6, 2.0, 2.6, 3.2]), "stretch_axial": np.full(4, 1.3)}


def neo_hookean(tube, columns=COLUMNS, **entries):
    return em.specimen(
        columns,
        tube=tube,
        law=em.find_law("neo_hookean_split"),
        parameters=(em.Parameter("mu", "kPa", 1.0, 20.0),),
        **{"constants": {"kappa": 1e4}, **entries},
    )


def predicted(scene, theta=MU):
    forward, kinds = em.homogeneous(scene, incompressible=True), (cal.TubePressure, cal.TubeForce)

    @jax.jit
    def both(theta):
        u = forward(theta)
        return [kind(scene)(u, theta) for kind in kinds]

    return [np.asarray(values) for values in both(jnp.array([theta]))]


def closed_form(tube, columns):
    """Integrals over the loaded wall, by hand: R^2 = A + k l r^2 with A = Ri^2 - k l ri^2."""
    k, Ri, Ro = tube.closing, tube.inner_radius, tube.outer_radius
    ri, stretch = columns["inner_radius"], columns["stretch_axial"]
    ro = np.sqrt(ri**2 + (Ro**2 - Ri**2) / (k * stretch))
    A, log = Ri**2 - k * stretch * ri**2, np.log(ro / ri)
    through = A / 2.0 * (ri**-2.0 - ro**-2.0) + k * stretch * log
    pressure = MU * (k / stretch * np.log(Ro / Ri) - through / (k * stretch) ** 2)
    area = ro**2 - ri**2
    around = ((Ro**2 - Ri**2) - 2.0 * A * np.log(Ro / Ri)) / (2.0 * stretch**2)
    radial = (A * log + k * stretch * area / 2.0) / (k * stretch) ** 2
    return pressure, np.pi * MU * (stretch**2 * area - radial - around)


def test_a_thick_tube_of_neo_hooke_in_closed_form():
    for angle in (0.0, 90.0, -40.0):
        tube = replace(SECTOR, opening_angle=angle)
        expected = closed_form(tube, COLUMNS)
        for ours, by_hand in zip(predicted(neo_hookean(tube)), expected, strict=True):
            np.testing.assert_allclose(ours, by_hand, rtol=1e-12, atol=1e-12)


def test_layers_of_one_stiffness_are_one_layer_and_softer_ones_carry_less():
    layers = replace(SECTOR, layers=(0.5, 0.3))
    one = {"stiffness_1": 1.0, "kappa": 1e4}
    same = predicted(neo_hookean(layers, constants={**one, "stiffness_2": 1.0}))
    np.testing.assert_allclose(same, predicted(neo_hookean(SECTOR)), rtol=1e-12)
    half = predicted(neo_hookean(layers, constants={**one, "stiffness_2": 0.5}))
    inner = replace(layers, layers=(0.5,))  # what a layer of half the stiffness adds to the inner
    alone = predicted(neo_hookean(inner))
    np.testing.assert_allclose(2.0 * half[0] - alone[0], same[0], rtol=1e-10)


@pytest.mark.parametrize("law", ["holzapfel_gasser_ogden", "fung_orthotropic"])
def test_derivatives_are_those_of_differences_of_a_fibred_wall(law):
    law = em.find_law(law)
    values = {n: v for n, v in SOLUTIONS[law.name][1].items() if n != "kappa"}
    units = {q.name: q.unit for q in law.quantities}
    scene = em.specimen(
        {word: column[:3] for word, column in COLUMNS.items()},  # the fourth is 1e5 times stiffer
        tube=replace(SECTOR, points=5),
        law=law,
        parameters=tuple(em.Parameter(n, units[n], 0.5 * v, 2.0 * v) for n, v in values.items()),
        constants={"kappa": 100.0},
        fibres=[1.0, 0.0, 0.0],
        sheets=[0.0, 1.0, 0.0] if law.sheets else None,
    )
    forward, theta = em.homogeneous(scene, incompressible=True), jnp.array([*values.values()])
    kinds = [kind(scene) for kind in (cal.TubePressure, cal.TubeForce)]
    both = jax.jit(lambda t: jnp.stack([kind(forward(t), t) for kind in kinds]))
    slopes = jax.jit(jax.jacfwd(both))(theta)
    for k, step in enumerate(1e-5 * np.diag(np.asarray(theta))):
        differences = (both(theta + step) - both(theta - step)) / (2.0 * step[k])
        scale = float(jnp.abs(slopes[..., k]).max())
        np.testing.assert_allclose(slopes[..., k], differences, atol=1e-7 * scale, rtol=1e-7)
    batch = jax.vmap(both)(jnp.stack([theta, 1.1 * theta]))
    np.testing.assert_allclose(batch[1], both(1.1 * theta), rtol=1e-12)


def test_fem_of_a_quarter_of_the_tube_agrees():
    """A quarter of a cylinder between its ends, inflated by a follower pressure."""
    Ri, wall, length, stretch, kappa = 2.0, 0.8, 0.6, 1.2, 2e3
    blank = box((wall, 0.5 * np.pi, length), (4, 8, 1), order=2)
    R, turn, z = blank.nodes.T
    nodes = np.stack([(Ri + R) * np.cos(turn), (Ri + R) * np.sin(turn), z], axis=1)
    mesh = replace(blank, nodes=nodes)
    scene = em.Scene(
        name="quarter",
        mesh=mesh,
        law=em.find_law("neo_hookean_split"),
        parameters=(em.Parameter("mu", "kPa", 1.0, 20.0), em.Parameter("pressure", "kPa", 0.0, 4)),
        constants={"kappa": kappa},
        supports=(
            Support("front", components="y"),
            Support("back", components="x"),
            Support("bottom", components="z"),
            Support("top", [0.0, 0.0, length * (stretch - 1.0)], components="z"),
        ),
        loads=(em.loads.FollowerPressure("left"),),
        dilatation="mean",
    )
    simulator = em.Simulator(scene)
    theta = jnp.array([MU, 1.2])
    u = np.asarray(simulator.solve(theta).require_converged("quarter").displacement)
    inner = mesh.node_sets["left"]
    radii = np.linalg.norm((nodes + u)[inner, :2], axis=1)
    assert np.ptp(radii) < 2e-3
    tube = em.specimens.Tube(Ri, (wall,))
    columns = {"inner_radius": [radii.mean()], "stretch_axial": [stretch]}
    pressure, force = predicted(neo_hookean(tube, {k: np.array(v) for k, v in columns.items()}))
    np.testing.assert_allclose(pressure, 1.2, rtol=5e-3)
    # The reduced force is what the ends are held by, less the pressure on the cavity's section.
    held = 4.0 * np.asarray(simulator.reaction("top", u, theta))[2]
    np.testing.assert_allclose(force, held - 1.2 * np.pi * radii.mean() ** 2, rtol=1e-2)


def test_a_table_of_diameters_is_read_and_written(tmp_path):
    tube, radii = replace(SECTOR, points=5), COLUMNS["inner_radius"]
    k = tube.closing * COLUMNS["stretch_axial"]
    outer = np.sqrt(radii**2 + (tube.outer_radius**2 - tube.inner_radius**2) / k)
    scene = neo_hookean(tube)
    pressure, force = predicted(scene)
    path = tmp_path / "tube.csv"
    lines = ["outer_diameter [um],stretch_axial,pressure [mmHg],force_axial [g]"]
    rows = zip(
        2e3 * outer, COLUMNS["stretch_axial"], pressure / 0.133322, force / 9.80665, strict=True
    )
    path.write_text("\n".join([*lines, *(",".join(map(repr, map(float, r))) for r in rows)]))
    observe, data, _ = read_measurements(scene, path)
    np.testing.assert_allclose(data["tube_pressure"], pressure, rtol=1e-12)
    np.testing.assert_allclose(data["tube_force"], force, rtol=1e-12)
    assert observations_from_json(scene, observe.to_json()).shapes == observe.shapes
    assert list(parse_observation(scene, "tube_pressure+tube_force").parts) == list(observe.parts)
    write_data(tmp_path / "again.csv", observe, data)
    _, again, _ = read_measurements(scene, tmp_path / "again.csv")
    np.testing.assert_allclose(again["tube_force"], force, rtol=1e-12)


@pytest.mark.parametrize(
    ("columns", "told"),
    [
        ({"outer_radius": [0.5], "stretch_axial": [1.3]}, "no cavity"),
        ({"inner_radius": [2600.0], "stretch_axial": [1.3]}, "outside 0.1 to 12"),
        ({"inner_radius": [2.6]}, "give stretch_axial and one of"),
        ({"inner_radius": [2.6], "outer_radius": [3.0], "stretch_axial": [1.3]}, "one of"),
        ({"inner_radius [inch]": [2.6], "stretch_axial": [1.3]}, "unit 'inch' is unknown"),
        ({"inner_radius": [3.0, 2.5], "stretch_axial": [1.3, 1.3]}, "smaller radius"),
        ({"inner_radius": [np.nan], "stretch_axial": [1.3]}, "no cavity"),
    ],
)
def test_motions_that_no_tube_has_are_refused_in_one_line(columns, told):
    with pytest.raises(InputError, match=told) as error:
        SECTOR.states({word: np.array(values) for word, values in columns.items()})
    assert "\n" not in str(error.value)


def test_what_is_no_tube_is_refused():
    flat = em.specimen(
        {"stretch_x": np.array([1.1])},
        law=em.find_law("neo_hookean"),
        parameters=(em.Parameter("mu", "kPa", 1.0, 20.0),),
        constants={"lam": 10.0},
    )
    with pytest.raises(InputError, match="no tube"):
        cal.TubePressure(flat)
    with pytest.raises(InputError, match="is a tube"):
        cal.stresses(neo_hookean(replace(SECTOR, points=5)), "stress_x")
    for wrong in ({"inner_radius": 0.0}, {"layers": ()}, {"opening_angle": 400.0}, {"points": 1}):
        with pytest.raises(InputError, match="tube: "):
            replace(SECTOR, **wrong)


def test_a_column_pressure_beside_landmarks_is_no_tube(tmp_path):
    beam = em.scenes.once_clamped_beam(cells=(2, 1, 1), order=1)
    (tmp_path / "data.csv").write_text("node,ux,uy,uz,pressure\n3,0,0,0.1,2.0\n")
    observe, _, _ = read_measurements(beam, tmp_path / "data.csv")
    assert list(observe.parts) == ["displacement"]
