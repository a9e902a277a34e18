from itertools import product

import jax.numpy as jnp
import numpy as np
import pytest

import emulator as em
from emulator.catalogue import find_scene, scene_from_origin
from emulator.fem import Status
from emulator.fem.functional import volume_ratio
from emulator.geometry.cavity import Cavity
from emulator.scenes import BUILT_IN
from emulator.scenes.loads import KPA_PER_MMHG

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
    scene = BUILT_IN[name](**COARSE[name])
    solution = em.Simulator(scene).solve(scene.centre)
    assert Status(int(solution.status)) is Status.CONVERGED
    size = np.linalg.norm(solution.displacement, axis=1).max() / scene.mesh.size
    assert 0.01 < size < 0.5
    assert volume_ratio(scene, solution.displacement).min() > 0.5


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
    scene = em.scenes.left_ventricle(**COARSE["left_ventricle"])
    pressure = scene.parameters[-1]
    assert (pressure.low, pressure.high) == (4.0 * KPA_PER_MMHG, 10.0 * KPA_PER_MMHG)
    simulator = em.Simulator(scene)
    rest = Cavity(scene.mesh, "endocardium").rest
    low, high = (filled(simulator, pressure=p)["endocardium"] for p in (0.6, 1.3))
    assert rest < low < high
    assert filled(simulator, pressure=1.3, a_f=10.0)["endocardium"] < high


def test_a_ventricle_of_other_dimensions_is_made_again_by_its_recipe():
    wall = (18.0, 48.0, 31.0, 57.0, 16.0)
    scene = em.scenes.left_ventricle(5, 12, 1, wall=wall)
    assert scene.mesh.nodes[:, 2].max() == pytest.approx(16.0)
    assert scene_from_origin(scene.origin).fingerprint == scene.fingerprint
    assert "wall" not in em.scenes.left_ventricle(5, 12, 1).origin


@pytest.mark.slow
def test_each_ventricle_has_its_own_pressure():
    scene = em.scenes.biventricle(**COARSE["biventricle"])
    fuller = em.scenes.biventricle(**COARSE["biventricle"], right_pressure=0.5)
    assert scene.fingerprint != fuller.fingerprint
    ours, theirs = filled(em.Simulator(scene)), filled(em.Simulator(fuller))
    assert ours["rv_endocardium"] < theirs["rv_endocardium"]
    assert ours["lv_endocardium"] > theirs["lv_endocardium"]  # the septum is pushed over


def twist(angle: float) -> float:
    """How far the upper corner of a beam's end moves sideways beyond the lower one, mm."""
    scene = em.scenes.traction_beam_guccione(cells=(6, 2, 2), fibre_angle=angle)
    u = em.Simulator(scene)(scene.centre)
    lower = int(np.linalg.norm(scene.mesh.nodes - [100.0, 0.0, 0.0], axis=1).argmin())
    upper = int(np.linalg.norm(scene.mesh.nodes - [100.0, 0.0, 10.0], axis=1).argmin())
    return float(u[upper, 1] - u[lower, 1])


@pytest.mark.slow
def test_fibres_at_an_angle_twist_the_beam():
    left, straight, right = (twist(angle) for angle in (-30.0, 0.0, 30.0))
    assert (left - straight) * (right - straight) < 0.0  # the mesh itself twists a little
