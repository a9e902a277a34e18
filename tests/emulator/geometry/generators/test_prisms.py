import numpy as np
import pytest

from emulator.geometry.generators.body import extrude, stacked
from emulator.geometry.mesh import orient, signed_volumes


def test_two_prisms_agree_on_the_side_they_share():
    plane = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])
    nodes = np.concatenate([np.column_stack([plane, np.full(4, z)]) for z in (0.0, 1.0, 3.0)])
    elements = extrude(stacked(4, 2), np.array([[0, 1, 2], [3, 2, 1]]))
    elements = orient(nodes, elements)
    assert len(elements) == 2 * 2 * 3
    assert signed_volumes(nodes, elements).sum() == pytest.approx(3.0)
    faces = np.sort(elements[:, [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]]].reshape(-1, 3))
    _, counts = np.unique(faces, axis=0, return_counts=True)
    assert (counts == 1).sum() == 2 * 2 + 2 * 2 * 4  # two ends, and the sides' halves
