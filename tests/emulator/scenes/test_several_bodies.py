"""Several bodies of one material in one scene, from Python and from a file."""

from dataclasses import replace

import numpy as np
import pytest

import emulator as em
from emulator.catalogue import find_scene
from emulator.core.errors import InputError
from emulator.geometry.generators.box import box
from emulator.geometry.io import write_mesh
from emulator.scenes import Support
from emulator.scenes.loads.force import Force

CUBE, BEAM = box((10.0, 10.0, 10.0), (2, 2, 2)), box((20.0, 8.0, 8.0), (3, 1, 1))
MU = em.Parameter("mu", "kPa", 5.0, 20.0, "log")

SEVERAL = """
law = "neo_hookean"
[[bodies]]
name = "cube"
mesh = "cube.vtu"
[[bodies]]
name = "beam"
mesh = "beam.vtu"
shift = [30.0, 0.0, 0.0]
[node_sets.edge]
axis = "x"
at = 50.0
within = "beam.top"
[[supports]]
node_set = "cube.bottom"
[[supports]]
node_set = "cube.top"
displacement = [2.0, 0.0, 0.0]
[[supports]]
node_set = "beam.left"
[[loads]]
kind = "force"
node_set = "edge"
resultant = [0.0, 0.0, -0.01]
[parameters.mu]
unit = "kPa"
range = [5, 20]
scale = "log"
[constants]
lam = 30.0
"""


def scene_of(name, mesh, supports, loads, **more):
    law = em.find_law("neo_hookean")
    given = {"parameters": (MU,), "constants": {"lam": 30.0}, **more}
    return em.Scene(name=name, mesh=mesh, law=law, supports=supports, loads=loads, **given)


@pytest.fixture(scope="module")
def bodies():
    return em.side_by_side({"cube": CUBE, "beam": BEAM}, gap=20.0)


@pytest.fixture(scope="module")
def scene(bodies):
    supports = (
        Support("cube.bottom"),
        Support("cube.top", displacement=(2.0, 0.0, 0.0)),
        Support("beam.left"),
    )
    return scene_of("both", bodies.mesh, supports, (Force("beam.right", (0.0, 0.0, -0.01)),))


def alone():
    plates = (Support("bottom"), Support("top", displacement=(2.0, 0.0, 0.0)))
    cube = scene_of("cube", CUBE, plates, ())
    beam = scene_of("beam", BEAM, (Support("left"),), (Force("right", (0.0, 0.0, -0.01)),))
    return {"cube": cube, "beam": beam}


def test_each_body_has_its_own_solution(bodies, scene):
    tight = em.fem.NewtonOptions(tolerance=1e-13)
    both = em.Simulator(scene, tight).solve(scene.centre)
    assert both.converged
    for name, own in alone().items():
        found = em.Simulator(own, tight).solve(own.centre)
        inside = bodies.nodes(name)
        size = np.abs(found.displacement).max()
        np.testing.assert_allclose(
            both.displacement[inside], found.displacement, atol=1e-10 * size, rtol=0
        )


@pytest.mark.slow
def test_the_finer_mesh_keeps_both_bodies(bodies, scene):
    """Each body's finer solution is its own, and its sets grow with the mesh."""
    fine = em.finer(scene)
    both = em.Simulator(fine.scene).solve(scene.centre)
    children = fine.refinement.children
    for name, own in alone().items():
        apart = em.finer(own).scene
        found = em.Simulator(apart).solve(own.centre).displacement
        rows = (children * bodies.elements(name)[:, None] + np.arange(children)).ravel()
        elements = fine.scene.mesh.elements[rows]
        np.testing.assert_allclose(
            both.displacement[elements], found[apart.mesh.elements], atol=1e-7
        )
        assert len(fine.scene.mesh.node_set(name)) == len(np.unique(apart.mesh.surface))


@pytest.mark.slow
def test_regions_are_bodies(bodies, scene):
    stiffness = {"stiffness_1": 1.0, "stiffness_2": 2.0}
    both = replace(scene, regions=bodies.body + 1, constants={"lam": 30.0, **stiffness})
    beam = replace(alone()["beam"], parameters=(replace(MU, low=10.0, high=40.0),))
    found = em.Simulator(both).solve(both.centre).displacement
    double = em.Simulator(beam).solve(beam.centre).displacement
    inside = bodies.nodes("beam")
    np.testing.assert_allclose(found[inside], double, atol=1e-8 * np.abs(double).max())


@pytest.fixture
def file(tmp_path):
    write_mesh(tmp_path / "cube.vtu", CUBE)
    write_mesh(tmp_path / "beam.vtu", BEAM)
    (tmp_path / "both.toml").write_text(SEVERAL)
    return tmp_path / "both.toml"


def test_bodies_of_a_file(file):
    scene = find_scene(str(file))
    assert len(scene.mesh.nodes) == len(CUBE.nodes) + len(BEAM.nodes)
    nodes = scene.mesh.nodes[scene.mesh.node_set("beam")]
    np.testing.assert_allclose(nodes.min(axis=0), [30.0, 0.0, 0.0])
    assert len(scene.mesh.node_set("edge")) == 2
    file.write_text(
        "order = 2\nregions = 'body'\n" + SEVERAL + "stiffness_1 = 1\nstiffness_2 = 2\n"
    )
    quadratic = find_scene(str(file))
    assert quadratic.mesh.order == 2
    assert np.bincount(quadratic.regions).tolist() == [0, len(CUBE.elements), len(BEAM.elements)]


def test_fibres_of_each_mesh_file_or_by_a_rule(file):
    values = "C = 2.0\nb_f = 8.0\nb_t = 2.0\nb_fs = 4.0\nkappa = 50.0"
    text = SEVERAL.replace("neo_hookean", "guccione").replace("lam = 30.0", values)
    text = text[: text.index("[parameters")] + text[text.index("[constants]") :]
    text = text.replace("C = 2.0\n", "").replace(
        "[constants]", "[parameters.C]\nunit = 'kPa'\nrange = [1, 4]\n[constants]"
    )
    file.write_text(text)
    with pytest.raises(InputError, match=r"\[\[bodies\]\] number 1: law 'guccione' needs fibres"):
        find_scene(str(file))
    for name, mesh, direction in (("cube", CUBE, (1, 0, 0)), ("beam", BEAM, (0, 0, 1))):
        fibres = np.tile(np.array(direction, float), (len(mesh.elements), 1))
        write_mesh(file.parent / f"{name}.vtu", mesh, fibres)
    scene = find_scene(str(file))
    expected = np.repeat([[1.0, 0, 0], [0, 0, 1.0]], [len(CUBE.elements), len(BEAM.elements)], 0)
    np.testing.assert_allclose(scene.fibres, expected)
    file.write_text(
        text.replace("[constants]", "[fibres]\nrule='uniform'\ndirection=[0,2,0]\n[constants]")
    )
    np.testing.assert_allclose(
        find_scene(str(file)).fibres, np.tile([0, 1.0, 0], (len(expected), 1))
    )


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('law = "neo', 'mesh = "cube.vtu"\nlaw = "neo', "there are tables [[bodies]], too; give either"),
        ('name = "beam"', 'name = "cube"', "[[bodies]] number 2: there is a body 'cube' before"),
        ('name = "beam"', 'name = "my beam"', "[[bodies]] number 2: body 'my beam': a name has"),
        ("beam.vtu", "boom.vtu", "boom.vtu does not exist"),
        ("shift = [30.0, 0.0, 0.0]\n", "size = 3\n", "unknown key 'size'; known: mesh, name, shift"),
        ("shift = [30.0, 0.0, 0.0]", "shift = 3", "expected 3 numbers in brackets"),
        ('node_set = "beam.left"', 'node_set = "left"', "node set 'left' is not in the mesh; its sets: beam,"),
        ("[[supports]]\nnode_set = \"beam.left\"\n", "", "the mesh has 2 parts, and supports leave the one of"),
    ],
)  # fmt: skip
def test_bad_bodies_in_a_file(file, old, new, words):
    assert old in SEVERAL
    file.write_text(SEVERAL.replace(old, new, 1))
    with pytest.raises(InputError) as error:
        find_scene(str(file))
    assert words in str(error.value)
    assert "\n" not in str(error.value)


def test_bodies_at_the_same_place_and_no_body(file):
    cube = SEVERAL.replace("beam.vtu", "cube.vtu").replace("shift = [30.0, 0.0, 0.0]\n", "")
    file.write_text(cube)
    with pytest.raises(InputError, match="'cube' and 'beam' have 27 nodes at the same places"):
        find_scene(str(file))
    start, end = SEVERAL.index("[[bodies]]"), SEVERAL.index("[node_sets")
    file.write_text(SEVERAL[:start] + SEVERAL[end:])
    with pytest.raises(
        InputError, match=r"key 'mesh' is missing; give a mesh file, or tables \[\["
    ):
        find_scene(str(file))
