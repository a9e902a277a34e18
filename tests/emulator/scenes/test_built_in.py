import json
from itertools import product

import jax.numpy as jnp
import numpy as np
import pytest

import emulator as em
from emulator.catalogue import find_scene, scene_from_origin
from emulator.core.errors import InputError
from emulator.fem import Status
from emulator.fem.energy import volume_ratio
from emulator.geometry.discretisation import facet_rule
from emulator.geometry.facets import Cavity
from emulator.scenes import BUILT_IN
from emulator.scenes.loads import KPA_PER_MMHG
from emulator.scenes.supports import ElasticSupport, Support

COARSE = {
    # The fixture `ventricle`, whose programs other tests compile too.
    "left_ventricle": {"rings": 4, "around": 8, "layers": 1},
    "left_ventricle_neo_hookean": {"rings": 5, "around": 12, "layers": 1},
    "left_ventricle_segments": {"rings": 5, "around": 12, "layers": 1},
    "biventricle": {"rings": 6, "around": 16, "layers": (1, 1)},
    "liver": {"shells": 3},
    "traction_beam_holzapfel_ogden": {"cells": (6, 2, 2)},
    "traction_beam_guccione": {"cells": (6, 2, 2)},
}
# As published, and by default; where each has the sizes of one of these it is left out.
NODES = {
    "once_clamped_beam": (390, 1025),
    "turned_beam": (390, 1025),
    "traction_beam_guccione": (390, 1595),
    "twisting_cube": (343, 729),
    "liver": (923, 3871),
    "left_ventricle": (1564, 4627),
    "left_ventricle_neo_hookean": (1564, 4627),
    "left_ventricle_segments": (1564, 4627),
}
SIZES = {
    **COARSE,
    **{name: {"cells": (3, 1, 1)} for name in BUILT_IN if name.endswith("clamped_beam")},
    "turned_beam": {"cells": (3, 1, 1)},
    "twisting_cube": {"cells": 2},
    # Every other ring, or segments would have no elements.
    "left_ventricle_segments": {"rings": 6, "around": 12, "layers": 1},
    "liver": {"shells": 2, "ligament_shells": 2},
}


SHARED = (
    "biventricle",
    "left_ventricle_neo_hookean",
    "liver",
    "left_ventricle_segments",
    "traction_beam_guccione",
    "traction_beam_holzapfel_ogden",
)


@pytest.mark.parametrize(
    "name",
    [
        # The others share their laws and loads.
        pytest.param(n, marks=pytest.mark.slow if n in SHARED else [])
        for n in sorted(COARSE)
    ],
)
def test_the_centre_is_solved(name):
    scene = BUILT_IN[name](**COARSE[name], order=1)
    solution = em.Simulator(scene).solve(scene.centre)
    assert Status(int(solution.status)) is Status.CONVERGED
    size = np.linalg.norm(solution.displacement, axis=1).max() / scene.mesh.size
    assert 0.01 < size < 0.5
    assert volume_ratio(scene, solution.displacement).min() > 0.5


@pytest.mark.parametrize("name", sorted(NODES))
def test_each_order_has_its_default_sizes(name):
    linear, quadratic = (BUILT_IN[name](order=order) for order in (1, 2))
    assert (len(linear.mesh.nodes), len(quadratic.mesh.nodes)) == NODES[name]
    assert (linear.mesh.order, quadratic.mesh.order) == (1, 2)
    assert quadratic.fingerprint == find_scene(name).fingerprint
    assert linear.parameters == quadratic.parameters


@pytest.mark.parametrize("name", sorted(BUILT_IN))
def test_there_is_no_third_order(name):
    with pytest.raises(
        InputError, match=r"order 3 of the elements; expected 1 \(linear\) or 2"
    ) as it:
        BUILT_IN[name](order=3)
    assert "\n" not in str(it.value)


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("name", sorted(BUILT_IN))
def test_a_coarse_scene_is_made_again_by_its_recipe(name, order):
    """Its sizes and its order, through JSON as in the files of emulators."""
    scene = BUILT_IN[name](**SIZES[name], order=order)
    assert scene.mesh.order == order
    assert scene.origin["order"] == order
    for origin in (dict(scene.origin), json.loads(json.dumps(dict(scene.origin)))):
        assert scene_from_origin(origin).fingerprint == scene.fingerprint
    other = BUILT_IN[name](**SIZES[name], order=3 - order)
    assert other.fingerprint != scene.fingerprint
    if scene.fibres is not None and name.startswith(("left", "biv")):
        count = len(scene.mesh.elements)
        assert scene.fibres.shape == ((count, 3) if order == 1 else (count, 4, 3))


def test_the_sizes_of_the_ventricles_rings_are_part_of_the_recipe():
    even, graded = (em.scenes.left_ventricle(3, 6, 1, grading=g) for g in (1.0, 1.5))
    assert even.fingerprint != graded.fingerprint
    for scene in (even, graded):
        assert scene_from_origin(scene.origin).fingerprint == scene.fingerprint
    # Rings by default are closer at the base, where a held wall bends; even ones on linear meshes.
    assert em.scenes.left_ventricle(3, 6, 1).fingerprint == graded.fingerprint
    linear = em.scenes.left_ventricle(3, 6, 1, order=1)
    assert len(linear.mesh.nodes) < len(even.mesh.nodes)
    np.testing.assert_array_equal(linear.mesh.nodes, even.mesh.nodes[: len(linear.mesh.nodes)])


def test_a_liver_of_quadratic_elements_hangs_from_springs():
    """Clamped, its stresses are infinite at the ligament's edge."""
    clamped, held = (em.scenes.liver(**SIZES["liver"], order=order) for order in (1, 2))
    assert [type(support) for support in clamped.supports] == [Support]
    assert held.supports == (ElasticSupport("ligament", 2.0),)
    soft = em.scenes.liver(**SIZES["liver"], ligament=0.5)
    assert soft.supports == (ElasticSupport("ligament", 0.5),)
    assert scene_from_origin(soft.origin).fingerprint == soft.fingerprint != held.fingerprint
    sprung = em.scenes.liver(**SIZES["liver"], order=1, ligament=0.5)
    assert sprung.supports == soft.supports
    assert scene_from_origin(sprung.origin).fingerprint == sprung.fingerprint


def area(mesh, name):
    """Of a facet set, curved facets included, mm2."""
    rule = facet_rule(mesh.order, 4)
    tangents = np.einsum("kai,qaj->kqji", mesh.nodes[mesh.facet_set(name)], rule.derivatives)
    normals = np.cross(tangents[:, :, 0], tangents[:, :, 1])
    return float((np.linalg.norm(normals, axis=-1) @ rule.weights).sum())


def test_livers_of_twice_the_shells_are_held_at_the_same_patch():
    """Or their solutions would not converge to one another."""
    coarse, fine = (em.scenes.liver(shells=shells).mesh for shells in (5, 10))
    assert area(fine, "ligament") == pytest.approx(area(coarse, "ligament"), rel=0.02)
    assert area(fine, "surface") == pytest.approx(area(coarse, "surface"), rel=0.02)
    assert len(fine.facet_set("ligament")) == 4 * len(coarse.facet_set("ligament"))
    assert 0.02 < area(fine, "ligament") / area(fine, "surface") < 0.1
    for mesh in (coarse, fine):
        held = np.unique(mesh.facet_set("ligament"))
        np.testing.assert_array_equal(np.sort(mesh.node_set("ligament")), held)


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(BUILT_IN))
def test_every_corner_of_the_box_is_solved(name):
    scene = find_scene(name)
    simulator = em.Simulator(scene)
    corners = list(product((0.0, 1.0), repeat=min(len(scene.parameters), 5)))
    if len(scene.parameters) > 5:  # of 2^18, the two ends of the diagonal and 30 at random
        rng = np.random.default_rng(0)
        rest = rng.integers(0, 2, (30, len(scene.parameters)))
        ends = np.outer((0, 1), np.ones(len(scene.parameters)))
        corners = [tuple(row) for row in np.vstack([ends, rest])]
    for corner in corners:
        solution = simulator.solve(scene.from_unit(jnp.array(corner)))
        assert Status(int(solution.status)) is Status.CONVERGED, corner


def filled(simulator: em.Simulator, **values: float) -> dict[str, float]:
    """Volumes in mL of the cavities at the centre of the box but for ``values``."""
    scene = simulator.scene
    centre = dict(zip(scene.parameter_names, scene.centre.tolist(), strict=True))
    u = simulator(scene.theta(**{**centre, **values}))
    cavities = [name for name in scene.mesh.facet_sets if "endocardium" in name]
    walls = {name: Cavity(scene.mesh, name) for name in cavities}
    return {name: float(cavity(u[cavity.nodes])) for name, cavity in walls.items()}


@pytest.mark.slow
def test_a_ventricle_fills_with_pressure_and_resists_by_its_fibres():
    scene = em.scenes.left_ventricle(**COARSE["left_ventricle"], order=1)
    pressure = scene.parameters[-1]
    assert (pressure.low, pressure.high) == (4.0 * KPA_PER_MMHG, 10.0 * KPA_PER_MMHG)
    simulator = em.Simulator(scene)
    rest = Cavity(scene.mesh, "endocardium").rest
    low, high = (filled(simulator, pressure=p)["endocardium"] for p in (0.6, 1.3))
    assert rest < low < high
    assert filled(simulator, pressure=1.3, a_f=10.0)["endocardium"] < high


def test_a_ventricle_of_other_dimensions_is_made_again_by_its_recipe():
    wall = (18.0, 48.0, 31.0, 57.0, 16.0)
    scene = em.scenes.left_ventricle(5, 12, 1, wall=wall, order=1)
    assert scene.mesh.nodes[:, 2].max() == pytest.approx(16.0)
    assert scene_from_origin(scene.origin).fingerprint == scene.fingerprint
    assert "wall" not in em.scenes.left_ventricle(5, 12, 1, order=1).origin


@pytest.mark.slow
def test_each_ventricle_has_its_own_pressure():
    scene = em.scenes.biventricle(**COARSE["biventricle"], order=1)
    fuller = em.scenes.biventricle(**COARSE["biventricle"], right_pressure=0.5, order=1)
    assert scene.fingerprint != fuller.fingerprint
    ours, theirs = filled(em.Simulator(scene)), filled(em.Simulator(fuller))
    assert ours["rv_endocardium"] < theirs["rv_endocardium"]
    assert ours["lv_endocardium"] > theirs["lv_endocardium"]  # the septum is pushed over


def twist(angle: float) -> float:
    """How far the upper corner of a beam's end moves sideways beyond the lower one, mm."""
    scene = em.scenes.traction_beam_guccione(cells=(6, 2, 2), fibre_angle=angle, order=1)
    u = em.Simulator(scene)(scene.centre)
    lower = int(np.linalg.norm(scene.mesh.nodes - [100.0, 0.0, 0.0], axis=1).argmin())
    upper = int(np.linalg.norm(scene.mesh.nodes - [100.0, 0.0, 10.0], axis=1).argmin())
    return float(u[upper, 1] - u[lower, 1])


@pytest.mark.slow
def test_fibres_at_an_angle_twist_the_beam():
    left, straight, right = (twist(angle) for angle in (-30.0, 0.0, 30.0))
    assert (left - straight) * (right - straight) < 0.0  # the mesh itself twists a little
