r"""The right ventricle's free wall as a sheet on the left ventricle's epicardium.

The septum is the half of an oval on the epicardium, cut by the base. Each point of it has a place
in the lower half of a unit disc, :math:`\rho` from the disc's centre. The sheet at depth :math:`s`,
0 on the inside and 1 on the outside, stands along the septum's edge, widened by :math:`s` times the
thickness :math:`h`, and bulges horizontally from the epicardium by

.. math:: (D + s\,h) \cos(\tfrac{\pi}{2} \rho)

at the foot :math:`\sin(\tfrac{\pi}{2} \rho)` from the centre: arcs of ellipses, in even steps.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass

import numpy as np

from emulator.core.errors import InputError
from emulator.geometry.generators.ellipsoid import EllipsoidalWall


@dataclass(frozen=True)
class RightVentricle:
    """Dimensions of the right ventricle; the defaults are our choice.

    half_angle : degrees from the middle of the septum to the cavity's edge at the base.
    apex : of the cavity, as a fraction of the way from the left apex to the base.
    bulge : of the cavity at the base, mm.
    thickness : of the free wall, mm.
    """

    half_angle: float = 72.0
    apex: float = 0.4
    bulge: float = 24.0
    thickness: float = 5.0

    def __post_init__(self) -> None:
        sound = 0.0 < self.half_angle < 150.0 and 0.0 < self.apex < 1.0
        if not (sound and 0.0 < self.bulge < np.inf and 0.0 < self.thickness < np.inf):
            raise InputError(
                f"biventricle: right ventricle {astuple(self)}; expected a half angle below 150 "
                "degrees, an apex below 1, and positive bulge and thickness in mm"
            )


@dataclass(frozen=True, eq=False)
class Septum:
    """The septum on the left wall's epicardium, and the sheet over it.

    Coordinates are ``xi`` from -1 to 1 across, ``eta`` from 0 up to 1 on the base, and depth ``s``.
    """

    left: EllipsoidalWall
    right: RightVentricle

    @property
    def half_angle(self) -> float:
        """Angle in radians from the septum's middle to the free wall's outside, at the base."""
        return float(self.foot(np.ones(1), np.ones(1), np.ones(1))[1][0])

    def foot(self, xi: np.ndarray, eta: np.ndarray, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Coordinates ``r, phi`` on the epicardium of the septum, widened for depth ``s``."""
        return self._widened(*_half_disc(xi, eta), s)

    def sheet(self, xi: np.ndarray, eta: np.ndarray, s: np.ndarray) -> np.ndarray:
        """The point of the free wall in mm, (..., 3)."""
        across, down = _half_disc(xi, eta)
        rho = np.hypot(across, down)
        along = np.sinc(0.5 * rho) * 0.5 * np.pi  # sin(pi rho / 2) / rho: even steps along the arc
        r, phi = self._widened(along * across, along * down, s)
        lift = (self.right.bulge + s * self.right.thickness) * np.cos(0.5 * np.pi * rho)
        outwards = np.stack([np.cos(phi), np.sin(phi), np.zeros_like(phi)], axis=-1)
        return self._epicardium(r, phi) + lift[..., None] * outwards

    def _widened(
        self, across: np.ndarray, down: np.ndarray, s: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """``r, phi`` of points in the half disc, its edge moved out by ``s`` thicknesses."""
        thickness = s * self.right.thickness
        step = np.array([-5e-5, 5e-5])
        below, above = self._epicardium(self.right.apex + step, np.zeros(2))
        start = self.right.apex - thickness * np.ptp(step) / np.linalg.norm(above - below)
        r = 1.0 - (1.0 - start) * down
        around = self._epicardium(r, np.zeros_like(r))[..., 0]
        return r, (np.radians(self.right.half_angle) + thickness / around) * across

    def _epicardium(self, r: np.ndarray, phi: np.ndarray) -> np.ndarray:
        return self.left.position(r, phi, np.ones_like(r))


def _half_disc(xi: np.ndarray, eta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rectangle of ``xi`` and ``eta`` mapped to the half disc: ``across`` and ``down``.

    A sheet over a rectangle would lie flat in its corners; on the disc's edge it stands up
    everywhere. Squares go to circles (Shirley and Chiu 1997), so a triangle in a corner stays a
    triangle.
    """
    down = 1.0 - eta
    wide = np.abs(xi) > down
    rho = np.where(wide, np.abs(xi), down)
    share = np.divide(np.where(wide, down, np.abs(xi)), rho, out=np.zeros_like(rho), where=rho > 0)
    turn = 0.25 * np.pi * np.where(wide, share, 2.0 - share)  # from the diameter
    return np.sign(xi) * rho * np.cos(turn), rho * np.sin(turn)
