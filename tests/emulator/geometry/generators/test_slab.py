import numpy as np
import pytest

from emulator.core.errors import InputError
from emulator.geometry.generators.box import cooks_membrane, slab
from geometry_support import assert_sound, volume

# Shoelace formula: trapezium of parallel sides 44 and 16 mm, 48 mm apart.
COOKS_AREA = 0.5 * (44.0 + 16.0) * 48.0


@pytest.mark.parametrize("order", [1, 2])
def test_cooks_membrane_is_sound(order):
    mesh = cooks_membrane((4, 6), thickness=2.0, order=order)
    assert_sound(mesh)
    assert volume(mesh) == pytest.approx(2.0 * COOKS_AREA)
    x, y, z = mesh.nodes.T
    np.testing.assert_allclose(x[mesh.node_set("left")], 0.0)
    np.testing.assert_allclose(x[mesh.node_set("right")], 48.0)
    bottom, top = mesh.node_set("bottom"), mesh.node_set("top")
    np.testing.assert_allclose(y[bottom], 44.0 / 48.0 * x[bottom], atol=1e-12)
    np.testing.assert_allclose(y[top], 44.0 + 16.0 / 48.0 * x[top])
    np.testing.assert_allclose(z[mesh.node_set("front")], 0.0)
    np.testing.assert_allclose(z[mesh.node_set("back")], 2.0)
    np.testing.assert_array_equal(mesh.node_set("all"), np.arange(len(mesh.nodes)))
    assert np.linalg.norm(mesh.nodes[:, :2] - [48.0, 52.0], axis=1).min() < 1e-12


def test_cells_of_a_square_have_both_diagonals():
    mesh = slab(((0, 0), (1, 0), (1, 1), (0, 1)), (1, 1))
    assert len(mesh.nodes) == 10
    assert len(mesh.elements) == 12


def test_bad_shapes_are_named():
    with pytest.raises(InputError, match="not a convex quadrilateral"):
        slab(((0, 0), (0, 1), (1, 1), (1, 0)), (1, 1))
    with pytest.raises(InputError, match="expected four finite points"):
        slab(((0, 0), (1, 0), (1, 1)), (1, 1))
    with pytest.raises(InputError, match=r"cells \(1, 0\)"):
        cooks_membrane((1, 0))
