"""A body with its history as one problem: forces, derivatives, shorter steps, and bad tables."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import meshio
import numpy as np
import pytest

import calibrate as cal
import emulator as em
from calibrate.measurements.words import kinds_of
from emulator.core.errors import InputError
from emulator.fem.history import HistorySolver, half_steps_error, write_history
from emulator.scenes.file import read_scene
from history_support import BY_GRIP, CUBE, write_cube

TIMES = np.array([0.25, 0.5, 1.0, 2.0, 6.0])
OF_TISSUE = """
[constants]
kappa = 100.0
[parameters]
mu = {unit = "kPa", median = 8.0, log_sd = 0.7}
relaxation_1 = {range = [0.01, 0.99]}
tau_1 = {unit = "s", median = 2.0, log_sd = 1.0}
"""
PULLED = CUBE + OF_TISSUE
BY_LOAD = """
[[loads]]
kind = "dead_pressure"
facet_set = "right"
parameter = "pull"
"""
TABLE = "protocol,time [s],pull\n" + "".join(
    f"{name},{t / speed:g},{min(t, 1.0):g}\n" for name, speed in (("slow", 1), ("fast", 10))
    for t in TIMES
)  # fmt: skip


def written(folder, driven=BY_GRIP, table=TABLE, scene=PULLED):
    """The scene file of a cube that is pulled along x, beside its mesh and its history."""
    return write_cube(folder, scene.replace("[[supports]]", f"{driven}[[supports]]", 1), table)


@pytest.fixture(scope="module")
def pulled(tmp_path_factory):
    return read_scene(written(tmp_path_factory.mktemp("history")))


@pytest.fixture(scope="module")
def solver(pulled):
    return HistorySolver(pulled)


def observed(body, word):
    kind, *arguments = word.split(":")
    return kinds_of(body)[kind].of(body, *arguments)


THETA = {"mu": 8.0, "relaxation_1": 0.5, "tau_1": 2.0}


def test_the_force_of_a_grip_is_the_specimens_stress_in_both_tests(pulled, solver):
    theta = pulled.theta(**THETA)
    force = observed(pulled, "reaction:end:x")(solver(theta), theta)
    pieces = []
    for speed in (1.0, 10.0):
        piece = em.specimen(
            {"time": TIMES / speed, "stretch_x": 1.0 + 0.2 * np.minimum(TIMES, 1.0)},
            viscosity={"kind": "prony"},
            law=em.find_law("neo_hookean_split"),
            parameters=pulled.parameters,
            constants={"kappa": 100.0},
        )
        of_piece = cal.stresses(piece, "stress_x")(em.homogeneous(piece)(theta), theta)
        pieces.append(np.ravel(of_piece) * 1e-3)  # kPa on 1 mm2, in N
    np.testing.assert_allclose(force, np.concatenate(pieces), rtol=1e-9)
    length = observed(pulled, "length:left:end")
    stretched = 1.0 + 0.2 * np.minimum(TIMES, 1.0)
    np.testing.assert_allclose(length(solver(theta)[length.nodes], theta), np.tile(stretched, 2))


def test_derivatives_of_motion_and_force_are_differences(pulled, solver):
    theta = pulled.theta(**THETA)
    force, u = observed(pulled, "reaction:end:x"), solver(theta)
    du = solver.sensitivities(u, theta)
    slopes = jax.jacfwd(lambda t: force(u + jnp.tensordot(t - theta, du, 1), t))(theta)
    for k, value in enumerate(theta):
        step = jnp.zeros(len(theta)).at[k].set(1e-4 * value)
        after, before = solver(theta + step), solver(theta - step)
        by_step = (after - before) / (2e-4 * value)
        np.testing.assert_allclose(du[k], by_step, atol=1e-6 * np.abs(by_step).max() + 1e-12)
        by_step = (force(after, theta + step) - force(before, theta - step)) / (2e-4 * value)
        np.testing.assert_allclose(slopes[:, k], by_step, atol=1e-6 * np.abs(by_step).max())


@pytest.mark.parametrize("inertia", [False, True])
def test_a_support_bears_the_load_at_every_row(tmp_path, inertia):
    scene = PULLED + ("[inertia]\ndensity = 1.05\n" if inertia else "")
    body = read_scene(written(tmp_path, BY_LOAD, scene=scene))
    theta = body.theta(**THETA)
    force = observed(body, "reaction:left:x")(HistorySolver(body)(theta), theta)
    load = 1e-3 * body.known["pull"]
    np.testing.assert_allclose(force, load, rtol=1e-3 if inertia else 1e-9)
    # A milligram within tenths of a second is felt by one part in ten thousand, the faster the more.
    felt = np.abs(force / load - 1.0)[[1, 6]]
    assert (1e-8 < felt[0] < 0.1 * felt[1]) == inertia


def test_springs_and_a_grip_bear_the_load_together(tmp_path):
    spring = """
[[supports]]
kind = "elastic"
facet_set = "right"
stiffness = 3.0
"""
    table = TABLE.replace("pull", "push")
    scene = PULLED + "[[loads]]\nkind = 'dead_pressure'\nfacet_set = 'right'\nparameter = 'push'\n"
    body = read_scene(written(tmp_path, spring, table, scene))
    theta, solver = body.theta(**THETA), HistorySolver(body)
    u = solver(theta)
    moved = observed(body, "length:left:end")
    moved = moved(u[moved.nodes], theta) - 1.0
    by_springs, by_grip = (observed(body, f"reaction:{s}:x")(u, theta) for s in ("right", "left"))
    np.testing.assert_allclose(by_springs, -3e-3 * moved, rtol=2e-3)  # the face tilts a little
    np.testing.assert_allclose(by_springs + by_grip, 1e-3 * body.known["push"], rtol=1e-9)


def test_steps_half_as_long_have_the_rows_between(pulled, solver):
    halved, theta = pulled.halved, pulled.theta(**THETA)
    np.testing.assert_allclose(halved.times[1::2], pulled.times)
    slow = halved.tests["slow"]
    np.testing.assert_allclose(halved.times[slow][:4], [0.125, 0.25, 0.375, 0.5])
    np.testing.assert_allclose(halved.known["pull"][slow][:4], [0.125, 0.25, 0.375, 0.5])
    u = solver(theta)
    first = half_steps_error(pulled, u, theta)
    second = half_steps_error(halved, HistorySolver(halved)(theta), theta)
    assert 0.0 < second < 0.3 * first  # of second order: a quarter


def test_what_is_known_is_the_problems_identity(pulled):
    later = pulled.known | {"time": 1.1 * pulled.times}
    further = pulled.known | {"pull": 1.1 * pulled.known["pull"]}
    together = {"": np.arange(5)} | {"b": np.arange(5, 10)}
    others = [
        replace(pulled, known=later),
        replace(pulled, known=further),
        replace(pulled, scene=replace(pulled.scene, constants={"kappa": 90.0})),
        replace(pulled, tests={"": np.array([0, 1, 5, 6, 7]), "b": np.array([2, 3, 4, 8, 9])}),
        pulled.halved,
    ]
    assert len({body.fingerprint for body in (pulled, *others)}) == 1 + len(others)
    assert replace(pulled, tests=together, name="b").fingerprint == pulled.fingerprint


def test_a_history_is_written_for_players(pulled, solver, tmp_path):
    listing = write_history(tmp_path / "a.vtu", pulled, solver(pulled.theta(**THETA)))
    assert listing.read_text().count("<DataSet") == 10
    last = meshio.read(tmp_path / "a_10.vtu")
    assert np.abs(last.point_data["displacement"]).max() > 0.19


@pytest.mark.parametrize(
    ("old", "new", "fault"),
    [
        ("time [s]", "t", "no column 'time', which viscosity needs"),
        ("time [s]", "time [fortnight]", "unit 'fortnight' is unknown"),
        ("slow,2,", "slow,0.3,", "time goes back from 1 to 0.3 s"),
        ("slow,2,1", "slow,2,", "row 4, column 'pull' is empty"),
        ("slow,2,1", "slow,2,far", "row 4, column 'pull' is 'far', not a number"),
        ("slow,2,", ",2,", "row 4, column 'protocol' is empty"),
        ("slow,0.25", "slow,-0.25", "row 1: time is -0.25 s"),
        (",pull", ",pulls", "needs 'pull'"),
    ],
)
def test_bad_histories_are_refused_in_one_line(tmp_path, old, new, fault):
    assert old in TABLE
    with pytest.raises(InputError) as caught:
        read_scene(written(tmp_path, table=TABLE.replace(old, new)))
    assert fault in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("old", "new", "fault"),
    [
        ('viscosity = {kind = "prony"}\n', "", "nothing in it depends on time"),
        ("history.csv", "none.csv", "none.csv"),
        ("[parameters]", '[parameters]\npull = {range = [0, 1]}', "a column of history.csv"),
        ('mesh = "cube.vtu"', 'specimen = "history.csv"', "a specimen has none"),
    ],
)  # fmt: skip
def test_scenes_that_do_not_fit_a_history_are_refused(tmp_path, old, new, fault):
    path = written(tmp_path, scene=PULLED.replace(old, new))
    with pytest.raises((InputError, OSError)) as caught:
        read_scene(path)
    assert fault in str(caught.value)
