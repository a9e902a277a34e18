"""Several bodies as one mesh: nodes, sets, elements, and what is refused."""

import numpy as np
import pytest

import emulator as em
from emulator.core.errors import InputError
from emulator.geometry.generators.box import box
from emulator.geometry.refinement import to_quadratic

CUBE, BEAM = box((2.0, 2.0, 2.0), (1, 1, 1)), box((4.0, 1.0, 1.0), (2, 1, 1))


def test_bodies_keep_their_shape_order_and_sets():
    both = em.side_by_side({"cube": CUBE, "beam": BEAM}, gap=1.5)
    first = len(CUBE.nodes)
    np.testing.assert_array_equal(both.mesh.nodes[:first], CUBE.nodes)
    np.testing.assert_allclose(both.mesh.nodes[first:], BEAM.nodes + [3.5, 0.0, 0.0], atol=1e-15)
    np.testing.assert_array_equal(both.mesh.elements[len(CUBE.elements) :], BEAM.elements + first)
    np.testing.assert_array_equal(both.mesh.node_set("beam.left"), BEAM.node_set("left") + first)
    np.testing.assert_array_equal(both.mesh.facet_set("cube.top"), CUBE.facet_set("top"))
    np.testing.assert_array_equal(both.nodes("beam"), first + np.arange(len(BEAM.nodes)))
    assert len(both.mesh.facet_set("cube")) == 12
    np.testing.assert_array_equal(both.mesh.node_set("cube"), np.unique(CUBE.surface))
    assert "top" not in both.mesh.node_sets


def test_elements_and_values_of_a_body():
    both = em.side_by_side({"cube": CUBE, "beam": BEAM}, gap=1.0)
    np.testing.assert_array_equal(both.elements("cube"), np.arange(6))
    np.testing.assert_array_equal(both.elements("beam"), 6 + np.arange(12))
    fibres = {"beam": np.tile([0.0, 1.0, 0.0], (12, 1)), "cube": np.tile([1.0, 0.0, 0.0], (6, 1))}
    np.testing.assert_array_equal(both.stacked(fibres)[both.elements("beam")], fibres["beam"])
    with pytest.raises(InputError, match="body 'heart' is unknown; known: cube, beam"):
        both.elements("heart")
    with pytest.raises(InputError, match="no values for 'cube'"):
        both.stacked({"beam": fibres["beam"]})
    with pytest.raises(InputError, match=r"'beam' have shape \(6, 3\); it has 12 elements"):
        both.stacked({"cube": fibres["cube"], "beam": fibres["cube"]})


def test_quadratic_bodies():
    both = em.side_by_side({"a": to_quadratic(CUBE), "b": to_quadratic(CUBE)}, gap=1.0)
    assert both.mesh.order == 2
    assert both.mesh.facet_set("b.top").shape == (2, 6)


@pytest.mark.parametrize(
    ("meshes", "gap", "words"),
    [
        ({}, 1.0, "give one mesh or more"),
        ({"a": CUBE, "b": CUBE}, None, "'a' and 'b' have 8 nodes at the same places"),
        ({"a": CUBE, "b": CUBE}, 0.0, "gap is 0.0 mm; it must be above 0"),
        ({"a": CUBE, "b": to_quadratic(CUBE)}, 1.0, "'a' has tetrahedra of order 1 and 'b' of"),
        ({"a.b": CUBE}, 1.0, "body 'a.b': a name has letters"),
        ({"a:b": CUBE}, 1.0, "body 'a:b': a name has letters"),
    ],
)
def test_what_is_refused(meshes, gap, words):
    with pytest.raises(InputError) as error:
        em.side_by_side(meshes, gap=gap)
    assert words in str(error.value)
    assert "\n" not in str(error.value)
