import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import journeys
from emulator.catalogue import find_scene, scene_from_origin
from emulator.core.errors import InputError
from emulator.geometry.generators.biventricle import biventricle
from emulator.geometry.generators.box import box
from emulator.geometry.generators.ellipsoid import human_ventricle
from emulator.geometry.io import write_mesh
from emulator.scenes import Parameter
from emulator.scenes.fibre_rules import Biventricle, Helix
from emulator.scenes.loads import (
    ActiveTension,
    FollowerPressure,
    Force,
    Gravity,
    PublishedPressure,
    Traction,
)
from emulator.scenes.supports import ElasticSupport
from scene_file_support import HEART, SCENE


def test_few_frames_lie_between_a_command_and_its_scene():
    frames = journeys.scene_file().frames
    assert len(frames) <= 6
    assert frames[-1].function == "SceneData.__post_init__"


def test_a_scene_from_a_file(folder):
    scene = find_scene(str(folder / "scene.toml"))
    assert scene.parameter_names == ("mu",)
    assert scene.constants["lam"] == 30.0
    assert scene.loads[0].density == 1.1
    np.testing.assert_array_equal(
        np.flatnonzero(scene.held.all(axis=1)), scene.mesh.node_set("left")
    )
    assert scene_from_origin(scene.origin).fingerprint == scene.fingerprint


RANGE = 'range = [5, 20]\nscale = "log"'


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('law = "neo_hookean"', 'law = "hooke"', "law 'hooke' is unknown"),
        ('law = "neo_hookean"', "", "key 'law' is missing; expected a string"),
        ('[[supports]]\nnode_set = "left"', "", "key 'supports' is missing; expected tables"),
        ("[[loads]]", "[loads]", r"loads = .*; expected tables \[\[loads\]\]"),
        ('kind = "gravity"', "", r"number 1: key 'kind' is missing; expected \"gravity\" or"),
        ('law = "neo_hookean"', 'laws = "neo_hookean"', "unknown key 'laws'"),
        ("block.vtu", "missing.vtu", "missing.vtu does not exist"),
        ("at = 0.0", "at = 0.5", "no node at x = 0.5 mm"),
        ('axis = "x"', 'axis = "w"', r"\[node_sets.left\]: axis = \"w\"; expected \"x\" or"),
        ("at = 0.0", "", r"\[node_sets.left\]: key 'at' is missing; expected a number"),
        (
            'kind = "gravity"',
            'kind = "wind"',
            r"\[\[loads\]\] number 1: kind = \"wind\"; expected \"gravity\" or",
        ),
        ("density = 1.1", "density = -1.1", "density is -1.1"),
        (
            "density = 1.1",
            "mass = 1.1",
            "unknown key 'mass'; known: acceleration, density, direction, kind",
        ),
        (
            "range = [5, 20]",
            "range = [5]",
            r"\[parameters.mu\]: range = \[5\]; expected 2 numbers in brackets",
        ),
        ("range = [5, 20]", "range = [5, nan]", "expected 2 numbers in brackets"),
        ('unit = "kPa"', 'unit = "Pa"', "'mu' is in Pa; law 'neo_hookean' takes kPa"),
        ('unit = "kPa"', "", "'mu' is given no unit; law 'neo_hookean' takes kPa"),
        ("lam = 30.0", "lam = -30.0", "parameter 'lam' is -30 kPa; it must be above 0"),
        ("lam = 30.0", 'lam = "30"', r"\[constants\]: lam = \"30\"; expected a number"),
        ("lam = 30.0", "lam = 30.0\nnu = 0.3", "parameter 'nu' is not one of law 'neo_hookean'"),
        (
            "[parameters.mu]",
            "[parameters]\nmu = 3\n[parameters.nu]",
            r"\[parameters.mu\] is 3; exp",
        ),
        ('node_set = "left"', 'node_set = "apex"', "node set 'apex' is not in the mesh; its sets"),
        (
            'node_set = "left"',
            'node_set = "left"\ncomponents = "w"',
            "components 'w'; name some of",
        ),
        (
            'node_set = "left"',
            'node_set = "left"\nkind = "glued"',
            'kind = "glued"; expected "held',
        ),
        (
            'node_set = "left"',
            'kind = "elastic"\nfacet_set = "skin"\nstiffness = 1',
            "facet set 'skin' is not in the mesh; its sets: none",
        ),
        (
            "[constants]",
            "[[supports]]\nnode_set = 'left'\ndisplacement = [1, 0, 0]\n[constants]",
            "support on 'left' contradicts another one at node",
        ),
        ('law = "neo_hookean"', 'law = "neo_hookean"\norder = 3', "order = 3; expected 1 or 2"),
        (
            'law = "neo_hookean"',
            'law = "neo_hookean"\ndilatation = "mean"',
            "make the mesh quadratic",
        ),
        ('law = "neo_hookean"', 'law = "guccione"', "mesh file block.vtu has none; give it cell"),
        (
            "[constants]",
            "[fibres]\nrule = 'uniform'\ndirection = [1, 0, 0]\n[constants]",
            "law 'neo_hookean' takes no fibres",
        ),
        (
            "[constants]",
            "[[loads]]\nkind = 'active_tension'\ntension = 5.0\n[constants]",
            "load 'active_tension' needs fibres, and mesh file block.vtu has none; give it cell",
        ),
        (
            "[constants]",
            "[[loads]]\nkind = 'active_tension'\ntension = -5.0\n[constants]",
            "tension is -5.0 kPa; it must be 0 or more",
        ),
        (
            "[constants]",
            "[fibres]\nrule = 'spiral'\n[constants]",
            'rule = "spiral"; expected "helix',
        ),
        (
            "[constants]",
            "[fibres]\nrule = 'helix'\nangles = [60, -60]\n[constants]",
            "facet set 'endocardium' is not in the mesh",
        ),
        (
            "[constants]",
            "[facet_sets.mid]\naxis = 'x'\nat = 1.0\n[constants]",
            r"\[facet_sets.mid\]: no surface triangle at x = 1 mm; the body is between 0 and 2",
        ),
        (
            "[constants]",
            "[facet_sets.end]\naxis = 'x'\nat = 2.0\n[[loads]]\nkind = 'cavity_pressure'\n"
            "facet_set = 'end'\n[constants]",
            "load CavityPressure needs 'pressure'",
        ),
        (
            "[constants]",
            "[[loads]]\nkind = 'traction'\nfacet_set = 'in'\ntraction = [0, 0, 1]\n[constants]",
            "facet set 'in' is not in the mesh",
        ),
        (
            "[constants]",
            "[facet_sets.end]\naxis = 'x'\nat = 2.0\n[[loads]]\nkind = 'cavity_pressure'\n"
            "facet_set = 'end'\npressure = 1.0\n[constants]",
            "cavity 'end': rim node .* is not held.*use FollowerPressure",
        ),
        ("range = [5, 20]", "range = [20, 5]", "range .* is empty"),
        (RANGE, "", r"\[parameters.mu\]: give a range, or median and log_sd"),
        (RANGE, "median = 9", r"\[parameters.mu\]: give a range, or median and"),
        ("range = [5, 20]", "range = [5, 20]\nmedian = 9", "it has median, range, scale; give"),
        (
            "range = [5, 20]",
            "median = 9\nlog_sd = 1",
            "it has log_sd, median, scale; give range and scale, or median, log_sd and source",
        ),
        (RANGE, "median = 0\nlog_sd = 1", "median is 0; it must be above 0"),
        (RANGE, "median = 9\nlog_sd = 0", "log_sd is 0; it must be above 0"),
        (RANGE, "median = 9\nlog_sd = 900", "log_sd is 900; .* at most 10"),
        (RANGE, 'median = "9"\nlog_sd = 1', 'median = "9"; expected a number'),
        ("lam = 30.0", "lam = ", "is not valid TOML"),
    ],
)
def test_one_line_for_every_mistake(folder, old, new, message):
    assert old in SCENE
    (folder / "scene.toml").write_text(SCENE.replace(old, new, 1))
    with pytest.raises(InputError, match=message) as caught:
        find_scene(str(folder / "scene.toml"))
    assert str(caught.value).startswith(f"scene file {folder / 'scene.toml'}")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        ('"neo_hookean"', '"hooke"', 'law = "hooke"'),
        ("block.vtu", "missing.vtu", 'mesh = "missing.vtu"'),
        ('mesh = "block.vtu"', 'mesh = "block.vtu"\nmehs = 1', "mehs = 1"),
        ("[node_sets.left]", "order = 3\n[node_sets.left]", "order = 3"),
        ("at = 0.0", "at = 0.5", "at = 0.5"),
        ('node_set = "left"', 'node_set = "apex"', 'node_set = "apex"'),
        ("density = 1.1", "mass = 1.1", "mass = 1.1"),
        ("density = 1.1", "density = [\n1.1]", "density = ["),
        ("density = 1.1", "density = -1.1", "[[loads]]"),
        ("range = [5, 20]", "range = [5]", "range = [5]"),
        ('unit = "kPa"', 'unit = "Pa"', "[parameters.mu]"),
        ("lam = 30.0", "lam = -30.0", "lam = -30.0"),
        ("lam = 30.0", "lam = 30.0\nnu = 0.3", "nu = 0.3"),
    ],
)
def test_a_mistake_is_found_on_its_line(folder, old, new, line):
    text = SCENE.replace(old, new, 1)
    (folder / "scene.toml").write_text(text)
    with pytest.raises(InputError, match=r"scene.toml, line \d+: ") as caught:
        find_scene(str(folder / "scene.toml"))
    number = int(re.search(r"line (\d+)", str(caught.value))[1])
    assert text.splitlines()[number - 1] == line


def test_every_kind_of_pressure_takes_a_value_or_a_parameter(folder):
    planes = "[facet_sets.end]\naxis = 'x'\nat = 2.0\n"
    load = planes + "[[loads]]\nkind = '{}'\nfacet_set = 'end'\n{}\n[constants]"
    for kind, cls in (
        ("follower_pressure", FollowerPressure),
        ("published_pressure", PublishedPressure),
    ):
        for key, expected in (
            ("pressure = 1", cls("end", 1.0)),
            ("parameter = 'p'", cls("end", None, "p")),
        ):
            constant = "\np = 0.1" if expected.pressure is None else ""
            text = SCENE.replace("[constants]", load.format(kind, key) + constant)
            (folder / "scene.toml").write_text(text)
            assert find_scene(str(folder / "scene.toml")).loads[1] == expected


def test_importing_the_package_does_not_import_pydantic():
    code = "import sys, emulator.catalogue; print('emulator.core.schema' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


def test_the_examples_of_the_documentation(folder):
    page = Path(__file__).resolve().parents[3] / "docs" / "scene_files.md"
    blocks = re.findall(r"```toml\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
    for name, text in zip(("block", "ventricle", "cube", "bodies"), blocks, strict=True):
        (folder / f"{name}.toml").write_text(text)
    write_mesh(folder / "ventricle.vtu", human_ventricle(5, 12, 1))
    block = find_scene(str(folder / "block.toml"))
    assert block.loads == (Gravity(1.0, (0.0, 0.0, -1.0)),)
    assert block.parameters == (Parameter("mu", "kPa", 50.0, 100.0, "log"),)
    assert block.constants == {"lam": 80.0}

    scene = find_scene(str(folder / "ventricle.toml"))
    assert (scene.mesh.order, scene.dilatation) == (2, "mean")
    fibres, _ = Helix((60.0, -60.0)).directions(scene.mesh)
    np.testing.assert_array_equal(scene.fibres, fibres)
    base = scene.mesh.node_set("base")
    assert scene.held[base].tolist() == [[False, False, True]] * len(base)
    np.testing.assert_array_equal(scene.held_displacement[base], [[0.0, 0.0, 0.5]] * len(base))
    assert scene.supports[1] == ElasticSupport("epicardium", 0.2, "normal")
    pressure = FollowerPressure("endocardium", 0.8)
    assert scene.loads == (pressure, Traction("base", (0.0, 0.1, 0.0)))
    assert scene_from_origin(scene.origin).fingerprint == scene.fingerprint

    write_mesh(folder / "cube.vtu", box((10.0, 10.0, 10.0), (2, 2, 2)))
    cube = find_scene(str(folder / "cube.toml"))
    assert cube.load_parameters == ("shear",)
    moved = cube.held_at(cube.theta(shear=0.2, mu=3.0))
    np.testing.assert_array_equal(moved[cube.mesh.node_set("top")], [[2.0, 0.0, 0.0]] * 9)
    edge = np.flatnonzero((cube.mesh.nodes[:, :2] == [10.0, 0.0]).all(axis=1))
    np.testing.assert_array_equal(cube.mesh.node_set("edge"), edge)
    assert [load.to_json() for load in cube.loads] == [Force("edge", (0.0, 0.0, -0.5)).to_json()]
    assert scene_from_origin(cube.origin).fingerprint == cube.fingerprint
    _two_cubes(folder)


def _two_cubes(folder):
    """The last example is a part of a file: the bodies in place of a mesh."""
    for name in ("cube1", "cube2"):
        write_mesh(folder / f"{name}.vtu", box((10.0, 10.0, 10.0), (1, 1, 1)))
    rest = (folder / "cube.toml").read_text().split("[node_sets.edge]")[0]
    rest = rest.replace('mesh = "cube.vtu"', "").replace('"bottom"', '"cube1.bottom"')
    held = '[[supports]]\nnode_set = "cube2.bottom"\n'
    rest = rest.replace('"top"', '"cube1.top"') + held + (folder / "bodies.toml").read_text()
    table = "[parameters.mu]\nunit = 'kPa'\nrange = [1, 10]\n[parameters.shear]\nrange = [0, 1]\n"
    (folder / "both.toml").write_text(rest + table + "[constants]\nlam = 80.0\n")
    both = find_scene(str(folder / "both.toml"))
    assert len(both.mesh.node_set("cube2.edge")) == 4
    assert both.mesh.nodes[:, 0].max() == 30.0


def test_pressures_as_parameters_and_other_rules_for_fibres(folder):
    write_mesh(folder / "heart.vtu", biventricle(rings=6, around=16, layers=(1, 1)))
    laid = {"biventricle": "angles = [60, -60]", "uniform": "direction = [0, 3, 4]"}
    for rule, options in laid.items():
        (folder / "heart.toml").write_text(HEART.format(rule=rule, options=options))
        scene = find_scene(str(folder / "heart.toml"))
        names = [load.parameter for load in scene.loads]
        assert names == ["pressure", "right_pressure"]
        assert scene.parameter_names == ("pressure",)
        if rule == "uniform":
            np.testing.assert_allclose(scene.fibres, [[0.0, 0.6, 0.8]] * len(scene.mesh.elements))
        else:
            expected, _ = Biventricle((60.0, -60.0)).directions(scene.mesh)
            np.testing.assert_allclose(scene.fibres, expected)


def test_muscle_of_a_law_without_fibres(folder):
    text = (folder / "scene.toml").read_text()
    active = "[[loads]]\nkind = 'active_tension'\nparameter = 'contractility'\ntransverse = 0.1\n"
    varied = "[parameters.contractility]\nunit = 'kPa'\nrange = [0.0, 60.0]\n"
    rule = "[fibres]\nrule = 'uniform'\ndirection = [0, 0, 2]\n"
    file = folder / "muscle.toml"
    file.write_text(text.replace("[constants]", active + varied + rule + "[constants]"))
    scene = find_scene(str(file))
    assert scene.loads[-1] == ActiveTension(parameter="contractility", transverse=0.1)
    assert scene.load_parameters == ("contractility",)
    np.testing.assert_array_equal(scene.fibres_at_points[..., 2], 1.0)
    assert scene_from_origin(scene.origin).fingerprint == scene.fingerprint


def test_unknown_names(tmp_path):
    with pytest.raises(InputError, match="scene 'beam' is unknown; built in: biventricle"):
        find_scene("beam")
    with pytest.raises(InputError, match="does not exist"):
        find_scene(str(tmp_path / "none.toml"))
    with pytest.raises(InputError, match="with --root DIR"):
        find_scene("published:OnceClampedBeam")
    with pytest.raises(InputError, match="origin names scene 'None'"):
        scene_from_origin({})


PRIOR = 'median = 9\nlog_sd = 0.5\nsource = "a book"'


def test_a_parameter_may_have_a_prior_in_place_of_a_range(folder):
    (folder / "scene.toml").write_text(SCENE.replace(RANGE, PRIOR))
    (mu,) = find_scene(str(folder / "scene.toml")).parameters
    assert (mu.prior.median, mu.prior.log_sd, mu.prior.source) == (9.0, 0.5, "a book")
    assert (mu.low, mu.high) == pytest.approx((9.0 * np.exp(-0.5), 9.0 * np.exp(0.5)))
    assert mu.scale == "log"


def test_the_range_of_a_prior_ends_before_what_nature_does_not_allow(folder):
    text = SCENE.replace('law = "neo_hookean"', 'law = "neo_hookean_E_nu"').replace("lam =", "E =")
    text = text.replace('[parameters.mu]\nunit = "kPa"\n' + RANGE, f"[parameters.nu]\n{PRIOR}")
    path = folder / "scene.toml"
    path.write_text(text.replace("median = 9", "median = 0.45"))
    (nu,) = find_scene(str(path)).parameters
    assert 0.45 < nu.high < 0.5
    assert nu.low == pytest.approx(0.45 * np.exp(-0.5))
    path.write_text(text.replace("median = 9", "median = 0.5"))
    with pytest.raises(InputError, match="median: parameter 'nu' is 0.5; it must be below 0.5"):
        find_scene(str(path))


def test_a_prior_is_in_the_fingerprint_by_its_numbers(folder):
    """Scenes with a range keep theirs, and an emulator of a prior's range serves that range."""

    def fingerprint(entries):
        (folder / "scene.toml").write_text(SCENE.replace(RANGE, entries))
        return find_scene(str(folder / "scene.toml")).fingerprint

    stated = fingerprint(PRIOR)
    assert fingerprint(PRIOR.replace("a book", "another")) == stated
    low, high = 9.0 * np.exp(-0.5), 9.0 * np.exp(0.5)
    assert fingerprint(f'range = [{float(low)!r}, {float(high)!r}]\nscale = "log"') == stated
    for other in ("median = 8", "log_sd = 0.6"):
        key = other.split(" = ")[0]
        changed = "\n".join(other if line.startswith(key) else line for line in PRIOR.split("\n"))
        assert fingerprint(changed) != stated
