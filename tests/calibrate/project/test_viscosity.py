"""Tables with times: what is proposed for them, what is read, and what is refused in one line."""

import numpy as np
import pytest

import calibrate as cal
import emulator as em
from calibrate.cli import main
from calibrate.measurements.data import read_measurements, write_data
from calibrate.project.experiment import read_experiment
from calibrate.project.specimen import draft_specimen
from emulator.core.errors import InputError
from emulator.scenes.file import read_scene

TIMES = np.concatenate([np.linspace(0.0, 1.0, 6), [2.0, 5.0, 20.0, 60.0], [60.5, 61.0]])
STRETCH = np.concatenate([np.linspace(1.0, 1.1, 6), np.full(4, 1.1), [1.05, 1.0]])


def table(times=TIMES, stretch=STRETCH, unit=" [s]", tests=None, branch=False):
    """A ramp, a hold and the way back, of a standard solid that is nearly right."""
    rows = [f"protocol,branch,time{unit},stretch_x,stress_x [kPa]"]
    for k, (t, x) in enumerate(zip(times, stretch, strict=True)):
        name = "one" if tests is None else tests[k]
        stress = 20.0 * (x - 1.0) * (0.5 + 0.5 * np.exp(-t / 10.0))
        way = "unloading" if branch and t > 60.0 else "loading"
        rows.append(f"{name},{way},{t:g},{x:.6g},{stress:.6g}")
    return "\n".join(rows) + "\n"


def drafted(tmp_path, text):
    (tmp_path / "t.csv").write_text(text)
    return draft_specimen(tmp_path / "t.csv", tmp_path / "t.toml")


def test_init_sees_a_hold_and_a_return_and_says_so(tmp_path):
    draft = drafted(tmp_path, table(branch=True))
    notes = "\n".join(draft.notes)
    assert "[viscosity] with 2 terms, a guess: rows 6 to 10 are a hold of 59 s; " in notes
    assert "test 'one' goes back; all rows are used, in the order of time" in notes
    assert "moduli are those of an instant change of shape" in notes
    assert "leave the hold out" not in notes
    assert "columns left out" not in notes
    scene = draft.scene
    assert scene.parameter_names == (
        "a", "b", "relaxation_1", "tau_1", "relaxation_2", "tau_2",
    )  # fmt: skip
    np.testing.assert_allclose(scene.times, TIMES)
    medians = [p.prior.median for p in scene.parameters if p.name.startswith("tau")]
    assert 0.2 < medians[0] < medians[1] < 61.0
    problem = read_experiment(draft.path)
    assert problem.data["stress"].shape == (12, 1)
    assert [q.name for q in scene.quantities.values()][-1] == "tau_2"


def test_times_may_be_in_minutes_and_rates_of_two_tests_differ(tmp_path):
    times, ramp = np.array([0.0, 1.0, 2.0]), np.array([1.0, 1.05, 1.1])
    text = table(np.append(times, 20.0 * times), np.tile(ramp, 2), " [min]", [*"aaabbb"])
    draft = drafted(tmp_path, text)
    assert "test 'a' is 20 times as fast as test 'b'" in "\n".join(draft.notes)
    assert "[viscosity] with 1 terms" in "\n".join(draft.notes)
    np.testing.assert_allclose(draft.scene.times[:3], [0.0, 60.0, 120.0])


@pytest.mark.parametrize(
    ("text", "note"),
    [
        (table(TIMES[:6], STRETCH[:6]), "no hold, no return and one rate"),
        (table(TIMES[:6][::-1], STRETCH[:6]), "row 2 of 'one': time goes back from 1 to 0.8 s"),
        (table(TIMES[:6] - 0.5, STRETCH[:6]), "row 1: time is -0.5 s"),
        (table(TIMES[:6], STRETCH[:6]).replace("0.2,", "12:00,"), "'12:00', not a number"),
    ],
)
def test_a_table_whose_times_say_nothing_is_elastic_as_ever(tmp_path, text, note):
    draft = drafted(tmp_path, text)
    (said,) = (line for line in draft.notes if note in line)
    assert said.startswith("no [viscosity]")
    assert any("columns left out: time" in line for line in draft.notes)
    assert draft.scene.viscosity is None
    assert "viscosity" not in draft.scene_path.read_text()
    problem = read_experiment(draft.path)
    assert problem.data["stress"].shape == (6, 1)


SCENE = """law = "neo_hookean_split"
specimen = "t.csv"
grips = "none"
constants = { kappa = 1e4 }
[viscosity]
[parameters.mu]
unit = "kPa"
range = [1.0, 50.0]
[parameters.relaxation_1]
range = [0.01, 0.99]
[parameters.tau_1]
unit = "s"
range = [0.1, 100.0]
"""


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("protocol,branch,time [s]", "protocol,branch,clock"), "no column 'time', which"),
        (("time [s]", "time [weeks]"), "unit 'weeks' is unknown; one of s, ms, min, h"),
        (("loading,0.4,", "loading,,"), "row 3, column 'time [s]' is empty"),
        (("loading,0.4,", "loading,nan,"), "row 3: time is nan s; give 0 or more"),
        (("loading,0.4,", "loading,0.1,"), "row 3 of 'one': time goes back from 0.2 to 0.1 s"),
        (("[0.01, 0.99]", "[0.01, 1.2]"), "'relaxation_1' ranges up to 1.2; it must stay below 1"),
        (("[0.1, 100.0]", "[0.0, 100.0]"), "'tau_1' ranges down to 0 s; it must stay above 0"),
        (
            ('unit = "s"', 'unit = "ms"'),
            "parameter 'tau_1' is in ms; the scene's Viscosity takes s",
        ),
        (
            ("[viscosity]\n", "[viscosity]\nterms = 2\n"),
            "the scene's Viscosity needs 'relaxation_2'",
        ),
        (("[viscosity]\n", "[viscosity]\nterms = 9\n"), "9 terms of kind 'prony'; give 1 to 6"),
        (("[viscosity]\n", '[viscosity]\nkind = "kelvin"\n'), "kind"),
        (("[viscosity]\n", ""), "row 11 of 'one' is nearer to rest than one before"),
    ],
)
def test_what_a_file_cannot_say_is_refused_in_one_line(tmp_path, words, message):
    text, scene = table(), SCENE
    assert words[0] in text + scene
    (tmp_path / "t.csv").write_text(text.replace(*words))
    (tmp_path / "t.toml").write_text(scene.replace(*words))
    with pytest.raises(InputError) as caught:
        read_scene(tmp_path / "t.toml")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_data_file_has_the_times_of_its_specimen(tmp_path):
    (tmp_path / "t.csv").write_text(table(branch=True))
    (tmp_path / "t.toml").write_text(SCENE)
    scene = read_scene(tmp_path / "t.toml")
    observe, data, _ = read_measurements(scene, tmp_path / "t.csv")
    part = observe.parts["stress"]
    assert part.curve_axis == "time in s"
    np.testing.assert_allclose(part.curves()["one stress_x"][0], TIMES)
    np.testing.assert_allclose(part.points[-1, 0], 0.2 + 1.0, atol=1e-12)
    write_data(tmp_path / "again.csv", observe, data)
    again = read_measurements(scene, tmp_path / "again.csv")[1]
    np.testing.assert_allclose(again["stress"], data["stress"])
    (tmp_path / "late.csv").write_text(table(TIMES + 1.0))
    with pytest.raises(InputError, match="times are not those of scene 't'"):
        read_measurements(scene, tmp_path / "late.csv")


IN_TIME = """
[inertia]
density = 1.2
[parameters.time]
unit = "s"
range = [0.0, 10.0]
[[supports]]
node_set = "left"
[[supports]]
kind = "dashpots"
facet_set = "right"
damping = 0.1
"""


def test_a_file_of_a_body_in_time_is_the_scene(tmp_path, capsys):
    em.write_mesh(tmp_path / "m.vtu", em.generators.box((2.0, 1.0, 1.0), (2, 1, 1)))
    text = SCENE.replace('specimen = "t.csv"\ngrips = "none"', 'mesh = "m.vtu"') + IN_TIME
    (tmp_path / "t.toml").write_text(text)
    scene = read_scene(tmp_path / "t.toml")
    assert (scene.viscosity.kind, scene.viscosity.count) == ("prony", 1)
    assert (scene.inertia.density, scene.inertia.spectral_radius) == (1.2, 0.8)
    assert scene.supports[1].damping == 0.1
    theta = scene.theta(mu=8.0, relaxation_1=0.5, tau_1=5.0, time=1.0)
    assert not em.Simulator(scene).path(theta[None]).status.any()
    values = ["mu=8", "relaxation_1=0.5", "tau_1=5", "time=1"]
    for words in (
        ["simulate", "--theta", *values, "--out", str(tmp_path / "out.vtu")],
        [
            "infer",
            "--truth",
            *values,
            "--observe",
            "nodes:3",
            "--noise",
            "displacement=0.1",
            "--out",
            str(tmp_path / "run"),
        ],
        ["train", "--out", str(tmp_path / "emulator")],
    ):
        assert main([words[0], str(tmp_path / "t.toml"), *words[1:]]) != 0
        said = capsys.readouterr().err.strip().splitlines()[-1]
        assert "goes through time: follow it by Simulator.path" in said
    for wrong, says in (
        (text.replace("density = 1.2", "density = -1"), "density is -1"),
        (text.replace("relaxation_1", "relaxation_2"), "relaxation_2"),
        (text.replace("[viscosity]\n", '[viscosity]\nkind = "kelvin"\n'), "kind"),
    ):
        (tmp_path / "t.toml").write_text(wrong)
        with pytest.raises(InputError, match=says):
            read_scene(tmp_path / "t.toml")


def test_stresses_of_two_scenes_are_those_of_their_times(tmp_path):
    (tmp_path / "t.csv").write_text(table())
    (tmp_path / "t.toml").write_text(SCENE)
    scene = read_scene(tmp_path / "t.toml")
    theta = scene.theta(mu=8.0, relaxation_1=0.5, tau_1=5.0)
    stress = cal.stresses(scene, "stress_x")
    P = np.asarray(stress(em.homogeneous(scene, incompressible=True)(theta), theta))[:, 0]
    assert P[5] == P.max()
    assert P[9] == pytest.approx(0.5 * 8.0 * (1.1 - 1.1**-2), rel=1e-3)  # relaxed
    assert P[-1] < -0.1  # it pushes where it was shortened to its length at rest
