import numpy as np
import pytest

from emulator.geometry.generators.sphere import ball, ball_midpoints, triangle_lattice
from emulator.geometry.mesh import orient, signed_volumes


@pytest.mark.parametrize("shells", [1, 2, 5])
def test_a_ball_has_the_nodes_and_elements_it_says(shells):
    nodes, elements = ball(shells)
    assert len(nodes) == 1 + sum(10 * k**2 + 2 for k in range(1, shells + 1))
    assert len(elements) == 20 * shells**3
    radii = np.linalg.norm(nodes, axis=1) * shells
    np.testing.assert_allclose(radii, np.round(radii), atol=1e-12)
    faces = np.sort(elements[:, [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]]].reshape(-1, 3))
    _, counts = np.unique(faces, axis=0, return_counts=True)
    assert (counts == 1).sum() == 20 * shells**2
    assert signed_volumes(nodes, orient(nodes, elements)).min() > 0.0


def test_one_shell_is_the_icosahedron():
    nodes, elements = ball(1)
    edge = 4.0 / np.sqrt(10.0 + 2.0 * np.sqrt(5.0))  # of an icosahedron in the unit sphere
    volume = 5.0 / 12.0 * (3.0 + np.sqrt(5.0)) * edge**3
    assert signed_volumes(nodes, orient(nodes, elements)).sum() == pytest.approx(volume)


def test_triangle_lattice_divides_the_area():
    barycentric, triangles = triangle_lattice(3)
    np.testing.assert_allclose(barycentric.sum(axis=1), 1.0)
    corner = barycentric[triangles][:, :, :2]
    a, b = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    np.testing.assert_allclose(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0], 1.0 / 9.0)


def test_midpoints_lie_at_the_mean_radius():
    nodes = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 2.0, 0.0]])
    found = ball_midpoints(nodes)(np.array([[0, 2], [1, 2]]))
    np.testing.assert_allclose(found, [[0.0, 1.0, 0.0], np.array([1.5, 1.5, 0.0]) / np.sqrt(2.0)])
