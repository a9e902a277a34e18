r"""Material data that differ from point to point: fibres, sheets, and regions of other stiffness.

In region k of a scene that has regions, the law's energy is multiplied by the factor :math:`s_k`,

.. math::
    W = s_k\, W_\text{shape} + U(J),

its volumetric part excepted: a soft region is as nearly incompressible as a stiff one. Energies are
proportional to their ``shape_moduli``, so the factor multiplies these.

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
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.errors import InputError
from emulator.geometry.discretisation import quadrature_points
from emulator.geometry.fibres import checked_directions
from emulator.geometry.mesh import Mesh, frozen_array
from emulator.mechanics.laws.law import Law, Quantity, number
from emulator.scenes.part import Values

_FULL_TURN = 360.0  # degrees


class Tissue(NamedTuple):
    """Material data of one point, or stacked over elements and their points, axes (m, q).

    directions : the fibre (3,), or fibre and sheet (2, 3); None without fibres.
    region : the index () of the point's region among the factors; None without regions.
    """

    directions: jax.Array | None = None
    region: jax.Array | None = None


def tissue_of(
    fibres: np.ndarray | None, sheets: np.ndarray | None, regions: np.ndarray | None, points: int
) -> Tissue:
    """Return material data with leading axes (m, q).

    Parameters
    ----------
    fibres, sheets : the unit directions (m, q, 3), or None.
    regions : the labels (m,), or None.
    points : the number q of quadrature points of an element.
    """
    directions, region = fibres, None
    if fibres is not None and sheets is not None:
        directions = np.stack([fibres, sheets], axis=2)
    if regions is not None:
        index = np.unique(regions, return_inverse=True)[1][:, None]
        region = np.broadcast_to(index, (len(index), points))
    # NumPy arrays: JAX arrays made inside jit would be tracers, and a scene keeps these.
    return Tissue(cast(Any, directions), cast(Any, region))


def at_every_point(directions: np.ndarray, order: int) -> np.ndarray:
    """Return directions (m, 3) or (m, q, 3) at all points of elements of ``order``, (m, q, 3)."""
    points = len(quadrature_points(order))
    if directions.shape[1:] == (points, 3):
        return directions
    return np.broadcast_to(directions[:, None], (len(directions), points, 3))


def factors(regions: np.ndarray | None, values: Mapping[str, Any]) -> jax.Array | None:
    """Return the stiffness factor (k,) of each region, by ascending label; None without regions."""
    if regions is None:
        return None
    return jnp.stack([jnp.asarray(values[q.name]) for q in region_quantities(regions)])


def region_quantities(regions: np.ndarray) -> tuple[Quantity, ...]:
    """Return the factors of ``regions`` (m,), by ascending label: ``stiffness_1`` and so on."""
    return tuple(number(f"stiffness_{label}") for label in np.unique(regions).tolist())


def checked_regions(regions: object, elements: int, law: Law) -> np.ndarray:
    """Return read-only labels (m,); refuse invalid ones, and a law that cannot be scaled."""
    labels = np.asarray(regions)
    if labels.dtype.kind not in "iu":
        raise InputError(f"regions are of type {labels.dtype}; expected whole numbers")
    if labels.shape != (elements,):
        raise InputError(f"regions have shape {labels.shape}; expected ({elements},)")
    if labels.min() < 0:
        raise InputError(f"regions go down to {labels.min()}; expected labels from 0 up")
    if not law.shape_moduli:
        raise InputError(
            f"law '{law.name}' says no shape_moduli, so regions cannot scale it apart from its "
            "resistance to volume change"
        )
    return frozen_array(labels, int)


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
        return tuple(Quantity(name, "deg", -_FULL_TURN, _FULL_TURN) for name in self.shares)

    def checked(self, mesh: Mesh) -> FibreAngles:
        """Return the same rotation with frozen arrays (m, q, ...).

        Raises
        ------
        InputError
            Arrays do not fit the elements of ``mesh``, axes are no unit vectors, or shares are not
            finite.
        """
        points = len(quadrature_points(mesh.order))
        axis = checked_directions(self.axis, mesh, "axes of fibre angles")
        wide = (len(mesh.elements), points)
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
        axis = axis if axis.ndim == 3 else axis[:, None]
        return FibreAngles(frozen_array(np.broadcast_to(axis, (*wide, 3))), shares)

    def turns(self, fibres: np.ndarray) -> bool:
        """Return whether ``fibres`` (m, 3) or (m, q, 3) turn, and not only sheets about them."""
        along = np.sum(self.axis * (fibres if fibres.ndim == 3 else fibres[:, None]), axis=-1)
        return not np.allclose(np.abs(along), 1.0)

    def turned(self, tissue: Tissue, values: Values) -> Tissue:
        """Return ``tissue`` (m, q, ...) with directions turned by the angles among ``values``."""
        assert tissue.directions is not None, "a scene's angles are checked against its directions"
        angle = jnp.deg2rad(sum(values[name] * share for name, share in self.shares.items()))
        d = jnp.asarray(tissue.directions)
        more = d.ndim - self.axis.ndim  # an axis for fibre and sheet
        n = jnp.expand_dims(jnp.asarray(self.axis), tuple(range(2, 2 + more)))
        c, s = (jnp.expand_dims(f(angle), tuple(range(2, 3 + more))) for f in (jnp.cos, jnp.sin))
        along = jnp.sum(n * d, axis=-1, keepdims=True)
        return tissue._replace(directions=c * d + s * jnp.cross(n, d) + (1.0 - c) * along * n)


def checked_angles(
    angles: Sequence[FibreAngles], mesh: Mesh, fibres: np.ndarray | None, sheets: np.ndarray | None
) -> tuple[FibreAngles, ...]:
    """Return the rotations of a scene with checked, frozen arrays.

    Raises
    ------
    InputError
        A scene without fibres, sheet angles without sheets, or arrays that do not fit its mesh.
    """
    if not angles:
        return ()
    if fibres is None:
        raise InputError("fibre angles turn fibres, and it has none")
    checked = tuple(each.checked(mesh) for each in angles)
    if len(effective_angles(checked, fibres, sheets)) < len(checked):
        raise InputError("sheet angles turn sheets, and its law takes none")
    return checked


def effective_angles(
    angles: Sequence[FibreAngles], fibres: np.ndarray | None, sheets: np.ndarray | None
) -> tuple[FibreAngles, ...]:
    """Return the rotations that change any of these directions, (m, 3) or (m, q, 3)."""
    if fibres is None:
        return ()
    return tuple(each for each in angles if sheets is not None or each.turns(fibres))


def turned(tissue: Tissue, angles: tuple[FibreAngles, ...], values: Values) -> Tissue:
    """Return ``tissue`` (m, q, ...) with its directions turned by one rotation after the other."""
    for each in angles:
        tissue = each.turned(tissue, values)
    return tissue


@dataclass(frozen=True, eq=False)
class Fibres:
    """The fibres of a scene in the form that loads along them take, element by element.

    directions : the unit vectors (m, q, 3) at the quadrature points, angles zero; traced where the
        stress-free shape is an unknown.
    angles : the rotations of the fibres by parameters.
    """

    directions: Any
    angles: tuple[FibreAngles, ...] = ()

    def some(self, elements: np.ndarray) -> Fibres:
        """Return the fibres of ``elements`` (k,)."""
        angles = [
            FibreAngles(each.axis[elements], {n: s[elements] for n, s in each.shares.items()})
            for each in self.angles
        ]
        return Fibres(self.directions[elements], tuple(angles))

    @property
    def rows(self) -> Any:
        """Arrays with the leading axis m, of which :meth:`of_element` takes a row."""
        return self.directions, [(each.axis, dict(each.shares)) for each in self.angles]

    @staticmethod
    def of_element(row: Any, values: Values) -> jax.Array:
        """Return the unit fibres (q, 3) of one element at the parameters ``values``."""
        directions, rotations = jax.tree.map(lambda array: array[None], row)
        angles = tuple(FibreAngles(axis, shares) for axis, shares in rotations)
        fibres = turned(Tissue(directions), angles, values).directions
        assert fibres is not None
        return fibres[0]
