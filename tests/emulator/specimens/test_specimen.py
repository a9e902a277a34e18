"""Tables of a specimen's states: what they mean, and what they cannot mean."""

import jax.numpy as jnp
import numpy as np
import pytest

import calibrate as cal
import emulator as em
from emulator.core.errors import InputError
from emulator.core.units import with_unit
from emulator.scenes.file import read_scene
from emulator.scenes.scene import with_mesh
from emulator.specimens.grips import Grips
from emulator.specimens.specimen import read_states, require_specimen, specimen
from emulator.specimens.states import states

NAN = np.nan


def test_columns_are_components_of_the_gradient():
    given = states(
        {
            "stretch_x": np.array([1.1, 1.2]),
            "green_y": np.array([0.105, NAN]),
            "shear_xz [%]": np.array([0.0, 5.0]),
        },
        ordered=False,
    )
    np.testing.assert_allclose(given.gradients[0], np.diag([0.1, 0.1, 0.0]), atol=1e-12)
    expected = np.array([[0.2, 0.0, 0.05], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    np.testing.assert_allclose(given.gradients[1], expected, atol=1e-12)
    np.testing.assert_array_equal(given.free, [[False, False, True], [False, True, True]])
    same = states({"strain_x [%]": np.array([10.0])}).gradients
    np.testing.assert_allclose(same, states({"strain_x": np.array([0.1])}).gradients)


@pytest.mark.parametrize(
    ("word", "expected"),
    [
        ("stress_x", ("stress_x", "")),
        ("stress_x [MPa]", ("stress_x", "MPa")),
        ("force_x (N)", ("force_x", "N")),
        (" strain_x[%] ", ("strain_x", "%")),
        ("protocol", ("protocol", "")),
    ],
)
def test_columns_have_units(word, expected):
    assert with_unit(word) == expected


def test_a_column_names_the_test_of_each_state():
    columns = {"stretch_x": np.array([1.0, 1.1, 1.0, 1.2])}
    scene = of_law({**columns, "protocol": ["a", "a", "b", "b"]})
    assert list(scene.states.protocols) == ["a", "b"]
    assert scene.fingerprint == of_law(states(columns, ["a", "a", "b", "b"])).fingerprint
    with pytest.raises(InputError, match="3 names of tests for 4 states"):
        of_law({**columns, "protocol": ["a", "a", "b"]})


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({}, "no column says how the specimen moves"),
        ({"stretch_x": [1.0, 1.1], "strain_x": [0.0, 0.1]}, "says the same as 'stretch_x'"),
        ({"stretch_x": [100.0, 110.0]}, "a stretch is 1 at rest"),
        ({"strain_x": [0.0, 12.0]}, "call it 'strain_x [%]'"),
        ({"strain_x [-]": [0.0, 12.0]}, "is a stretch of 13, outside 0.1 to 12"),
        ({"shear_xy": [0.0, 10.0]}, "call it 'shear_xy [%]' if it is in percent"),
        ({"shear_xy [-]": [0.0, 10.0]}, "row 2, column 'shear_xy [-]' is a shear of 10"),
        ({"shear_xx": [0.0, 0.1]}, "says the same as 'a stretch'"),
        ({"stretch_x [mm]": [1.0, 1.1]}, "unit 'mm'"),
        ({"stretch_x [%]": [1.0, 1.1]}, "unit '%'"),
        ({"green_x": [-0.7]}, "goes down to -0.7"),
        (
            {"stretch_x": [1.0], "load": [1.0]},
            "column 'load' says no motion; motions are stretch_x",
        ),
        ({"stretch_x": [1.0, NAN]}, "row 2 has no stretch and no shear"),
        (
            {"stretch_x": [1.0, 1.1, 1.2], "stretch_y": [1.0, 1.1, NAN]},
            "row 3 has no stretch along y, others have",
        ),
        (
            {"stretch_x": [1.0, 1.2, 1.1]},
            "row 3 is nearer to rest than one before: rows of a test are in the order of its loading",
        ),
        (
            {"applied_x": [0.0, 2.0, 1.0]},
            "row 3 is nearer to rest than one before: rows of a test are in the order of its loading",
        ),
        (
            {"applied_x [furlong]": [0.0, 2.0]},
            "column 'applied_x [furlong]': unit 'furlong' is unknown",
        ),
        ({"applied_x": [0.0, 2.0], "applied_x [kPa]": [0.0, 2.0]}, "same as 'applied_x'"),
        ({"applied_x": [0.0, np.inf]}, "row 2 has an infinite pull"),
        (
            {"applied_x": [0.0, NAN, 2.0], "stretch_x": [1.0, 1.1, 1.2]},
            "row 2 has no pull along x, others have",
        ),
        ({"applied_x": [0.0, NAN], "applied_y": [0.0, 1.0]}, "row 2 has no pull along x"),
        ({"applied_x": [0.0, 2.0], "stretch_x": [100.0, 110.0]}, "a stretch is 1 at rest"),
    ],
)
def test_tables_that_no_specimen_makes_are_refused(columns, message):
    with pytest.raises(InputError, match=None) as caught:
        states({name: np.array(values) for name, values in columns.items()})
    assert message in str(caught.value)


def test_tests_have_names_and_each_leads_away_from_rest():
    path = np.array([1.0, 1.1, 1.0, 1.2])
    given = states({"stretch_x": path}, ["a", "a", "b", "b"])
    assert {name: rows.tolist() for name, rows in given.protocols.items()} == {
        "a": [0, 1],
        "b": [2, 3],
    }
    with pytest.raises(InputError, match="row 3 is nearer"):
        states({"stretch_x": path})


def of_law(given, **entries):
    return specimen(
        given,
        law=em.find_law("neo_hookean"),
        parameters=(em.Parameter("mu", "kPa", 5.0, 20.0),),
        constants={"lam": 50.0},
        **entries,
    )


def test_a_specimen_has_its_states_and_their_gradients():
    columns = {"stretch_x": np.array([1.1, NAN, 1.3]), "shear_yz": np.array([0.0, 0.2, 0.1])}
    given = states(columns, ["x", "shear", "origin"])  # names that corners might have
    piece = of_law(given)
    np.testing.assert_array_equal(piece.states.gradients, given.gradients)
    np.testing.assert_array_equal(piece.states.free, given.free)
    with pytest.raises(ValueError, match="read-only"):
        piece.states.gradients[0] = 0.0
    assert {n: r.tolist() for n, r in piece.measured.protocols.items()} == {
        "x": [0],
        "shear": [1],
        "origin": [2],
    }
    u = jnp.arange(27.0).reshape(9, 3)  # column k of H is the displacement of corner k
    np.testing.assert_array_equal(piece.gradients(u)[1][:, 2], u[3 + 2])
    assert piece.node_count == 9
    with pytest.raises(InputError, match="is no specimen"):
        require_specimen(em.find_scene("twisting_cube"))


def test_what_needs_a_mesh_refuses_a_specimen_in_one_line(tmp_path):
    piece = of_law(states({"stretch_x": np.array([1.0, 1.1])}))
    for use in (with_mesh, lambda scene: scene.mesh, em.Simulator, cal.CavityVolume):
        with pytest.raises(InputError, match="is a specimen, which has no mesh") as caught:
            use(piece)
        assert "\n" not in str(caught.value)
    (tmp_path / "table.csv").write_text("stretch_x,stress_x\n1.0,0\n1.1,1\n")
    (tmp_path / "scene.toml").write_text(SCENE)
    for name in ("", "finer:"):
        with pytest.raises(InputError, match="is a specimen, which has no mesh"):
            em.find_scene(f"{name}{tmp_path / 'scene.toml'}")


PULLED = {
    "applied_x [MPa]": np.array([0.0, 0.01, NAN, NAN, -0.002]),
    "applied_y": np.array([0.0, 3.0, NAN, NAN, NAN]),
    "stretch_x": np.array([1.0, 1.1, 1.0, 1.2, NAN]),
}


def test_pulls_are_in_kpa_and_in_the_fingerprint():
    given = states(PULLED, ["pulled", "pulled", "moved", "moved", "pressed"])
    expected = [[0.0, 0.0, 0.0], [10.0, 3.0, 0.0], [0.0] * 3, [0.0] * 3, [-2.0, 0.0, 0.0]]
    np.testing.assert_allclose(given.pulls, expected)
    np.testing.assert_array_equal(given.free[:, 0], [True, True, False, False, True])
    assert not given.gradients[:2].any()  # what is measured is not prescribed
    np.testing.assert_allclose(given.paths, [0.0, 1.0, 0.0, 0.2, 0.0])
    scene = of_law(given)
    np.testing.assert_array_equal(scene.states.pulls, given.pulls)
    other = states(PULLED | {"applied_y": np.array([0.0, 3.1, NAN, NAN, NAN])}, ordered=False)
    assert of_law(other).fingerprint != scene.fingerprint
    assert of_law(given).fingerprint == scene.fingerprint


def test_grips_do_not_pull():
    given = states({"applied_x": np.array([0.0, 2.0])})
    with pytest.raises(InputError, match="grips move a specimen"):
        of_law(given, grips=Grips((8.0, 4.0, 2.0)))


def test_a_tube_is_not_pulled(tmp_path):
    (tmp_path / "table.csv").write_text("outer_radius,stretch_axial,applied_y\n5.5,1.3,2.0\n")
    with pytest.raises(InputError, match="column 'applied_y': a tube is stretched and inflated"):
        read_states(tmp_path / "table.csv", em.specimens.Tube(4.6, (0.9,)))


SCENE = """
law = "neo_hookean"
specimen = "table.csv"
[parameters.mu]
unit = "kPa"
range = [1.0, 10.0]
[constants]
lam = 10.0
"""


def test_a_scene_file_names_the_table(tmp_path):
    (tmp_path / "table.csv").write_text(
        "protocol,branch,stretch_x,stress_x\n"
        "pull,loading,1.0,0\npull,loading,1.1,1\npull,unloading,1.0,0.5\n"
    )
    (tmp_path / "scene.toml").write_text(SCENE)
    scene = read_scene(tmp_path / "scene.toml")
    assert len(scene.states.free) == 2
    assert scene.states.protocols["pull"].tolist() == [0, 1]
    (tmp_path / "scene.toml").write_text(SCENE.replace("[parameters", "order = 2\n[parameters", 1))
    with pytest.raises(InputError, match="line 4: a specimen has none"):
        read_scene(tmp_path / "scene.toml")
    (tmp_path / "table.csv").write_text("protocol,stretch_x,stress_x\na,1.0,0\n,1.1,1\n")
    (tmp_path / "scene.toml").write_text(SCENE)
    with pytest.raises(InputError, match=r"row 2, column 'protocol' is empty"):
        read_scene(tmp_path / "scene.toml")
    (tmp_path / "table.csv").write_text("applied_x [Pa],strain_x\n0,0\n2000,0.1\n")
    (tmp_path / "scene.toml").write_text(SCENE)
    np.testing.assert_allclose(read_scene(tmp_path / "scene.toml").states.pulls[1], [2, 0, 0])
    (tmp_path / "scene.toml").write_text("grips = {size = [8.0, 4.0, 2.0]}\n" + SCENE)
    with pytest.raises(InputError, match="grips move a specimen"):
        read_scene(tmp_path / "scene.toml")
    (tmp_path / "table.csv").write_text("stretch_x,stress_x\n1.0,0\n112,1\n")
    (tmp_path / "scene.toml").write_text(SCENE)
    with pytest.raises(InputError, match=r"table.csv: row 2, column 'stretch_x' is a stretch"):
        read_scene(tmp_path / "scene.toml")


def test_sheets_are_tests(tmp_path):
    openpyxl = pytest.importorskip("openpyxl", reason="spreadsheets are an extra")
    book = openpyxl.Workbook()
    for k, name in enumerate(("x alone", "y alone")):
        sheet = book.active if k == 0 else book.create_sheet()
        sheet.title = name
        sheet.append([f"stretch_{'xy'[k]}", "stress_x"])
        for stretch in (1.0, 1.1, 1.2):
            sheet.append([stretch, 0.0])
    book.create_sheet("notes")
    book.save(tmp_path / "book.xlsx")
    given = read_states(tmp_path / "book.xlsx")
    assert {name: len(rows) for name, rows in given.protocols.items()} == {
        "x alone": 3,
        "y alone": 3,
    }
    np.testing.assert_array_equal(given.free[0], [False, True, True])
    np.testing.assert_array_equal(given.free[5], [True, False, True])


FIBRES = """
[fibres]
rule = "uniform"
direction = [2.0, 0.0, 0.0]
angle = "alpha"
about = [0.0, 0.0, 1.0]
[parameters.alpha]
unit = "deg"
range = [0.0, 90.0]
"""


def test_a_parameter_turns_the_fibres_of_every_state(tmp_path):
    (tmp_path / "table.csv").write_text("stretch_x,stress_x\n1.0,0\n1.1,1\n")
    law = SCENE.replace("neo_hookean", "holzapfel_ogden").replace("mu", "a")
    constants = "kappa = 10.0\nb = 1.0\na_f = 1.0\nb_f = 1.0\n"
    text = law.replace("lam = 10.0\n", constants) + FIBRES
    (tmp_path / "scene.toml").write_text(text)
    piece = read_scene(tmp_path / "scene.toml")
    turned = piece.tissue_at(piece.theta(a=5.0, alpha=30.0)).directions
    np.testing.assert_allclose(turned, np.tile([np.sqrt(0.75), 0.5, 0.0], (2, 1)), atol=1e-12)
    (tmp_path / "scene.toml").write_text(text.replace('"uniform"', '"biventricle"'))
    with pytest.raises(InputError):
        read_scene(tmp_path / "scene.toml")
    helix = '[fibres]\nrule = "helix"\nangles = [60.0, -60.0]\n'
    (tmp_path / "scene.toml").write_text(law.replace("lam = 10.0\n", constants) + helix)
    with pytest.raises(InputError, match="rule 'helix' is for a mesh; a specimen has 'uniform'"):
        read_scene(tmp_path / "scene.toml")
