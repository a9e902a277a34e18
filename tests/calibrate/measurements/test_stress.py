"""Stresses of specimens: closed forms, measures, units, and tables that are wrong."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import emulator as em
from calibrate.measurements import observations_from_json, parse_observation
from calibrate.measurements.collection import observations
from calibrate.measurements.data import read_measurements, write_data
from calibrate.measurements.stress import Stress
from emulator.core.errors import InputError
from emulator.scenes.scene import all_nodes
from emulator.specimens.homogeneous import Homogeneous
from emulator.specimens.specimen import specimen
from emulator.specimens.states import states
from emulator.verify.homogeneous import tetrahedra
from specimen_support import together

S = np.linspace(1.0, 1.4, 5)
MU = 7.0


def neo_hookean(columns):
    return specimen(
        columns,
        law=em.find_law("neo_hookean_split"),
        parameters=(em.Parameter("mu", "kPa", 1.0, 20.0),),
        constants={"kappa": 100.0},
    )


def predicted(scene, components, theta=MU):
    """Return the stresses by test, each (k, c), and the displacement."""
    part, theta = Stress.of(scene, components), jnp.array([theta])
    u = Homogeneous(scene, all_nodes(scene), incompressible=True)(theta)
    stresses = np.asarray(jax.jit(part)(u, theta))
    return {test: stresses[rows] for test, rows in scene.states.protocols.items()}, np.array(u)


def test_incompressible_neo_hooke_in_closed_form():
    # The Cauchy stress less pressure is mu b; along one axis mu (s^2 - 1/s), along two
    # mu (s^2 - s^-4); sheared by g, mu g across and mu g^2 along, where z is free of stress.
    g, rest = np.linspace(0.0, 0.6, 4), np.ones(4)
    scene = neo_hookean(
        together(
            {
                "one": {"stretch_x": S},
                "two": {"stretch_x": S, "stretch_y": S},
                "held": {"stretch_x": S, "stretch_y": 0.0 * S + 1.0},
                "sheared": {"shear_xy": g, "stretch_x": rest, "stretch_y": rest},
            }
        )
    )
    found, _ = predicted(scene, "cauchy_x,cauchy_y,cauchy_xy,stress_xy,stress_x,second_x")
    cauchy, zero = MU * (S**2 - 1.0 / S), 0.0 * S
    for test, columns in {
        "one": [cauchy, zero, zero, zero, cauchy / S, cauchy / S**2],
        "two": [MU * (S**2 - S**-4.0)] * 2,
        "held": [MU * (S**2 - S**-2.0), MU * (1.0 - S**-2.0)],
        "sheared": [MU * g**2, 0.0 * g, MU * g, MU * g],
    }.items():
        expected = np.stack(columns, axis=1)
        np.testing.assert_allclose(found[test][:, : len(columns)], expected, atol=1e-12)


def test_all_six_shears_of_fibres_have_their_stress():
    """The energy's own derivative along each shear, of a law whose six shears differ."""
    planes = [(i, j) for i in range(3) for j in range(3) if i != j]
    words = ["xyz"[i] + "xyz"[j] for i, j in planes]
    held = [[a for a in "xyz" if a in word] for word in words]
    scene = specimen(
        together(
            {
                word: {f"shear_{word}": [0.1, 0.3], **{f"stretch_{a}": np.ones(2) for a in axes}}
                for word, axes in zip(words, held, strict=True)
            }
        ),
        law=em.find_law("holzapfel_ogden_orthotropic"),
        parameters=(em.Parameter("a", "kPa", 0.1, 2.0),),
        constants={
            "b": 7.0, "a_f": 15.0, "b_f": 15.0, "a_s": 2.0, "b_s": 10.0, "a_fs": 0.4,
            "b_fs": 9.0, "kappa": 50.0,
        },
        fibres=[1.0, 0.0, 0.0], sheets=[0.0, 1.0, 0.0],
    )  # fmt: skip
    found, u = predicted(scene, ",".join(f"stress_{word}" for word in words), 0.5)
    energy, step = densities(scene, jnp.array([0.5])), 1e-6
    for k, ((i, j), word) in enumerate(zip(planes, words, strict=True)):
        shear = np.zeros_like(u)
        shear[j::3, i] = step
        slope = (energy(u + shear) - energy(u - shear)) / (2.0 * step)
        rows = scene.states.protocols[word]
        np.testing.assert_allclose(found[word][:, k], slope[rows], rtol=1e-6)


def densities(scene, theta):
    """The energy density of each state, from FEM's potential of a tetrahedron alone."""
    body = tetrahedra(scene)
    count = len(body.mesh.elements)
    whole, volume = em.fem.strain_energy(body), body.discretisation.weights.sum() / count

    @jax.jit
    def of_each(u):
        at_corners = jnp.concatenate([jnp.zeros((count, 1, 3)), u.reshape(count, 3, 3)], axis=1)
        alone = jnp.eye(count)[:, :, None, None] * at_corners
        return jax.vmap(lambda x: whole(x.reshape(-1, 3), theta))(alone) / volume

    return lambda u: np.asarray(of_each(u))


def test_a_table_is_read_in_its_units(tmp_path):
    path = tmp_path / "table.csv"
    path.write_text(
        "strain_x [%];force_x [N];area_x [cm2];cauchy_y [MPa]\n0;0;0,2;0\n10;0,5;0,2;0,01\n"
        "20;1,5;0,2;NA\n"
    )
    scene = neo_hookean({"strain_x": np.array([0.0, 0.1, 0.2])})
    observe, data, _ = read_measurements(scene, path)
    (part,) = observe.parts.values()
    assert part.components == ("stress_x", "cauchy_y")
    expected = [[0.0, 0.0], [25.0, 10.0], [75.0, np.nan]]
    np.testing.assert_allclose(data["stress"], expected)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("stretch_x,stress_x\n1,0\n1.2,1\n", "2 rows say how the specimen moves"),
        ("stretch_x,stress_x\n1,0\n1.1,1\n1.3,2\n", "row 3 moves otherwise"),
        ("stretch_x,stress_x\n1,0\n1.1,-1\n1.2,-3\n", "pulls against the motion"),
        ("stretch_x,stress_x [furlong]\n1,0\n1.1,1\n1.2,2\n", "unit 'furlong' is unknown"),
        ("stretch_x,force_x\n1,0\n1.1,1\n1.2,2\n", "give the area at rest"),
        ("stretch_x\n1\n1.1\n1.2\n", "column 'stress_x' is missing"),
        ("stress_x\n1\n1.1\n1.2\n", "column 'stretch_x' is missing"),
        ("stretch_x,stress_x\n1,0\n1.1,inf\n1.2,2\n", "has an infinite value"),
        ("stretch_x,stress_x\n1,0\n1.1,x\n1.2,2\n", "row 2, column 'stress_x' is 'x'"),
        ("stretch_x,stress_x\n1,\n1.1,\n1.2,\n", "every value of stress is missing"),
    ],
)
def test_wrong_tables_are_refused_in_one_line(tmp_path, text, message):
    path = tmp_path / "table.csv"
    path.write_text(text)
    scene = neo_hookean({"stretch_x": np.array([1.0, 1.1, 1.2])})
    with pytest.raises(InputError) as caught:
        read_measurements(scene, path)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_written_and_read_again(tmp_path):
    columns = {"stretch_x": S, "stretch_y": np.array([1.0, 1.05, np.nan, np.nan, 1.1])}
    columns |= {"shear_xz": np.linspace(0.0, 0.2, 5)}
    scene = neo_hookean(states(columns, ordered=False))
    observe = observations(Stress.of(scene, "stress_x,cauchy_xz"))
    values = np.arange(10.0).reshape(5, 2)
    for name in ("data.csv", "data.nc"):
        write_data(tmp_path / name, observe, values)
        found, data, _ = read_measurements(scene, tmp_path / name)
        assert found.to_json() == observe.to_json()
        np.testing.assert_array_equal(data["stress"], values)
    again = observations_from_json(scene, observe.to_json())
    assert again.parts["stress"].components == ("stress_x", "cauchy_xz")
    assert parse_observation(scene, "stress:stress_x").shapes == {"stress": (5, 1)}
    with pytest.raises(InputError, match="stress 'pull_x' is unknown"):
        parse_observation(scene, "stress:pull_x")


def test_errors_correlate_along_a_curve_and_not_between_tests():
    given = states({"stretch_x": np.array([1.0, 1.1, 1.0, 1.3])}, ["a", "a", "b", "b"])
    observe = observations(Stress.of(neo_hookean(given), "stress_x,stress_y"))
    sites = observe.sites("stress")
    assert sites is not None
    np.testing.assert_allclose(sites.positions[::2, 0], [0.0, 0.1, 0.0, 0.3])
    assert len(np.unique(sites.positions[:, 1])) == 2
    np.testing.assert_array_equal(sites.component, [0, 1] * 4)


def test_a_direction_may_contract_while_it_is_pulled(tmp_path):
    text = "stretch_x,stretch_y,stress_x,stress_y\n1,1,0,0\n0.98,1.1,0.5,4\n0.97,1.2,1,9\n"
    (tmp_path / "table.csv").write_text(text)
    scene = neo_hookean(
        {"stretch_x": np.array([1.0, 0.98, 0.97]), "stretch_y": np.array([1.0, 1.1, 1.2])}
    )
    assert read_measurements(scene, tmp_path / "table.csv")[1]["stress"].shape == (3, 2)
    (tmp_path / "table.csv").write_text(text.replace(",4\n", ",-4\n").replace(",9\n", ",-9\n"))
    with pytest.raises(InputError, match="column 'stress_y' pulls against the motion"):
        read_measurements(scene, tmp_path / "table.csv")
