"""Our FEM against FEniCSx, whose residual and tangent come from UFL.

``CALIBRATE_FENICS`` names an interpreter that has dolfinx with PETSc.
"""

import os
from pathlib import Path

import jax
import numpy as np
import pytest

import emulator as em
from emulator.fem import uniform

STUDIES = Path(__file__).parents[1]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["beam", "quadratic beam", "cube", "ventricle"])
def test_displacements_and_gradients_are_those_of_fenicsx(name, request, monkeypatch):
    if not os.environ.get("CALIBRATE_FENICS"):
        pytest.skip("CALIBRATE_FENICS names no interpreter with FEniCSx")
    monkeypatch.syspath_prepend(str(STUDIES))
    from studies.accuracy_vs_time.refinement import quadratic
    from studies.common import fenicsx

    scene = request.getfixturevalue(name.split()[-1])
    scene = quadratic(scene) if name.startswith("quadratic") else scene
    thetas = uniform(scene, 2, jax.random.key(3))
    observed = np.flatnonzero(~scene.held.any(axis=1))[[0, 3, -1]]
    _, _, cold, warm = fenicsx.compare(scene, observed, thetas, os.environ["CALIBRATE_FENICS"])
    # Newton's method stops at a relative residual of 1e-11 in both.
    assert cold["difference"] < 1e-9
    assert cold["gradient_difference"] < 1e-9
    assert warm["displacement"] == pytest.approx(cold["displacement"], abs=1e-9)


@pytest.mark.parametrize("name", ["beam", "cube", "ventricle"])
def test_a_refined_mesh_is_the_same_body(name, request, monkeypatch):
    monkeypatch.syspath_prepend(str(STUDIES))
    from studies.accuracy_vs_time.refinement import quadratic, refined

    scene = request.getfixturevalue(name)
    finer, curved = refined(scene), quadratic(scene)
    assert len(finer.mesh.elements) == 8 * len(scene.mesh.elements)
    assert finer.mesh.nodes == pytest.approx(curved.mesh.nodes)
    for other in (finer, curved):
        weights = other.discretisation.weights.reshape(len(scene.mesh.elements), -1).sum(axis=1)
        assert weights == pytest.approx(scene.discretisation.weights.sum(axis=1))
        # The same facets are held and pressed.
        held = other.held.all(axis=1)[other.mesh.surface[:, :3]].all(axis=1)
        assert _area(other, other.mesh.surface[held]) == pytest.approx(
            _area(scene, scene.mesh.surface[scene.held.all(axis=1)[scene.mesh.surface].all(axis=1)])
        )
        for facet_set, rows in scene.mesh.facet_sets.items():
            assert _area(other, other.mesh.facet_set(facet_set)) == pytest.approx(
                _area(scene, rows)
            )


def _area(scene: em.Scene, facets: np.ndarray) -> float:
    """Area of straight facets in mm2, by their corners."""
    a, b, c = scene.mesh.nodes[facets[:, :3]].transpose(1, 0, 2)
    return 0.5 * float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())
