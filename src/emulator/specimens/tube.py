r"""Tubes: arteries that are inflated and stretched, as homogeneous states of points of the wall.

A ring that is cut open relaxes to a sector without stress, of inner radius :math:`R_i`, with a part
:math:`\alpha` of the full turn missing, the opening angle. Closed, stretched by
:math:`\lambda_z` and inflated to the inner radius :math:`r_i` without change of volume, a point at
R comes to the radius r with the stretches

.. math::
    r^2 = r_i^2 + \frac{R^2 - R_i^2}{k \lambda_z}, \qquad \lambda_\theta = \frac{k r}{R}, \qquad
    \lambda_r = \frac{1}{\lambda_\theta \lambda_z}, \qquad k = \frac{2\pi}{2\pi - \alpha} .

A radius and an axial stretch are thus a homogeneous state of every point: x around the tube, y
along it, z through the wall, along which the state is free. With the stress :math:`\hat\sigma` of
states along whose free direction nothing pulls, equilibrium over the wall gives the pressure inside
and the reduced axial force, which is what pulls on closed ends besides the pressure on them,

.. math::
    p = \int_{r_i}^{r_o} \hat\sigma_\theta \frac{dr}{r}
      = \int \frac{k\, \hat\sigma_\theta}{\lambda_z \lambda_\theta^2} \frac{dR}{R}, \qquad
    F = \pi \int_{r_i}^{r_o} (2 \hat\sigma_z - \hat\sigma_\theta)\, r\, dr
      = \pi \int (2 \hat\sigma_z - \hat\sigma_\theta) \frac{R\, dR}{k \lambda_z}

(G. A. Holzapfel, T. C. Gasser and R. W. Ogden, J. Elast. 61, 2000, their equations 20 to 33).
Columns of a table are ``inner_radius``, ``outer_radius``, ``inner_diameter`` or
``outer_diameter``, in mm unless they say otherwise, and ``stretch_axial``, 1 in the sector.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.errors import InputError
from emulator.core.units import IN_MM, factor, with_unit
from emulator.specimens.states import STRETCHES, States, falls, going_back, rows_of

_RADIUS = re.compile(r"(inner|outer)_(radius|diameter)")
_AXIAL = "stretch_axial"


def motion_columns(words: Collection[str]) -> list[str]:
    """Return the columns that say how a tube is stretched and inflated."""
    bare = {word: with_unit(word)[0] for word in words}
    return [w for w, name in bare.items() if name == _AXIAL or _RADIUS.fullmatch(name)]


@dataclass(frozen=True)
class Tube:
    """The sector without stress that a tube opens to, and the points of its wall.

    Parameters
    ----------
    inner_radius : the inner radius of the sector, mm.
    layers : the thickness of each layer of the sector from the inside out, mm.
    opening_angle : the angle that the sector lacks of a full turn, degrees; below 0 where the ends
        overlap. Fung's opening angle, from the middle of the sector, is half of it.
    points : the number of Gauss points of a layer.
    """

    inner_radius: float
    layers: tuple[float, ...]
    opening_angle: float = 0.0
    points: int = 5

    def __post_init__(self) -> None:
        if not 0.0 < self.inner_radius < np.inf:
            raise InputError(f"tube: inner_radius is {self.inner_radius} mm; give one above 0")
        if not self.layers or not all(0.0 < layer < np.inf for layer in self.layers):
            raise InputError(f"tube: layers are {self.layers}; give thicknesses above 0, in mm")
        if not -360.0 < self.opening_angle < 360.0:
            raise InputError(
                f"tube: opening_angle is {self.opening_angle} degrees; give -360 to 360"
            )
        if self.points < 2:
            raise InputError(f"tube: {self.points} points a layer; give 2 or more")

    @property
    def closing(self) -> float:
        """The factor k by which closing the sector turns it."""
        return 360.0 / (360.0 - self.opening_angle)

    @property
    def outer_radius(self) -> float:
        """The outer radius of the sector, mm."""
        return self.inner_radius + sum(self.layers)

    @cached_property
    def _rule(self) -> tuple[np.ndarray, np.ndarray]:
        """The radii (g,) of the wall's points in the sector, and their weights (g,), mm."""
        place, weight = np.polynomial.legendre.leggauss(self.points)
        ends = self.inner_radius + np.cumsum([0.0, *self.layers])
        half = 0.5 * np.diff(ends)[:, None]
        radii = ends[:-1, None] + half * (1.0 + place)
        return radii.ravel(), (half * weight).ravel()

    @property
    def size(self) -> int:
        """The number of points of the wall."""
        return len(self.layers) * self.points

    def regions(self, count: int) -> np.ndarray | None:
        """Return the layer (count,), from 1, of points in states; ``None`` for one layer."""
        if len(self.layers) == 1:
            return None
        return np.arange(count) % self.size // self.points + 1

    def states(
        self,
        columns: Mapping[str, np.ndarray],
        protocols: Sequence[str] | None = None,
        *,
        ordered: bool = True,
    ) -> States:
        """Return the states of the wall's points, those of the first measured state first.

        Parameters
        ----------
        columns : a radius or a diameter, and ``stretch_axial``, each (m,).
        protocols : as of :func:`~emulator.specimens.states.states`.
        ordered : whether no test may go back.

        Raises
        ------
        InputError
            A column that is missing, there twice or of another unit, a radius at which the tube
            would have no cavity, a test that goes back, or a stretch that is none.
        """
        axial, inner = self._motion(columns)
        tests = rows_of([""] * len(axial) if protocols is None else protocols)
        for name, rows in tests.items() if ordered else ():
            _check_path(inner[rows], axial[rows], rows, name)
        R, k = self._rule[0], self.closing
        squares = (R**2 - self.inner_radius**2) / (k * axial[:, None])
        around = k * np.sqrt(inner[:, None] ** 2 + squares) / R
        for values, what in ((around, "around the tube"), (axial[:, None], "along the tube")):
            low, high = values.min(axis=1), values.max(axis=1)
            for row in np.flatnonzero((low < STRETCHES[0]) | (high > STRETCHES[1])):
                raise InputError(
                    f"row {row + 1} stretches the wall by {low[row]:.3g} to {high[row]:.3g} "
                    f"{what}, outside {STRETCHES[0]:g} to {STRETCHES[1]:g}; check the "
                    "units, and the sector's radius and opening angle"
                )
        count = around.size
        H = np.zeros((count, 3, 3))
        H[:, 0, 0], H[:, 1, 1] = around.ravel() - 1.0, np.repeat(axial, self.size) - 1.0
        free = np.broadcast_to([False, False, True], (count, 3))
        points = {
            name: (rows[:, None] * self.size + np.arange(self.size)).ravel()
            for name, rows in tests.items()
        }
        return States(H, free, np.zeros((count, 3)), points)

    def _motion(self, columns: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Return the axial stretches (m,), and the inner radii (m,) in mm."""
        names = {with_unit(word)[0]: word for word in columns}
        radii = [name for name in names if _RADIUS.fullmatch(name)]
        if len(radii) != 1 or _AXIAL not in names:
            raise InputError(
                f"the tube moves by {', '.join(columns) or 'no column'}; give stretch_axial and "
                "one of inner_radius, outer_radius, inner_diameter, outer_diameter"
            )
        axial = np.asarray(columns[names[_AXIAL]], dtype=float)
        word = names[radii[0]]
        radius = np.asarray(columns[word], dtype=float)
        radius = radius * factor(word, with_unit(word)[1], "mm", IN_MM)
        radius = 0.5 * radius if radii[0].endswith("diameter") else radius
        wall = np.zeros(len(axial))
        if radii[0].startswith("outer"):
            wall = (self.outer_radius**2 - self.inner_radius**2) / (self.closing * axial)
        square = np.where(radius > 0.0, radius**2 - wall, -1.0)
        bad = np.flatnonzero(~(square > 0.0) | ~(axial > 0.0))
        if len(bad):
            row = bad[0]
            raise InputError(
                f"row {row + 1}: at '{word}' {np.asarray(columns[word])[row]:g} and "
                f"stretch_axial {axial[row]:g} the tube has no cavity; is the unit right, and the "
                "sector's thickness?"
            )
        return axial, np.sqrt(square)

    def motion(self, stretches: np.ndarray) -> dict[str, np.ndarray]:
        """Return the columns of :meth:`states` from the innermost points' stretches (m, 3)."""
        around, along, _ = stretches.T
        R, k = self._rule[0][0], self.closing
        square = (around * R / k) ** 2 - (R**2 - self.inner_radius**2) / (k * along)
        return {"inner_radius": np.sqrt(square), _AXIAL: along}

    def pressure(self, stretches: jax.Array, cauchy: jax.Array) -> jax.Array:
        """Return the pressures (m,) in kPa inside.

        Parameters
        ----------
        stretches : around and along the tube, of the wall's points, (m g, 2).
        cauchy : the Cauchy stresses in kPa likewise, zero through the wall.
        """
        R, weights = self._rule
        around, along = self._by_state(stretches)
        return jnp.sum(
            self.closing * weights / R * self._by_state(cauchy)[0] / (along * around**2), axis=1
        )

    def axial_force(self, stretches: jax.Array, cauchy: jax.Array) -> jax.Array:
        """Return the reduced axial forces (m,) in mN; arguments as of :meth:`pressure`."""
        R, weights = self._rule
        along, (sigma_around, sigma_along) = self._by_state(stretches)[1], self._by_state(cauchy)
        pull = 2.0 * sigma_along - sigma_around
        return jnp.pi * jnp.sum(weights * R / (self.closing * along) * pull, axis=1)

    def _by_state(self, values: jax.Array) -> jax.Array:
        """Return (2, m, g) from (m g, 2)."""
        return jnp.moveaxis(values.reshape(-1, self.size, 2), -1, 0)


def _check_path(inner: np.ndarray, axial: np.ndarray, rows: np.ndarray, name: str) -> None:
    """Refuse a test in which the radius falls while the stretch does not grow."""
    way = inner - inner.min()
    # A tube that is stretched further may shrink: only rows of no larger stretch count.
    back = np.flatnonzero(falls(way) & (axial <= axial[_largest_before(way)]))
    if len(back):
        test = f" of '{name}'" if name else ""
        raise going_back(f"{test} has a smaller radius", rows, back[0], way)


def _largest_before(way: np.ndarray) -> np.ndarray:
    """Return the row (k,) of the largest of ``way`` (k,) up to each row."""
    return np.maximum.accumulate(np.where(way == np.maximum.accumulate(way), range(len(way)), 0))
