"""An image of the wall: contours with voxel noise, and a mesh fitted to them.

Contours lie on slices ``_APART`` mm apart, ``_AROUND`` points each, on both surfaces; each point
is off by a normal error of ``VOXEL`` mm along every axis. A surface is seen from the middle of the
cavity, and its distance is fitted by polynomials of the direction of degree ``_DEGREE``. Fits are
linear, and the true surface is taken to be its own fit: what is fitted is the error, by which the
mesh moves, linearly through the wall. The base stays a plane.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations_with_replacement

import numpy as np

import emulator as em

VOXEL = 1.25
_APART, _AROUND, _DEGREE = 8.0, 24, 4
_RIDGE = 1e-3


def fitted(mesh: em.Mesh, rng: np.random.Generator) -> em.Mesh:
    """``mesh``, the wall as it is, as the image has it."""
    base = mesh.nodes[:, 2].max()
    middle = np.array([0.0, 0.0, base - 0.4 * np.ptp(mesh.nodes[:, 2])])
    ray = mesh.nodes - middle
    distance = np.linalg.norm(ray, axis=1, keepdims=True)
    direction = ray / distance
    moved = [
        _monomials(direction) @ _fit(mesh.nodes[np.unique(mesh.facet_set(wall))] - middle, rng)
        for wall in ("endocardium", "epicardium")
    ]
    across = depth(mesh)
    step = direction * ((1.0 - across) * moved[0] + across * moved[1])[:, None]
    step[mesh.nodes[:, 2] > base - 1e-6, 2] = 0.0
    return replace(mesh, nodes=mesh.nodes + step)


def depth(mesh: em.Mesh) -> np.ndarray:
    """Where each node of a wall of one quadratic layer lies in it: 0, 0.5 or 1, (n,)."""
    found = np.full(len(mesh.nodes), 0.5)
    found[mesh.facet_set("endocardium")], found[mesh.facet_set("epicardium")] = 0.0, 1.0
    return found


def _fit(surface: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Coefficients of the error of a surface, of nodes (k, 3) seen from the middle."""
    height = np.arange(surface[:, 2].max(), surface[:, 2].min(), -_APART)
    angle = np.linspace(0.0, 2.0 * np.pi, _AROUND, endpoint=False)
    around = np.arctan2(surface[:, 1], surface[:, 0])
    points = []
    for z in height:
        for phi in angle:
            apart = np.abs(np.angle(np.exp(1j * (around - phi)))) * np.hypot(*surface[:, :2].T)
            points.append(surface[np.argmin(np.hypot(apart, surface[:, 2] - z))])
    towards = np.asarray(points) / np.linalg.norm(points, axis=1, keepdims=True)
    error = np.sum(rng.normal(0.0, VOXEL, towards.shape) * towards, axis=1)
    terms = _monomials(towards)
    normal = terms.T @ terms + _RIDGE * len(terms) * np.eye(terms.shape[1])
    return np.linalg.solve(normal, terms.T @ error)


def _monomials(direction: np.ndarray) -> np.ndarray:
    """Of degree ``_DEGREE`` and one less, (k, t): on the sphere they span all lower ones."""
    powers = [
        np.prod(direction[:, list(of)], axis=1)
        for degree in (_DEGREE - 1, _DEGREE)
        for of in combinations_with_replacement(range(3), degree)
    ]
    return np.stack(powers, axis=1)
