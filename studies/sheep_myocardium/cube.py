r"""A cube between plates as a scene, and what a formula makes of it.

One plate is held; the other, a height :math:`H` above it, moves by :math:`H` times the amounts of
shear along y and z and of stretch along x, the plates' normal. The formula is that of a homogeneous
deformation, isochoric, with no lateral traction when stretched:

.. math:: F_y = A\, P_{yx}(I + \gamma\, e_y \otimes e_x), \qquad
          F_x = \frac{A}{\lambda} \left[\sigma_{xx} - \tfrac12 (\sigma_{yy} + \sigma_{zz})\right],
          \quad \sigma = P F^T, \quad F = \mathrm{diag}(\lambda, \lambda^{-1/2}, \lambda^{-1/2})

with the area :math:`A` of a plate. Glued plates make FEM's forces differ from it by tens of
percent, and turn tissue unevenly: where all fibres of a homogeneous cube begin to be pulled at one
angle, in a glued one they do so bit by bit. The formula is therefore the mean over fibres whose
two angles miss theirs by 3 degrees (sd), by the rule of five nodes that is exact for cubics,

.. math:: E[F] \approx \tfrac13 F(0) + \tfrac16 \sum F(\pm\sqrt3\, \mathrm{sd}\; e_i).

Without it, how far FEM is from the formula has a kink there, at another angle for each point.

Its stresses are those of :func:`emulator.specimens.homogeneous.homogeneous_stresses` in the same
states (tests/test_myocardium_process.py). They are not taken from there, since a specimen is one
program a heart, and here angles are unknowns and amounts are arrays, so that one serves all hearts.
"""

from __future__ import annotations

from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np

import emulator as em

CELLS = 3
"""Along an edge, of six quadratic tetrahedra each: 343 nodes."""
KAPPA = 100.0  # kPa: shear moduli are about 1
AMOUNTS = ("shear_y", "shear_z", "stretch")
"""Of the modes of a cube, in their order."""
MATERIAL = (
    em.Parameter("a", "kPa", 0.05, 5.0, "log"),
    em.Parameter("b", "", 0.5, 40.0, "log"),
    em.Parameter("a_f", "kPa", 0.001, 12.0),
    em.Parameter("b_f", "", 0.5, 40.0, "log"),
    em.Parameter("a_s", "kPa", 0.001, 6.0),
    em.Parameter("b_s", "", 0.5, 40.0, "log"),
    em.Parameter("a_fs", "kPa", 0.001, 3.0),
    em.Parameter("b_fs", "", 0.5, 40.0, "log"),
)
SPREAD = 3.0
"""Degrees by which fibres of the formula's cube miss their angles, sd."""
_NODES = np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]]) * np.sqrt(3.0)
_WEIGHTS = np.array([2, 1, 1, 1, 1]) / 6.0
ANGLES = (
    em.Parameter("in_plane", "deg", -45.0, 45.0),
    em.Parameter("out_of_plane", "deg", -45.0, 45.0),
)
"""By which the fibres of a cube miss the direction it was cut along: towards s, then towards n."""
_MOVED = tuple(em.Parameter(name, "", -0.7, 0.7) for name in AMOUNTS)
# Fibre, sheet and normal are axes 0, 1, 2; of each cube those along x (the plates' normal), y, z.
_CUT = ((0, 1, 2), (1, 0, 2), (2, 0, 1))


def _frame(cube: int) -> tuple[np.ndarray, ...]:
    """Fibre and sheet in the cube numbered ``cube``, and the axes of the angles, (3,) each.

    About the first axis fibres turn towards the sheet, about the second towards the normal.
    """
    f, s, n = np.eye(3)[np.argsort(_CUT[cube])]
    return f, s, np.cross(f, s), np.cross(f, n)


def scene(cube: int, sizes: np.ndarray, cells: int = CELLS) -> em.Scene:
    """The cube numbered ``cube`` from 0, of ``sizes`` (3,) mm as in the files."""
    width, depth, height = sizes
    mesh = em.generators.box((height, width, depth), (cells,) * 3, 2)
    f, s, across, along = (np.tile(v, (len(mesh.elements), 1)) for v in _frame(cube))
    one = np.ones(len(mesh.elements))
    plates = tuple(
        em.Support("right", height * np.eye(3)["xyz".index(axis)], axis, amount=amount)
        for axis, amount in zip("yzx", AMOUNTS, strict=True)
    )
    return em.Scene(
        f"cube {cube + 1}",
        mesh,
        em.find_law("holzapfel_ogden_orthotropic"),
        (*MATERIAL, *ANGLES, *_MOVED),
        supports=(em.Support("left"), *plates),
        constants={"kappa": KAPPA},
        fibres=f,
        sheets=s,
        angles=(
            em.scenes.FibreAngles(across, {"in_plane": one}),
            em.scenes.FibreAngles(along, {"out_of_plane": one}),
        ),
        dilatation="mean",
    )


@lru_cache
def _law_of() -> em.Scene:
    """A scene of a cube, for its law and its box."""
    return scene(0, np.ones(3), cells=1)


def turned_to(number: int, x: jax.Array) -> jax.Array:
    """Fibre and sheet (2, 3) of a cube at a position (p,) in the box."""
    f, s, *axes = _frame(number)
    directions, values = jnp.stack([f, s]), _law_of().resolve(theta_of(x))
    for axis, name in zip(axes, ("in_plane", "out_of_plane"), strict=True):
        angle, n = jnp.deg2rad(values[name]), jnp.asarray(axis)
        across, along = jnp.cross(n, directions), (directions @ n)[:, None] * n
        directions = along + jnp.cos(angle) * (directions - along) + jnp.sin(angle) * across
    return directions


def theta_of(x: jax.Array) -> jax.Array:
    """Theta of an unmoved cube at a position (p,) in the box."""
    return _law_of().from_unit(jnp.concatenate([0.5 * (x + 1.0), 0.5 * jnp.ones(len(AMOUNTS))]))


def homogeneous(amounts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Displacement gradients (3, j, 3, 3) of a cube's modes, and what its force is of P.

    Parameters
    ----------
    amounts : (3, j) of each mode.

    Returns
    -------
    H, and C (3, j, 3, 3) with which the force over the area is C : P.
    """
    H, C = np.zeros((2, *amounts.shape, 3, 3))
    for mode in (0, 1):
        H[mode, :, 1 + mode, 0] = amounts[mode]
        C[mode, :, 1 + mode, 0] = 1.0
    stretch = 1.0 + amounts[2]
    F = np.stack([stretch, stretch**-0.5, stretch**-0.5], axis=1)
    rows = np.arange(3)
    H[2][:, rows, rows] = F - 1.0
    C[2][:, rows, rows] = F / stretch[:, None] * [1.0, -0.5, -0.5]
    return H, C


def formula(x: jax.Array, H: jax.Array, C: jax.Array, area: jax.Array) -> jax.Array:
    """Homogeneous forces (c, 3 j) in N of cubes, their modes one after the other.

    Parameters
    ----------
    x : (c, p) positions in the box, of which the material is the first's. H, C : (c, 3, j, 3, 3),
        see :func:`homogeneous`. area : (c,) mm2 of a plate.
    """
    law, values = _law_of().law, _law_of().resolve(theta_of(x[0]))
    parameters = [values[name] for name in law.parameters]
    stress = jax.grad(lambda h, d: law.energy(em.laws.Strain(h, directions=d), *parameters))
    cubes, count, nodes = len(x), H.shape[1] * H.shape[2], len(_NODES)
    missed = np.zeros((nodes, x.shape[1]))
    missed[:, len(MATERIAL) :] = SPREAD / ANGLES[0].high * _NODES
    directions = [jax.vmap(turned_to, (None, 0))(k, x[k] + missed) for k in range(cubes)]
    # All points are one batch, which is a tenth faster than one a cube.
    shape = (cubes, nodes, count)
    each = jnp.broadcast_to(jnp.stack(directions)[:, :, None], (*shape, 2, 3))
    every = jnp.broadcast_to(H.reshape(cubes, 1, count, 3, 3), (*shape, 3, 3))
    flat = (every.reshape(-1, 3, 3), each.reshape(-1, 2, 3))
    P = jax.vmap(stress)(*flat).reshape(*shape, 3, 3)
    forces = jnp.einsum("m,ckij,cmkij->ck", _WEIGHTS, C.reshape(cubes, count, 3, 3), P)
    return 1e-3 * area[:, None] * forces  # kPa mm2 is mN
