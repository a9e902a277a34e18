r"""Fibres and sheets that parameters turn.

At a point with the unit axis :math:`n`, a direction d given at angle zero becomes

.. math::
    R(n, \alpha)\, d = \cos\alpha\, d + \sin\alpha\, n \times d + (1 - \cos\alpha)(n \cdot d)\, n,
    \qquad \alpha(x, \theta) = \frac{\pi}{180} \sum_k s_k(x)\, \theta_k

(Rodrigues), with the shares :math:`s_k` of the parameters :math:`\theta_k` in degrees. In a
ventricle's wall of depth :math:`\tau` the axis is transmural and the helix angles on endocardium
and epicardium have the shares :math:`1 - \tau` and :math:`\tau`; sheet angles, with equal shares,
turn sheets about the fibre before both turn. In a block there is one axis and one share of 1. The
derivative is exact, as that of any other parameter.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.errors import InputError
from emulator.geometry.discretisation import quadrature_points
from emulator.geometry.fibres import checked_directions
from emulator.geometry.mesh import Mesh, frozen_array
from emulator.mechanics.laws.law import Quantity
from emulator.scenes.local_terms import Values
from emulator.scenes.regions import Tissue

_WHOLE_TURN = 360.0  # degrees


@dataclass(frozen=True, eq=False)
class FibreAngles:
    """By which angles parameters turn the directions of a scene, at every quadrature point.

    axis : unit vectors (m, 3) or (m, q, 3) about which they turn, counted right-handed.
    shares : of each parameter in the angle, (m,) or (m, q), by its name.
    """

    axis: np.ndarray
    shares: Mapping[str, np.ndarray]

    def __post_init__(self) -> None:
        object.__setattr__(self, "shares", MappingProxyType(dict(self.shares)))

    @property
    def quantities(self) -> tuple[Quantity, ...]:
        """The parameters, angles in degrees."""
        return tuple(Quantity(name, "deg", -_WHOLE_TURN, _WHOLE_TURN) for name in self.shares)

    def checked(self, mesh: Mesh) -> FibreAngles:
        """These angles with frozen arrays (m, q, ...).

        Raises
        ------
        InputError
            Arrays that do not fit the elements of ``mesh``, axes that are no unit vectors, or
            shares that are not finite.
        """
        points = len(quadrature_points(mesh.order))
        axis = checked_directions(self.axis, mesh, "axes of fibre angles")
        wide = (len(mesh.elements), points)
        shares = {}
        for name, given in self.shares.items():
            share = np.asarray(given, dtype=float)
            share = share[:, None] if share.ndim == 1 else share
            if share.shape not in (wide, (wide[0], 1)) or not np.isfinite(share).all():
                raise InputError(
                    f"share of fibre angle '{name}' has shape {np.shape(given)} or is not finite; "
                    f"expected {wide[:1]} or {wide}"
                )
            shares[name] = frozen_array(np.broadcast_to(share, wide))
        axis = axis if axis.ndim == 3 else axis[:, None]
        return FibreAngles(frozen_array(np.broadcast_to(axis, (*wide, 3))), shares)

    def turns(self, fibres: np.ndarray) -> bool:
        """Whether ``fibres`` (m, 3) or (m, q, 3) turn, and not only the sheets about them."""
        along = np.sum(self.axis * (fibres if fibres.ndim == 3 else fibres[:, None]), axis=-1)
        return not np.allclose(np.abs(along), 1.0)

    def turned(self, tissue: Tissue, values: Values) -> Tissue:
        """``tissue`` (m, q, ...) with its directions turned by the angles among ``values``."""
        assert tissue.directions is not None, "a scene's angles are checked against its directions"
        angle = jnp.deg2rad(sum(values[name] * share for name, share in self.shares.items()))
        given = jnp.asarray(tissue.directions)
        more = given.ndim - self.axis.ndim  # an axis for fibre and sheet
        n = jnp.expand_dims(jnp.asarray(self.axis), tuple(range(2, 2 + more)))
        c, s = (jnp.expand_dims(f(angle), tuple(range(2, 3 + more))) for f in (jnp.cos, jnp.sin))
        along = jnp.sum(n * given, axis=-1, keepdims=True)
        turned = c * given + s * jnp.cross(n, given) + (1.0 - c) * along * n
        return tissue._replace(directions=turned)


def checked_angles(
    angles: Sequence[FibreAngles], mesh: Mesh, fibres: np.ndarray | None, sheets: np.ndarray | None
) -> tuple[FibreAngles, ...]:
    """The ``angles`` of a scene, their arrays checked and frozen.

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
    if len(that_turn(checked, fibres, sheets)) < len(checked):
        raise InputError("sheet angles turn sheets, and its law takes none")
    return checked


def that_turn(
    angles: Sequence[FibreAngles], fibres: np.ndarray | None, sheets: np.ndarray | None
) -> tuple[FibreAngles, ...]:
    """Those of ``angles`` that turn any of these directions, (m, 3) or (m, q, 3)."""
    if fibres is None:
        return ()
    return tuple(each for each in angles if sheets is not None or each.turns(fibres))


def turned(tissue: Tissue, angles: tuple[FibreAngles, ...], values: Values) -> Tissue:
    """``tissue`` (m, q, ...) with its directions turned by one rotation after the other."""
    for each in angles:
        tissue = each.turned(tissue, values)
    return tissue


@dataclass(frozen=True, eq=False)
class Fibres:
    """The fibres of a scene, as loads along them see them, an element after the other.

    given : unit directions (m, q, 3) at the quadrature points, at angles zero; traced where the
        body is at rest on a shape that is sought.
    angles : by which parameters turn them.
    """

    given: Any
    angles: tuple[FibreAngles, ...] = ()

    def some(self, elements: np.ndarray) -> Fibres:
        """Those of ``elements`` (k,)."""
        chosen = [
            FibreAngles(each.axis[elements], {n: s[elements] for n, s in each.shares.items()})
            for each in self.angles
        ]
        return Fibres(self.given[elements], tuple(chosen))

    @property
    def rows(self) -> Any:
        """Arrays with the leading axis m, of which :meth:`of_element` takes a row."""
        return self.given, [(each.axis, dict(each.shares)) for each in self.angles]

    @staticmethod
    def of_element(row: Any, values: Values) -> jax.Array:
        """Unit fibres (q, 3) of one element at the parameters ``values``."""
        given, turns = jax.tree.map(lambda array: array[None], row)
        angles = tuple(FibreAngles(axis, shares) for axis, shares in turns)
        found = turned(Tissue(given), angles, values).directions
        assert found is not None
        return found[0]


def identity_of_angles(angles: Sequence[FibreAngles]) -> dict[str, np.ndarray]:
    """What solutions depend on, (m, q, 3) and (m, q, 1), by name."""
    found = {f"axis of rotation {k}": each.axis for k, each in enumerate(angles)}
    for k, each in enumerate(angles):
        for name, share in each.shares.items():
            found[f"share of {name} in rotation {k}"] = share[..., None]
    return found


def across_wall(
    depth: np.ndarray, normal: np.ndarray, angles: tuple[float | str, float | str]
) -> tuple[FibreAngles, ...]:
    """The rotation of a wall's fibres or sheets by parameters; none if both angles are numbers.

    Parameters
    ----------
    depth : (m,) or (m, q), 0 on the endocardium and 1 on the epicardium.
    normal : unit axes with a last axis of 3: transmural directions, or fibres for sheets.
    angles : on endocardium and epicardium, each in degrees or the name of a parameter.
    """
    shares: dict[str, np.ndarray] = {}
    for angle, share in zip(angles, (1.0 - depth, depth), strict=True):
        if isinstance(angle, str):
            shares[angle] = shares.get(angle, 0.0) + share
    return (FibreAngles(normal, shares),) if shares else ()


def without_parameters(angles: tuple[float | str, float | str]) -> tuple[float, float]:
    """Angles in degrees, 0 where a parameter's name stands."""
    first, last = (0.0 if isinstance(angle, str) else float(angle) for angle in angles)
    return first, last
