"""Surfaces as segmentations give them: closed, rough, their triangles of all shapes."""

from itertools import permutations, product

import meshio
import numpy as np

from emulator.geometry.generators.ellipsoid import HUMAN

INSIDE = (HUMAN.short_endocardium, HUMAN.long_endocardium)
OUTSIDE = (HUMAN.short_epicardium, HUMAN.long_epicardium)


def marching(level, half, step):
    """Triangles (t, 3, 3) of ``level(x) = 0`` by tetrahedra of a grid from -half to half (3,)."""
    half = np.asarray(half, dtype=float)
    axes = [np.arange(-reach, reach + step, step) + 0.137 for reach in half]
    shape = tuple(map(len, axes))
    x = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    value, number = level(x), np.arange(len(x)).reshape(shape)
    cells = {
        at: number[tuple(slice(a, n - 1 + a) for a, n in zip(at, shape, strict=True))].ravel()
        for at in product((0, 1), repeat=3)
    }
    walks = [
        np.cumsum(np.eye(3, dtype=int)[list(order)], axis=0) for order in permutations(range(3))
    ]
    tetrahedra = np.concatenate(
        [np.stack([cells[0, 0, 0], *(cells[tuple(at)] for at in walk)], axis=1) for walk in walks]
    )
    below = value[tetrahedra] < 0.0
    found = []
    for count in (1, 2, 3):
        rows = below.sum(axis=1) == count
        order = np.argsort(~below[rows], axis=1, kind="stable")  # those below first
        corners = np.take_along_axis(tetrahedra[rows], order, axis=1)
        pairs = {1: (0, 1, 0, 2, 0, 3), 2: (0, 2, 0, 3, 1, 3, 1, 2), 3: (0, 3, 1, 3, 2, 3)}[count]
        ends = np.sort(corners[:, pairs].reshape(len(corners), -1, 2), axis=2)
        a, b = value[ends[..., 0]], value[ends[..., 1]]
        share = (a / (a - b))[..., None]
        points = x[ends[..., 0]] + share * (x[ends[..., 1]] - x[ends[..., 0]])
        found += [points[:, :3], points[:, [0, 2, 3]]] if count == 2 else [points]
    return np.concatenate(found)


def ellipsoid(semi_axes, step=2.5, middle=(0.0, 0.0, 0.0)):
    """A rough closed ellipsoid of revolution about z, (t, 3, 3) mm."""
    short, long = semi_axes
    scale = np.array([short, short, long])
    soup = marching(lambda x: np.linalg.norm(x / scale, axis=1) - 1.0, scale + step, step)
    return soup + np.asarray(middle)


def write(path, soup):
    """Write triangles (t, 3, 3) to a file of surfaces; the path."""
    rows = np.arange(3 * len(soup)).reshape(-1, 3)
    meshio.write(path, meshio.Mesh(soup.reshape(-1, 3), [("triangle", rows)]))
    return path
