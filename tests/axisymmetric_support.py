r"""Land et al. (2015), problem 3, by another discretisation: a reference for ours.

The ellipsoid, its fibres and its loads are axisymmetric, so the deformation is
:math:`(R, \Theta, Z) \to (R + u_r,\ \Theta + \varphi,\ Z + u_z)`, functions of R and Z,

.. math::
    F = \begin{pmatrix} 1 + u_{r,R} & 0 & u_{r,Z} \\
        r \varphi_{,R} & r/R & r \varphi_{,Z} \\ u_{z,R} & 0 & 1 + u_{z,Z} \end{pmatrix}, \qquad
    \Pi = \int \left[W + \tfrac12 T_a (I_{4f} - 1) + p (J - 1)\right] 2 \pi R\, dR\, dZ - P V .

Biquadratic displacements, bilinear pressures, on quadrilaterals of the exact geometry; Newton's
method up a ramp of loads. Nothing of the packages is used.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sparse
from scipy.sparse.linalg import spsolve

C, B_F, B_T, B_FS = 2.0, 8.0, 2.0, 4.0  # kPa, 1
PRESSURE, TENSION = 15.0, 60.0  # kPa
_GRADING = 1.5  # elements are smaller at the base, which is held
_SETTLED = 1e-9  # mm, and radians


class Grid(NamedTuple):
    """Elements between depths and fractions of the way from apex to base, nodes layer by layer.

    corners : (m, 4) depth and fraction at which an element begins and ends. nodes : (m, 9),
    pressures : (m, 4). inner : (k, 3) nodes of the endocardium's edges, of fractions ``ends``
    (k, 2). shape : of the nodes.
    """

    corners: np.ndarray
    nodes: np.ndarray
    pressures: np.ndarray
    inner: np.ndarray
    ends: np.ndarray
    shape: tuple[int, int]


def grid(layers, rings):
    """Elements through the wall and from apex to base."""
    s = 1.0 - (1.0 - np.arange(rings + 1) / rings) ** _GRADING
    t = np.arange(layers + 1) / layers
    shape = (2 * layers + 1, 2 * rings + 1)
    number = np.arange(shape[0] * shape[1]).reshape(shape)
    pressure = np.arange((layers + 1) * (rings + 1)).reshape(layers + 1, rings + 1)
    places = [(i, j) for i in range(layers) for j in range(rings)]
    return Grid(
        np.array([[t[i], t[i + 1], s[j], s[j + 1]] for i, j in places]),
        np.array([number[2 * i : 2 * i + 3, 2 * j : 2 * j + 3].ravel() for i, j in places]),
        np.array([pressure[i : i + 2, j : j + 2].ravel() for i, j in places]),
        np.array([number[0, 2 * j : 2 * j + 3] for j in range(rings)]),
        np.array([[s[j], s[j + 1]] for j in range(rings)]),
        shape,
    )


def place(t, s):
    """R and Z in mm, and the angle u of the ellipsoid of depth ``t``."""
    long = 17.0 + 3.0 * t
    u = jnp.pi - s * (jnp.pi - jnp.arccos(5.0 / long))
    return jnp.array([(7.0 + 3.0 * t) * jnp.sin(u), long * jnp.cos(u)]), u


def linear(x):
    return jnp.array([1.0 - x, x])


def quadratic(x):
    return jnp.array([(1 - x) * (1 - 2 * x), 4 * x * (1 - x), x * (2 * x - 1)])


def frame(t, s):
    """The fibre and two directions across, rows (3, 3) in R, Theta, Z."""
    u = place(t, s)[1]
    meridian = jnp.array([(7.0 + 3.0 * t) * jnp.cos(u), 0.0, -(17.0 + 3.0 * t) * jnp.sin(u)])
    meridian = meridian / jnp.linalg.norm(meridian)
    circle, alpha = jnp.array([0.0, 1.0, 0.0]), jnp.radians(90.0 - 180.0 * t)
    fibre = jnp.sin(alpha) * meridian + jnp.cos(alpha) * circle
    across = jnp.cos(alpha) * meridian - jnp.sin(alpha) * circle
    return jnp.stack([fibre, across, jnp.cross(fibre, across)])


def density(F, p, directions, load):
    """Energy per reference volume, kPa."""
    E = directions @ (0.5 * (F.T @ F - jnp.eye(3))) @ directions.T
    Q = B_F * E[0, 0] ** 2 + 2.0 * B_FS * (E[0, 1] ** 2 + E[0, 2] ** 2)
    Q = Q + B_T * (E[1, 1] ** 2 + E[2, 2] ** 2 + 2.0 * E[1, 2] ** 2)
    J = jnp.dot(F[0], jnp.cross(F[1], F[2]))
    return 0.5 * C * jnp.expm1(Q) + load * TENSION * E[0, 0] + p * (J - 1.0)


_GAUSS = np.polynomial.legendre.leggauss(4)
_POINTS, _WEIGHTS = (_GAUSS[0] + 1.0) / 2.0, _GAUSS[1] / 2.0
_SQUARE = jnp.array([[a, b] for a in _POINTS for b in _POINTS])
_SQUARE_WEIGHTS = jnp.array([a * b for a in _WEIGHTS for b in _WEIGHTS])


def element(values, corners, load):
    """Energy in mN mm of an element; ``values`` 9 times (u_r, phi, u_z), then 4 pressures."""
    u, p = values[:27].reshape(9, 3), values[27:]
    first, last, start, end = corners

    def at(xi):
        return first + (last - first) * xi[0], start + (end - start) * xi[1]

    def point(xi, weight):
        shape = lambda x: jnp.outer(quadratic(x[0]), quadratic(x[1])).ravel()
        X, map_ = place(*at(xi))[0], jax.jacfwd(lambda x: place(*at(x))[0])(xi)
        det = map_[0, 0] * map_[1, 1] - map_[0, 1] * map_[1, 0]
        inverse = jnp.array([[map_[1, 1], -map_[0, 1]], [-map_[1, 0], map_[0, 0]]]) / det
        H = u.T @ jax.jacfwd(shape)(xi) @ inverse
        r = X[0] + shape(xi) @ u[:, 0]
        F = jnp.array(
            [
                [1.0 + H[0, 0], 0.0, H[0, 1]],
                [r * H[1, 0], r / X[0], r * H[1, 1]],
                [H[2, 0], 0.0, 1.0 + H[2, 1]],
            ]
        )
        pressure = jnp.outer(linear(xi[0]), linear(xi[1])).ravel() @ p
        W = density(F, pressure, frame(*at(xi)), load)
        return W * 2.0 * jnp.pi * X[0] * jnp.abs(det) * weight

    return jnp.sum(jax.vmap(point)(_SQUARE, _SQUARE_WEIGHTS))


def edge(values, ends, load):
    """``-P V`` in mN mm of what lies inside an edge of the endocardium."""
    u = values.reshape(3, 3)

    def point(xi, weight):
        where = lambda x: place(0.0, ends[0] + (ends[1] - ends[0]) * x)[0]
        r = where(xi)[0] + quadratic(xi) @ u[:, 0]
        rise = jax.jacfwd(where)(xi)[1] + jax.jacfwd(quadratic)(xi) @ u[:, 2]
        return jnp.pi * r**2 * rise * weight

    return -load * PRESSURE * jnp.sum(jax.vmap(point)(jnp.asarray(_POINTS), jnp.asarray(_WEIGHTS)))


def apexes(layers, rings, steps=20):
    """Deformed z in mm of the apex, inside and outside."""
    g = grid(layers, rings)
    count = g.shape[0] * g.shape[1]
    unknowns = 3 * count + g.pressures.max() + 1
    dofs = lambda nodes: (3 * nodes[:, :, None] + np.arange(3)).reshape(len(nodes), -1)
    bulk, wall = np.concatenate([dofs(g.nodes), 3 * count + g.pressures], axis=1), dofs(g.inner)
    parts = ((element, bulk, g.corners), (edge, wall, g.ends))
    each = [
        jax.jit(jax.vmap(lambda *a, f=f: (jax.grad(f)(*a), jax.hessian(f)(*a)), (0, 0, None)))
        for f, _, _ in parts
    ]
    number = np.arange(count).reshape(g.shape)
    held = np.concatenate([(3 * number[:, -1:] + np.arange(3)).ravel(), 3 * number[:, 0]])
    free = np.setdiff1d(np.arange(unknowns), held)
    x = np.zeros(unknowns)
    for load in np.arange(1, steps + 1) / steps:
        for _ in range(20):
            r, rows, columns, entries = np.zeros(unknowns), [], [], []
            for run, (_, where, data) in zip(each, parts, strict=True):
                slope, curvature = run(x[where], data, load)
                np.add.at(r, where, np.asarray(slope))
                rows.append(np.repeat(where, where.shape[1], axis=1).ravel())
                columns.append(np.tile(where, (1, where.shape[1])).ravel())
                entries.append(np.asarray(curvature).ravel())
            ij = (np.concatenate(rows), np.concatenate(columns))
            K = sparse.csc_matrix((np.concatenate(entries), ij), (unknowns, unknowns))
            move = spsolve(K[free][:, free], -r[free])
            x[free] += move
            if np.abs(move).max() < _SETTLED:
                break
        else:
            raise RuntimeError(f"no equilibrium at {load} of the loads")
    return -17.0 + x[3 * number[0, 0] + 2], -20.0 + x[3 * number[-1, 0] + 2]
