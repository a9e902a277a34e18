"""Stretches under load control: closed forms, tables, and what is read and written again."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import calibrate as cal
import emulator as em
from calibrate.measurements import observations_from_json, parse_observation
from calibrate.measurements.collection import observations
from calibrate.measurements.data import read_measurements, write_data
from calibrate.measurements.stretch import Stretch
from emulator.core.errors import InputError
from emulator.specimens.specimen import read_states, specimen
from specimen_support import together

S = np.linspace(1.0, 1.4, 5)
MU = 7.0


def neo_hookean(given, **entries):
    return specimen(
        given,
        law=em.find_law("neo_hookean_split"),
        parameters=(em.Parameter("mu", "kPa", 1.0, 20.0),),
        constants={"kappa": 100.0},
        **entries,
    )


def test_incompressible_neo_hooke_in_closed_form():
    # P = mu (s - s^-2) along one axis, mu (s - s^-5) along two; others keep the volume.
    # Pulls along all three axes: those of two less their mean pressure's, here mu s of one.
    two, x, y = MU * (S - S**-5.0), 2.0 * MU * S, 2.0 * MU / np.sqrt(S)
    tests = {
        "one": {"applied_y [Pa]": 1e3 * MU * (S - S**-2.0)},
        "two": {"applied_x": two, "applied_y [Pa]": 1e3 * two},
        "three": {"applied_x": x, "applied_y [Pa]": 1e3 * y, "applied_z": y},
    }
    scene, theta = neo_hookean(together(tests)), jnp.array([MU])
    u = em.homogeneous(scene, incompressible=True)(theta)
    stretches = 1.0 + np.asarray(u).reshape(-1, 3, 3).diagonal(axis1=1, axis2=2)
    one, two, three = (stretches[scene.states.protocols[test]] for test in tests)
    np.testing.assert_allclose(one, np.stack([S**-0.5, S, S**-0.5], axis=1), atol=1e-12)
    np.testing.assert_allclose(two[:, :2], np.stack([S, S], axis=1), atol=1e-12)
    mean = MU * (three[:, 0] ** 2 - three[:, 2] ** 2)
    np.testing.assert_allclose(x * three[:, 0] - y * three[:, 2] - mean, 0.0, atol=1e-11)
    observe = jax.jit(cal.stretches(scene, "stretch_z,stretch_x"))
    np.testing.assert_allclose(observe(u, theta), stretches[:, [2, 0]], atol=1e-15)


MIXED = """protocol,applied_x [MPa],strain_x [%],stretch_y,cauchy_y
creep,0,0,,
creep,0.002,5,,
creep,0.006,NA,,
strip,,0,1,0
strip,,10,1,3
"""


def test_stretches_are_data_where_a_stress_is_applied(tmp_path):
    (tmp_path / "table.csv").write_text(MIXED)
    scene = neo_hookean(read_states(tmp_path / "table.csv"))
    observe, data, _ = read_measurements(scene, tmp_path / "table.csv")
    assert observe.parts["stretch"].components == ("stretch_x",)
    np.testing.assert_allclose(data["stretch"][:, 0], [1.0, 1.05, np.nan, np.nan, np.nan])
    np.testing.assert_allclose(data["stress"][:, 0], [np.nan, np.nan, np.nan, 0.0, 3.0])
    sites = observe.sites("stretch")
    np.testing.assert_allclose(sites.positions[:, 0], [0.0, 1 / 3, 1.0, 0.0, 0.1])
    assert list(observe.parts["stretch"].curves(np.array([0, 1]))) == ["creep stretch_x"]
    u = np.asarray(em.homogeneous(scene)(jnp.array([MU])))
    theta = jnp.array([MU])
    for k, axis in enumerate("xy"):
        whole = Stretch.of(scene, f"stretch_{axis}")
        np.testing.assert_allclose(whole(u, theta)[:, 0], 1.0 + u[k::3, k])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("applied_x,stretch_x,stress_x\n0,1,0\n2,1.1,2\n", "column 'stress_x' is the stress of a"),
        ("applied_x,stretch_x\n0,1\n3,1.1\n", "row 2 moves otherwise"),
        ("applied_x\n0\n2\n", "column 'stretch_x' is missing"),
        ("applied_x,stretch_x\n0,\n2,\n", "every value of stretch is missing"),
        ("applied_x,stretch_x\n0,1\n2,x\n", "row 2, column 'stretch_x' is 'x'"),
    ],
)
def test_wrong_tables_are_refused_in_one_line(tmp_path, text, message):
    (tmp_path / "table.csv").write_text(text)
    scene = neo_hookean({"applied_x": np.array([0.0, 2.0])})
    with pytest.raises(InputError) as caught:
        read_measurements(scene, tmp_path / "table.csv")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_written_and_read_again(tmp_path):
    (tmp_path / "table.csv").write_text(MIXED)
    scene = neo_hookean(read_states(tmp_path / "table.csv"))
    observe = observations(cal.stretches(scene, "stretch_x,stretch_z"))
    values = np.stack([S, S], axis=1)
    values[3:] = np.nan  # prescribed along x, and free without a pull in tests without applied_z
    values[3:, 1] = S[3:]
    for name in ("data.csv", "data.nc"):
        write_data(tmp_path / name, observe, values)
        found, data, _ = read_measurements(scene, tmp_path / name)
        assert found.to_json() == observe.to_json()
        np.testing.assert_array_equal(data["stretch"], values)
    again = observations_from_json(scene, observe.to_json())
    assert again.parts["stretch"].components == ("stretch_x", "stretch_z")
    assert parse_observation(scene, "stretches:stretch_x").shapes == {"stretch": (5, 1)}
    with pytest.raises(InputError, match="stretch 'strain_x' is unknown; one of stretch_x"):
        parse_observation(scene, "stretches:strain_x")
