r"""Material data that differ from point to point: fibres, sheets, and stiffness.

In region k of a scene that has regions, and where modes :math:`\varphi_j` of stiffness have the
sizes :math:`z_j`, the law's energy is multiplied by a factor,

.. math::
    W = s\, W_\text{shape} + U(J), \qquad
    s = s_k \exp\Big(\sum_j \varphi_j(x)\, z_j\Big),

its volumetric part excepted: soft tissue is as nearly incompressible as a stiff one. Energies are
proportional to their ``shape_moduli``, so the factor multiplies these. Regions have sharp edges;
modes make a smooth field (:mod:`emulator.geometry.random_field`).

Parameters may turn fibres and sheets. At a point with the unit axis :math:`n`, a direction d given
at angle zero becomes

.. math::
    R(n, \alpha)\, d = \cos\alpha\, d + \sin\alpha\, n \times d + (1 - \cos\alpha)(n \cdot d)\, n,
    \qquad \alpha(x, \theta) = \frac{\pi}{180} \sum_k s_k(x)\, \theta_k

(Rodrigues), with the shares :math:`s_k` of the parameters :math:`\theta_k` in degrees. In a
ventricle's wall of depth :math:`\tau` the axis is transmural, and the helix angles on endocardium
and epicardium have the shares :math:`1 - \tau` and :math:`\tau`; sheet angles, with equal shares,
turn sheets about the fibre before both turn. In a block there is one axis and one share of 1.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.errors import InputError
from emulator.geometry.discretisation import quadrature_points
from emulator.geometry.fibres import checked_directions
from emulator.geometry.mesh import Mesh, frozen_array
from emulator.mechanics.laws.law import Law, Quantity, number

Values = Mapping[str, jax.Array]
"""Parameters and constants of a scene by name."""


class Tissue(NamedTuple):
    """Material data of one point, or stacked over elements and their points, axes (m, q).

    directions : the fibre (3,), or fibre and sheet (2, 3); None without fibres.
    stiffness : the factor () on the law's shape moduli; None where it is 1 everywhere.
    """

    directions: jax.Array | None = None
    stiffness: jax.Array | None = None


def at_every_point(directions: np.ndarray, order: int) -> np.ndarray:
    """Return directions (m, 3) or (m, q, 3) at all points of elements of ``order``, (m, q, 3)."""
    points = len(quadrature_points(order))
    if directions.shape[1:] == (points, 3):
        return directions
    return np.broadcast_to(directions[:, None], (len(directions), points, 3))


def stiffness_of(
    regions: np.ndarray | None, modes: np.ndarray | None, values: Mapping[str, Any]
) -> jax.Array | None:
    """Return the factor (m,) on the stiffness of each element; None without regions and modes.

    Parameters
    ----------
    regions, modes : the labels (m,) and modes (m, k) of a scene.
    values : the parameters of the scene by name.
    """
    of_regions, of_modes = (
        jnp.stack([jnp.asarray(values[q.name]) for q in factors]) if factors else None
        for factors in (stiffness_quantities(regions, None), stiffness_quantities(None, modes))
    )
    factor = None
    if of_regions is not None:
        assert regions is not None
        factor = of_regions[np.unique(regions, return_inverse=True)[1]]
    if of_modes is not None:
        field = jnp.exp(jnp.asarray(modes) @ of_modes)
        factor = field if factor is None else factor * field
    return factor


def stiffness_quantities(
    regions: np.ndarray | None, modes: np.ndarray | None
) -> tuple[Quantity, ...]:
    """Return the factors of regions, ``stiffness_1``, and sizes of modes, ``stiffness_mode_1``.

    regions, modes : the labels (m,), whose factors come by ascending label, and modes (m, k).
    """
    labels = () if regions is None else np.unique(regions).tolist()
    count = 0 if modes is None else modes.shape[1]
    return (
        *(number(f"stiffness_{label}") for label in labels),
        *(number(f"stiffness_mode_{k + 1}", -np.inf) for k in range(count)),
    )


def checked_regions(regions: object, elements: int, law: Law) -> np.ndarray:
    """Return read-only labels (m,); refuse invalid ones, and a law that cannot be scaled."""
    labels = np.asarray(regions)
    if labels.dtype.kind not in "iu":
        raise InputError(f"regions are of type {labels.dtype}; expected whole numbers")
    if labels.shape != (elements,):
        raise InputError(f"regions have shape {labels.shape}; expected ({elements},)")
    if labels.min() < 0:
        raise InputError(f"regions go down to {labels.min()}; expected labels from 0 up")
    _check_scaled(law, "regions")
    return frozen_array(labels, int)


def checked_modes(modes: object, elements: int, law: Law) -> np.ndarray:
    """Return read-only modes of stiffness (m, k), as :func:`checked_regions` does labels."""
    array = np.asarray(modes, dtype=float)
    if array.ndim != 2 or len(array) != elements or not array.shape[1]:
        raise InputError(f"stiffness modes have shape {array.shape}; expected ({elements}, k)")
    if not np.isfinite(array).all():
        raise InputError("stiffness modes are not finite everywhere")
    _check_scaled(law, "stiffness modes")
    return frozen_array(array)


def _check_scaled(law: Law, what: str) -> None:
    if not law.shape_moduli:
        raise InputError(
            f"law '{law.name}' says no shape_moduli, so {what} cannot scale it apart from its "
            "resistance to volume change"
        )


@dataclass(frozen=True, eq=False)
class FibreAngles:
    """One rotation of the directions of a scene, by parameters, at every quadrature point.

    axis : the unit vectors (m, 3) or (m, q, 3) about which directions turn, counted right-handed.
    shares : the share of each parameter in the angle, (m,) or (m, q), by the parameter's name.
    """

    axis: np.ndarray
    shares: Mapping[str, np.ndarray]

    def __post_init__(self) -> None:
        object.__setattr__(self, "shares", MappingProxyType(dict(self.shares)))

    @property
    def quantities(self) -> tuple[Quantity, ...]:
        """The parameters, angles in degrees."""
        return tuple(Quantity(name, "deg", -360.0, 360.0) for name in self.shares)

    def checked(self, mesh: Mesh) -> FibreAngles:
        """Return this rotation with frozen arrays (m, q, ...).

        Raises
        ------
        InputError
            Arrays do not fit the elements of ``mesh``, axes are no unit vectors, or shares are not
            finite.
        """
        axis = checked_directions(self.axis, mesh, "axes of fibre angles")
        wide = (len(mesh.elements), len(quadrature_points(mesh.order)))
        shares = {}
        for name, values in self.shares.items():
            share = np.asarray(values, dtype=float)
            share = share[:, None] if share.ndim == 1 else share
            if share.shape not in (wide, (wide[0], 1)) or not np.isfinite(share).all():
                raise InputError(
                    f"share of fibre angle '{name}' has shape {np.shape(values)} or is not finite; "
                    f"expected {wide[:1]} or {wide}"
                )
            shares[name] = frozen_array(np.broadcast_to(share, wide))
        return FibreAngles(frozen_array(at_every_point(axis, mesh.order)), shares)


# So that loads can hand their fibres to JAX, which takes them element by element.
jax.tree_util.register_pytree_node(
    FibreAngles,
    lambda angles: ((angles.axis, dict(angles.shares)), None),
    lambda _, arrays: FibreAngles(*arrays),
)


def effective_angles(
    angles: Sequence[FibreAngles], fibres: np.ndarray | None, sheets: np.ndarray | None
) -> tuple[FibreAngles, ...]:
    """Return the rotations that change any of these directions, (m, 3) or (m, q, 3)."""
    if fibres is None:
        return ()
    if sheets is not None:
        return tuple(angles)
    each_point = fibres if fibres.ndim == 3 else fibres[:, None]
    cosines = (np.sum(rotation.axis * each_point, axis=-1) for rotation in angles)
    return tuple(a for a, c in zip(angles, cosines, strict=True) if not np.allclose(np.abs(c), 1.0))


def turned(directions: Any, angles: Sequence[FibreAngles], values: Values) -> Any:
    """Return ``directions`` turned by one rotation after the other, by the angles in ``values``.

    Parameters
    ----------
    directions : the fibres (..., 3), or fibres and sheets (..., 2, 3).
    angles : the rotations, with axes (..., 3).
    values : the parameters of the scene by name.
    """
    for rotation in angles:
        angle = jnp.deg2rad(sum(values[name] * share for name, share in rotation.shares.items()))
        d, n = jnp.asarray(directions), jnp.asarray(rotation.axis)
        c, s = jnp.cos(angle)[..., None], jnp.sin(angle)[..., None]
        if d.ndim > n.ndim:  # an axis for fibre and sheet
            n, c, s = n[..., None, :], c[..., None], s[..., None]
        along = jnp.sum(n * d, axis=-1, keepdims=True)
        directions = c * d + s * jnp.cross(n, d) + (1.0 - c) * along * n
    return directions


class Fibres(NamedTuple):
    """The fibres of a scene in the form that loads along them take; arrays begin with the element.

    directions : the unit vectors (m, q, 3) at the quadrature points, angles zero; traced where the
        stress-free shape is an unknown.
    angles : the rotations of the fibres by parameters.
    """

    directions: Any
    angles: tuple[FibreAngles, ...] = ()

    def at(self, values: Values) -> jax.Array:
        """Return the unit fibres (m, q, 3), or (q, 3) of one element, at the parameters."""
        return turned(self.directions, self.angles, values)
