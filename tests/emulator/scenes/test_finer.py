"""A scene on the next finer mesh."""

from dataclasses import replace

import numpy as np
import pytest

import emulator as em
from emulator.geometry.fibres import of_elements
from emulator.scenes.finer import finer


@pytest.mark.parametrize("order", [1, 2])
def test_fibres_of_a_rule_are_made_anew(order):
    coarse = em.scenes.left_ventricle(4, 10, 1, order=order)
    fine = finer(coarse).scene
    expected = coarse.fibre_rule.directions(fine.mesh)[0]
    np.testing.assert_allclose(fine.fibres, expected, atol=1e-12)


def test_fibres_that_replaced_a_rules_are_continued():
    coarse = em.scenes.left_ventricle(4, 10, 1)
    along = np.zeros_like(coarse.fibres)
    along[..., 0] = 1.0
    other = replace(coarse, fibres=along, origin={})
    np.testing.assert_allclose(finer(other).scene.fibres[..., 0], 1.0)
    constant = replace(coarse, fibres=of_elements(coarse.fibres), origin={})
    made = coarse.fibre_rule.directions(finer(constant).scene.mesh)[0]
    assert np.abs(finer(constant).scene.fibres - made).max() > 0.05


def test_a_mesh_without_the_rules_sets_keeps_its_fibres():
    scene = em.scenes.left_ventricle(4, 10, 1)
    sets = {name: facets for name, facets in scene.mesh.facet_sets.items() if name != "epicardium"}
    other = replace(scene, mesh=replace(scene.mesh, facet_sets=sets), origin={})
    assert finer(other).scene.fibres.shape[0] == 8 * len(scene.mesh.elements)


def test_a_rule_is_not_part_of_what_a_scene_is():
    scene = em.scenes.left_ventricle(4, 10, 1)
    assert replace(scene, fibre_rule=None).fingerprint == scene.fingerprint
