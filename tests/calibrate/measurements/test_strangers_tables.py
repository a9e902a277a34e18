"""Tables of tests as people save them: read, or refused in a line that says what would be right."""

import numpy as np
import pytest

from calibrate.cli import main
from calibrate.measurements.data import read_measurements
from calibrate.project import calibration
from calibrate.project.specimen import draft_specimen
from emulator.core.cells import read_cells
from emulator.core.errors import InputError
from emulator.scenes.file import read_scene
from emulator.specimens.specimen import read_states
from emulator.specimens.tube import Tube

STRETCH = np.linspace(1.0, 1.2, 30)
STRESS = 10.0 * (STRETCH - STRETCH**-2)


def table(path, header, *columns):
    rows = [",".join(map(str, row)) for row in zip(*columns, strict=True)]
    path.write_text("\n".join([header, *rows, ""]))
    return path


def draft(tmp_path, header, *columns, **options):
    source = table(tmp_path / "test.csv", header, *columns)
    return draft_specimen(source, tmp_path / "x.toml", **options)


def refusal(tmp_path, header, *columns, **options):
    with pytest.raises(InputError) as caught:
        draft(tmp_path, header, *columns, **options)
    assert len(str(caught.value).splitlines()) == 1
    assert not list(tmp_path.glob("*.toml"))
    return str(caught.value)


@pytest.mark.parametrize("unit", ["N/mm2", "MPa", "N/mm^2", "MPA", "N/mm²"])
def test_units_of_stress_are_those_of_machines(tmp_path, unit):
    path = table(tmp_path / "t.csv", f"stretch_x,stress_x [{unit}]", STRETCH, 1e-3 * STRESS)
    draft_specimen(path, tmp_path / "x.toml")
    _, data, _ = read_measurements(read_scene(tmp_path / "x_scene.toml"), path)
    np.testing.assert_allclose(data["stress"].ravel(), STRESS, rtol=1e-9)


def test_markers_that_go_back_by_their_noise_are_loading_and_dense_cycles_are_not(tmp_path):
    noise = 0.0015 * np.random.default_rng(0).normal(size=60)
    noisy = np.linspace(1.0, 1.15, 60) + noise
    assert "60 states" in draft(tmp_path, "stretch_x,stress_x", noisy, noisy - 1.0).notes[0]
    way = 1.0 + 0.1 * np.sin(np.linspace(0.0, 3.0 * np.pi, 720)) ** 2
    (tmp_path / "x.toml").unlink()
    (tmp_path / "x_scene.toml").unlink()
    assert "nearer to rest than one before" in refusal(
        tmp_path, "stretch_x,stress_x", way, way - 1.0
    )
    tube = Tube(0.36, (0.1,))
    words = "inner_radius,stretch_axial,pressure"
    radius = 0.4 + 0.2 * (way - 1.0)
    told = refusal(tmp_path, words, radius, np.full(720, 1.2), way - 1.0, tube=tube)
    assert "smaller radius than one before" in told


def test_a_strain_of_more_than_one_says_whether_it_is_in_percent(tmp_path):
    strain = np.linspace(0.0, 3.8, 30)
    told = refusal(tmp_path, "strain_x,stress_x", strain, strain)
    assert "'strain_x [%]' if it is in percent, 'strain_x [-]' if it is not" in told
    notes = draft(tmp_path, "strain_x [-],stress_x", strain, strain).notes
    assert {"stretch_x from 1 to 4.8", "stress reaches 3.8 kPa"} < set(notes)
    reached = [read_states(table(tmp_path / "u.csv", f"strain_x [{unit}],stress_x", strain, strain))
               .gradients[-1, 0, 0] for unit in ("%", "-")]  # fmt: skip
    np.testing.assert_allclose(reached, [0.038, 3.8])


def test_one_measurement_counts_once(tmp_path):
    told = refusal(
        tmp_path, "stretch_x,stress_x [kPa],cauchy_x [kPa]", STRETCH, STRESS, STRESS * STRETCH
    )
    assert "columns 'stress_x [kPa]' and 'cauchy_x [kPa]' both have a stress of row 1" in told
    told = refusal(tmp_path, "stretch_x,stress_x [kPa],stress_x [MPa]", STRETCH, STRESS, STRESS)
    assert "would count twice" in told
    tests = np.repeat(["a", "b", "c"], 30)
    again = np.tile(STRETCH, 3), np.tile(STRESS, 3)
    told = refusal(tmp_path, "protocol,stretch_x,stress_x", tests, *again)
    assert "tests 'a' and 'b' have the same 30 rows" in told
    noise = 0.01 * np.arange(90)
    draft(tmp_path, "protocol,stretch_x,stress_x", tests, again[0], again[1] + noise)
    # Two measures of a stress in rows of their own are two measurements.
    (tmp_path / "x.toml").unlink()
    (tmp_path / "x_scene.toml").unlink()
    first = [*STRESS[:15], *[""] * 15], [*[""] * 15, *STRESS[15:]]
    draft(tmp_path, "stretch_x,stress_x,cauchy_x", STRETCH, *first)


HALF = [""] * 30


@pytest.mark.parametrize(
    ("columns", "first", "second"),
    [
        ("stress_x [kPa],cauchy_x [kPa]", (STRESS, HALF), (HALF, STRESS * STRETCH)),
        ("stress_x [kPa],second_x [kPa]", (STRESS, HALF), (HALF, STRESS / STRETCH)),
        ("stress_x [kPa],stress_x [MPa]", (STRESS, HALF), (HALF, 1e-3 * STRESS)),
        ("stress_x [kPa]", (STRESS,), (np.round(STRESS, 4),)),
        ("stress_x [kPa]", (STRESS,), (np.append(STRESS[:-3], [50.0, 60.0, 70.0]),)),
    ],
)
def test_one_measurement_under_two_names_counts_once(tmp_path, columns, first, second):
    """As two stresses, in two units, with fewer digits; one that ends elsewhere is another."""
    tests = np.repeat(["a", "b"], 30)
    both = [np.concatenate(pair) for pair in zip(first, second, strict=True)]
    header = f"protocol,stretch_x,{columns}"
    if second[0][-1] == 70.0:
        draft(tmp_path, header, tests, np.tile(STRETCH, 2), *both)
        return
    told = refusal(tmp_path, header, tests, np.tile(STRETCH, 2), *both)
    assert "tests 'a' and 'b' have the same" in told


def test_a_test_without_its_last_rows_and_rows_that_are_there_twice(tmp_path):
    tests = ["a"] * 30 + ["b"] * 25
    pulls, stresses = np.append(STRETCH, STRETCH[:25]), np.append(STRESS, STRESS[:25])
    told = refusal(tmp_path, "protocol,stretch_x,stress_x", tests, pulls, stresses)
    assert "tests 'a' and 'b' have the same 25 rows" in told
    told = refusal(tmp_path, "stretch_x,stress_x", np.repeat(STRETCH, 2), np.repeat(STRESS, 2))
    assert "the table has its rows twice" in told
    # Two specimens in one machine: the same stretches, noise of a thousandth.
    noise = 1e-3 * STRESS.max() * np.random.default_rng(0).normal(size=60)
    tests, again = np.repeat(["a", "b"], 30), np.tile(STRESS, 2) + noise
    draft(tmp_path, "protocol,stretch_x,stress_x", tests, np.tile(STRETCH, 2), again)


def test_tests_in_two_units_are_both_read(tmp_path):
    stress = STRESS + 0.1 * np.random.default_rng(0).normal(size=30)
    both = np.concatenate([STRESS, HALF]), np.concatenate([HALF, 1e-3 * stress])
    path = table(
        tmp_path / "t.csv", "protocol,stretch_x,stress_x [kPa],stress_x [MPa]",
        np.repeat(["a", "b"], 30), np.tile(STRETCH, 2), *both,
    )  # fmt: skip
    draft_specimen(path, tmp_path / "x.toml")
    _, data, _ = read_measurements(read_scene(tmp_path / "x_scene.toml"), path)
    np.testing.assert_allclose(data["stress"].ravel(), np.append(STRESS, stress), rtol=1e-9)


def test_columns_of_other_conventions_are_named(tmp_path):
    told = refusal(tmp_path, "stretch_x,sigma_xx [kPa]", STRETCH, STRESS)
    assert "'stress_x' is missing in columns stretch_x, sigma_xx [kPa]" in told
    assert told.endswith("call sigma_xx [kPa] cauchy_x [kPa] if they are that")
    tube = Tube(0.36, (0.1,))
    radius = np.linspace(0.4, 0.5, 30)
    words = "OD (mm),lambda_z,P (mmHg)"
    told = refusal(tmp_path, words, 2.0 * radius, np.full(30, 1.2), STRESS, tube=tube)
    assert "OD (mm) outer_diameter [mm], lambda_z stretch_axial, P (mmHg) pressure [mmHg]" in told
    words = "inner_radius,stretch_axial,pressure [mmHg],pressure [kPa]"
    columns = radius, np.full(30, 1.2), STRESS, STRESS
    told = refusal(tmp_path, words, *columns, tube=tube)
    assert "pressure [mmHg], pressure [kPa]: each is the pressure of a row" in told


def test_spreadsheets_leave_empty_rows_and_columns(tmp_path):
    text = "stretch_x,stress_x,\n" + "".join(
        f"{a},{b},\n" for a, b in zip(STRETCH, STRESS, strict=True)
    )
    (tmp_path / "t.csv").write_text(text + ",,\n,,\n")
    cells = read_cells(tmp_path / "t.csv")
    assert (list(cells.words), len(cells.rows)) == (["stretch_x", "stress_x"], 30)
    assert "30 states" in draft_specimen(tmp_path / "t.csv", tmp_path / "x.toml").notes[0]


def test_a_shear_may_begin_at_zero_and_a_row_without_any_motion_may_not(tmp_path):
    shear = np.linspace(0.0, 0.4, 30)
    assert "30 states" in draft(tmp_path, "shear_xy,stress_xy", shear, 3.0 * shear).notes[0]
    (tmp_path / "x.toml").unlink()
    (tmp_path / "x_scene.toml").unlink()
    told = refusal(tmp_path, "shear_xy,stress_xy", ["", *shear[1:]], 3.0 * shear)
    assert "row 1 has no stretch and no shear" in told


def test_what_goes_through_rest_or_only_unloads_is_named(tmp_path):
    sweep = np.linspace(0.9, 1.1, 21)
    told = refusal(tmp_path, "stretch_x,stress_x", sweep, sweep - 1.0)
    assert "go through rest" in told
    told = refusal(tmp_path, "branch,stretch_x,stress_x", ["unloading"] * 30, STRETCH, STRESS)
    assert "each row is unloading" in told


def test_columns_of_another_convention_are_named(tmp_path):
    told = refusal(tmp_path, "lambda_x,sigma_xx [MPa]", STRETCH, STRESS)
    assert "call lambda_x stretch_x, sigma_xx [MPa] cauchy_x [MPa]" in told
    told = refusal(tmp_path, "Elongation (mm),Load (N)", STRETCH, STRESS)
    assert "Elongation (mm) over the length at rest is strain_x [-]" in told
    assert "it has Elongation (mm), Load (N)" in told
    told = refusal(tmp_path, "E_xx,S_xx (MPa),log strain", STRETCH - 1.0, STRESS, STRETCH - 1.0)
    assert "call E_xx green_x, S_xx (MPa) second_x [MPa] if they are that; log strain is" in told
    words = "Outer Diameter (µm),Axial stretch,Pressure (mmHg)"
    told = refusal(tmp_path, words, STRETCH, STRETCH, STRESS, tube=Tube(0.4, (0.1,)))
    assert "call Outer Diameter (µm) outer_diameter [µm], Axial stretch stretch_axial" in told


def test_a_row_of_units_is_read_and_rows_that_are_no_data_are_refused_or_left_out(tmp_path):
    rows = [f"{a},{b}" for a, b in zip(STRETCH, 1e-3 * STRESS, strict=True)]
    text = "\n".join(["stretch_x,stress_x", "(mm/mm),(MPa)", *rows[:9], ",", *rows[9:], ""])
    (tmp_path / "t.csv").write_text(text)
    draft_specimen(tmp_path / "t.csv", tmp_path / "x.toml")
    _, data, _ = read_measurements(read_scene(tmp_path / "x_scene.toml"), tmp_path / "t.csv")
    np.testing.assert_allclose(data["stress"].ravel(), STRESS, rtol=1e-9)
    # Rows are counted as in the file, from 1 below the header.
    (tmp_path / "t.csv").write_text(text + rows[3] + "\n")
    with pytest.raises(InputError, match=r"row 33 is nearer to rest than one before: rows of"):
        read_states(tmp_path / "t.csv")
    (tmp_path / "t.csv").write_text(text + "stretch_x,stress_x\n" + rows[0] + "\n")
    with pytest.raises(InputError, match="row 33 has the names of columns again"):
        read_states(tmp_path / "t.csv")


def test_missing_is_a_dash_too_and_marks_of_thousands_are_named(tmp_path):
    assert (
        "30 states" in draft(tmp_path, "stretch_x,stress_x", STRETCH, ["-", *STRESS[1:]]).notes[0]
    )
    (tmp_path / "t.csv").write_text('stretch_x,stress_x [Pa]\n1,0\n1.1,"1,185"\n')
    with pytest.raises(InputError, match="'1,185', not a number: leave out marks of thousands"):
        draft_specimen(tmp_path / "t.csv", tmp_path / "y.toml")
    (tmp_path / "t.xls").write_text("")
    with pytest.raises(InputError, match="is a spreadsheet; save it as CSV"):
        draft_specimen(tmp_path / "t.xls", tmp_path / "y.toml")


def test_a_hold_is_said_and_a_test_from_its_end_is_reversed(tmp_path):
    stretch = np.concatenate([STRETCH, np.full(9, STRETCH[-1])])
    stress = np.concatenate([STRESS, STRESS[-1] * np.linspace(0.97, 0.7, 9)])
    (hold,) = [
        n for n in draft(tmp_path, "stretch_x,stress_x", stretch, stress).notes if "hold" in n
    ]
    assert hold.startswith("CHANGE: rows 30 to 39 hold one state, in which stress goes from")
    for file in tmp_path.glob("*.toml"):
        file.unlink()
    told = refusal(tmp_path, "stretch_x,stress_x", STRETCH[::-1], STRESS[::-1])
    assert "reverse the rows of a test that was recorded while it unloads" in told
    tube = Tube(0.36, (0.1,))
    radius, words = 0.4 + 0.2 * (STRETCH - 1.0), "inner_radius,stretch_axial,pressure"
    told = refusal(tmp_path, words, radius[::-1], np.full(30, 1.2), STRESS[::-1], tube=tube)
    assert "reverse the rows" in told


def test_a_dense_table_has_no_holds(tmp_path):
    stretch = np.linspace(1.0, 1.3, 1600)
    stress = 30.0 * (stretch - 1.0) + np.random.default_rng(0).normal(size=1600)
    notes = draft(tmp_path, "stretch_x,stress_x", stretch, stress).notes
    assert not any("hold one state" in note for note in notes)
    (tmp_path / "read").mkdir()  # to three digits, of a small pull
    pulls = np.round(1.0 + np.linspace(0.0, 0.02, 60), 3)
    read = draft(tmp_path / "read", "stretch_x,stress_x", pulls, np.linspace(0.0, 5.0, 60)).notes
    assert not any("hold one state" in note for note in read)
    (said,) = [note for note in notes if "minutes" in note]
    assert said.startswith("1600 states take some 10 minutes to sample and certify, in proportion")
    assert "the means of 6 neighbouring rows" in said
    (tmp_path / "few").mkdir()
    few = draft(tmp_path / "few", "stretch_x,stress_x", stretch[::8], stress[::8]).notes
    assert not any("minutes" in note for note in few)


def test_inference_of_a_long_table_says_how_long_it_takes_before_it_begins(
    tmp_path, capsys, monkeypatch
):
    def no_sampling(*arguments, **options):
        raise InputError("sampling begins")

    monkeypatch.setattr(calibration, "sample", no_sampling)
    stretch = np.linspace(1.0, 1.3, 600)
    draft(tmp_path, "stretch_x,stress_x", stretch, 30.0 * (stretch - 1.0))
    assert main(["infer", str(tmp_path / "x.toml"), "--out", str(tmp_path / "run")]) == 2
    said = capsys.readouterr().err.splitlines()
    assert said[-2].startswith("600 states take some 4 minutes to sample and certify")
    assert "sampling begins" in said[-1]


def test_a_tube_s_axial_stretch_is_said_and_what_no_tube_under_pressure_is_is_asked(tmp_path):
    radius, words = np.linspace(0.4, 0.5, 30), "inner_radius [mm],stretch_axial,pressure"

    def notes(scale, *columns, more=""):
        for file in tmp_path.glob("*.toml"):
            file.unlink()
        tube = Tube(0.36, (0.1,))
        return " ".join(draft(tmp_path, words + more, scale * radius, *columns, tube=tube).notes)

    held = np.full(30, 1.2), STRESS
    told = notes(1.0, *held)
    assert "stretch_axial is 1.2 wherever it is prescribed" in told
    assert "one axial stretch and no force_axial" in told
    assert "no artery" not in told
    assert "no force_axial" not in notes(1.0, *held, STRESS, more=",force_axial")
    assert "no force_axial" not in notes(1.0, np.linspace(1.0, 1.2, 30), STRESS)
    told = notes(0.3, *held)
    assert "CHANGE: the inside is 0.36 to 0.44 times as long around as in the sector, which" in told
    assert "which no artery" in notes(5.0, *held)
    # A stretched tube without pressure is thinner, and that is right.
    assert "no artery" not in notes(0.75, np.full(30, 1.6), STRESS)


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("stretch_x;stress_x\n1;0\n1,1;1,234\n1,2;987.6\n", "'1,1' and row 3"),
        ("stretch_x,stress_x\n1,0\n1.1,5_7\n", "'5_7', not a number"),
    ],
)
def test_numbers_that_may_be_two_are_refused(tmp_path, text, line):
    (tmp_path / "t.csv").write_text(text)
    with pytest.raises(InputError, match=line):
        draft_specimen(tmp_path / "t.csv", tmp_path / "x.toml")


def test_volumes_pressures_and_places_may_have_units(tmp_path, ventricle):
    own = "volume,known:pressure\n0.118,0.68\n0.1225,0.84\n"
    (tmp_path / "kpa.csv").write_text(own)
    text = "volume [mm3],known:pressure [mmHg]\n118.0,{!r}\n122.5,{!r}\n"
    (tmp_path / "mmhg.csv").write_text(text.format(0.68 / 0.133322, 0.84 / 0.133322))
    (_, data, known), (_, other, again) = (
        read_measurements(ventricle, tmp_path / f"{name}.csv") for name in ("kpa", "mmhg")
    )
    assert known == pytest.approx(again)
    assert data.keys() == other.keys()
    for name, values in data.items():
        np.testing.assert_allclose(values, other[name], rtol=1e-12)
    (tmp_path / "plain.csv").write_text(text.replace("known:", "").format(0.68 / 0.133322, 6.3))
    _, _, plain = read_measurements(ventricle, tmp_path / "plain.csv")
    assert plain["pressure@1"] == pytest.approx(0.68)
    (tmp_path / "bad.csv").write_text("volume,pressure,known:pressure\n118.0,0.68,0.6\n")
    with pytest.raises(InputError, match="column 'known:pressure' is there twice"):
        read_measurements(ventricle, tmp_path / "bad.csv")
    (tmp_path / "bad.csv").write_text("volume,LVP\n118.0,0.68\n122.0,0.8\n")
    with pytest.raises(InputError, match="one, in mL; rows of a loading curve have a column 'pr"):
        read_measurements(ventricle, tmp_path / "bad.csv")
    (tmp_path / "bad.csv").write_text("volume [pt],known:pressure\n118.0,0.68\n")
    with pytest.raises(
        InputError, match=r"column 'volume \[pt\]': unit 'pt' is unknown; one of mL"
    ):
        read_measurements(ventricle, tmp_path / "bad.csv")


@pytest.mark.parametrize("seed", range(24))
def test_a_small_pull_beside_its_noise_is_loading_and_a_branch_of_some_rows_is_not(tmp_path, seed):
    """Noise of 4 % of the pull, by marker or load cell; the branch goes back by a third or more."""
    rng = np.random.default_rng(seed)
    count, share = int(rng.integers(12, 240)), 0.04
    way = np.linspace(0.0, 1.0, count) ** rng.choice([0.5, 1.0, 2.0])
    rows = int(rng.integers(5, 9))
    branch = np.append(way, 1.0 - rng.uniform(0.35, 0.7) * np.arange(1, rows + 1) / rows)
    way, branch = (w + share * rng.normal(size=len(w)) for w in (way, branch))
    for header, scale in (("stretch_x", 0.05), ("applied_x [kPa],stretch_x", 2.0)):
        for file in tmp_path.glob("*.toml"):
            file.unlink()
        rest = float(header == "stretch_x")
        stress = "stress_x," if rest else ""
        columns = [rest + scale * w for w in (way, branch)]
        names = f"{header},{stress}".removesuffix(",")
        told = refusal(tmp_path, names, columns[1], 1.0 + 0.1 * branch)
        assert "unloading goes under 'unloading'" in told
        assert f"{count} states" in draft(tmp_path, names, columns[0], 1.0 + 0.1 * way).notes[0]


@pytest.mark.parametrize("period", [4, 5, 6, 8])
def test_cycles_of_few_rows_are_no_noise(tmp_path, period):
    """Five cycles back to 70 % of the largest pull, some rows each."""
    phase = np.arange(5 * period) % period / period
    way = np.append(np.linspace(0.0, 1.0, 8)[:-1], 0.7 + 0.3 * np.abs(2.0 * phase - 1.0))
    told = refusal(tmp_path, "stretch_x,stress_x", 1.0 + 0.2 * way, way)
    assert "than one before" in told


def test_two_tests_in_one_table_and_sweeps_of_a_load_get_their_own_words(tmp_path):
    pulls = np.append(STRETCH, 1.0 + 2.0 * (STRETCH - 1.0))
    told = refusal(tmp_path, "stretch_x,stress_x", pulls, pulls - 1.0)
    assert "row 31 is nearer to rest than one before by one step, and rises again: if an" in told
    assert "in a column 'protocol'" in told
    assert "unloading" not in told
    ones, load = np.ones(30), np.linspace(0.0, 5.0, 30)
    along = np.append(STRETCH, ones), np.append(ones, STRETCH), np.tile(STRESS, 2)
    assert "row 31 is" in refusal(tmp_path, "stretch_x,stretch_y,stress_x", *along)
    told = refusal(tmp_path, "applied_x,stretch_x", np.tile(load, 2), pulls)
    assert "if another test begins there" in told
    told = refusal(tmp_path, "applied_x,stretch_x", load - 2.5, STRETCH - 0.1)
    assert "go through rest" in told
    radius, words = np.tile(0.4 + 0.2 * (STRETCH - 1.0), 2), "inner_radius,stretch_axial,pressure"
    columns = radius, np.full(60, 1.2), np.tile(STRESS, 2)
    told = refusal(tmp_path, words, *columns, tube=Tube(0.36, (0.1,)))
    assert "row 31 has a smaller radius than one before by one step" in told
    # The same test unloaded quickly, with rows on the way: unloading.
    cycle = np.concatenate([STRETCH, [1.1, 1.05, 1.0], STRETCH])
    told = refusal(tmp_path, "stretch_x,stress_x", cycle, cycle - 1.0)
    assert "unloading goes under 'unloading'" in told


@pytest.mark.parametrize("unit", ["kN/m2", "KN/m^2", "kpa"])
def test_kilopascals_have_many_names(tmp_path, unit):
    notes = draft(tmp_path, f"stretch_x,stress_x [{unit}]", STRETCH, STRESS).notes
    assert f"stress reaches {STRESS[-1]:.3g} kPa" in notes


def test_columns_that_are_left_out_are_named(tmp_path):
    time, true = np.arange(30), STRESS * STRETCH
    columns = "time [s],stretch_x,stress_x [kPa],true_stress [kPa]"
    (said,) = [
        n for n in draft(tmp_path, columns, time, STRETCH, STRESS, true).notes if "left" in n
    ]
    assert said == (
        "columns left out: time [s], true_stress [kPa]; call true_stress [kPa] cauchy_x [kPa] if "
        "they are that"
    )
    for file in tmp_path.glob("*.toml"):
        file.unlink()
    told = refusal(tmp_path, "Stretch,Stress (MPa)", STRETCH, STRESS)
    assert "call Stretch stretch_x, Stress (MPa) stress_x [MPa] if they are that" in told


def test_words_of_branches_blanks_and_marks_of_thousands_that_are_none(tmp_path):
    branches = ["load"] * 15 + ["unload"] * 15
    told = refusal(tmp_path, "branch,stretch_x,stress_x", branches, STRETCH, STRESS)
    assert "column 'branch' is 'load'; give 'loading', or 'unloading' for rows" in told
    for text, line in (
        ("stretch_x stress_x\n1.0 0\n1.1 3\n", "are separated by blanks: put commas"),
        ("stretch_x;stress_x [Pa]\n1;0\n1,1;1.004,9\n", "leave out marks of thousands"),
    ):
        (tmp_path / "t.csv").write_text(text)
        with pytest.raises(InputError, match=line):
            draft_specimen(tmp_path / "t.csv", tmp_path / "x.toml")


def test_a_pressure_that_may_be_in_mmhg_is_asked_about(tmp_path):
    radius, pressure = np.linspace(0.4, 0.5, 30), np.linspace(0.0, 150.0, 30)
    asked = []
    for unit in ("", " [mmHg]"):
        words = f"inner_radius [mm],stretch_axial,pressure{unit}"
        columns = radius, np.full(30, 1.2), pressure
        asked += [n for n in draft(tmp_path, words, *columns, tube=Tube(0.36, (0.1,))).notes
                  if "'pressure [mmHg]'" in n]  # fmt: skip
        for file in tmp_path.glob("*.toml"):
            file.unlink()
    (said,) = asked
    assert "a pressure of 150 without a unit is taken for kPa, 1125 mmHg" in said


def test_a_stretch_of_some_tests_is_said(tmp_path):
    """A pull whose shear is 0, and a shear without stretches, as shear_from_zero has them."""
    tests, shear = ["pull"] * 30 + ["shear"] * 30, np.append(np.zeros(30), 2.0 * (STRETCH - 1.0))
    columns = [*STRETCH, *HALF], shear, [*STRESS, *HALF], [*HALF, *(3.0 * shear[30:])]
    header = "protocol,stretch_x,shear_xy,stress_x,stress_xy"
    notes = draft(tmp_path, header, tests, *columns).notes
    assert "stretch_x from 1 to 1.2" in notes
