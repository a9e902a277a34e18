r"""Systematic errors: what is unknown of a measurement itself, or of a law along a whole curve.

Such an error is the same in many numbers: a camera that was moved between two loads shifts and
turns all markers of one state together. Left out, it passes for material. Each error is a
:class:`Systematic`: its unknowns, in units of their standard deviations, and the change of the data
for each. They are integrated out (:mod:`calibrate.model_error.marginal`), so that sampling has no
more unknowns than before.

Small rotations are linear: an angle :math:`\omega` moves a point at x by
:math:`\omega \times (x - c)`, to second order in the angle.

Points of a loading curve at amounts :math:`\gamma_j` (a shear, a stretch), with values
:math:`y_j`, are off together, so that a hundred points are not a hundred facts:

.. math:: \delta \sim N(0, C), \qquad
          C_{jk} = (\omega^2 y_j y_k + \sigma^2)\,
                   \big[c + (1 - c)\, k(|\gamma_j - \gamma_k| / \ell)\big]

with the share :math:`\omega` of the values, the standard deviation :math:`\sigma`, the part c of
the variance that is the same along the whole curve, and Matérn's kernel k of smoothness 3/2
(:func:`emulator.core.gaussian_process.matern32`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.distance import cdist

from calibrate.model_error.marginal import Term, inferred_size
from emulator.core.errors import InputError
from emulator.core.gaussian_process import matern32

Shapes = Mapping[str, tuple[int, ...]]

_NEGLIGIBLE = 1e-8  # share of the largest variance along a curve that no datum could reveal


@dataclass(frozen=True, eq=False)
class Systematic:
    """One error that several numbers share.

    names : names of its s unknowns, each a standard normal.
    modes : the change of each observation's data for one standard deviation of each unknown,
        ``(s, *shape)``, by the observation's name.
    size : the name of an inferred size of the error and the scale of its half-normal prior, or
        None; modes are then those of size 1. Errors with one name have one size.
    shares : the modes that are shares of the predicted data, in the shape of ``modes``; the change
        is the sum of both.
    """

    names: tuple[str, ...]
    modes: Mapping[str, np.ndarray]
    size: tuple[str, float] | None = None
    shares: Mapping[str, np.ndarray] = field(default_factory=dict)

    def term(self, shapes: Shapes) -> Term:
        """Return the error in all data, raveled, of observations of these shapes, by name.

        :class:`InputError` where it does not fit them.
        """
        for name, modes in (*self.modes.items(), *self.shares.items()):
            if name not in shapes:
                raise InputError(
                    f"{self.names[0]}: '{name}' is not observed; observed: {', '.join(shapes)}"
                )
            expected = (len(self.names), *shapes[name])
            if np.shape(modes) != expected:
                raise InputError(
                    f"{self.names[0]}: modes of '{name}' have shape {np.shape(modes)}; expected "
                    f"{expected}"
                )

        def rows(modes: Mapping[str, np.ndarray]) -> np.ndarray:
            every = {name: np.zeros((len(self.names), *shapes[name])) for name in shapes} | dict(
                modes
            )
            return np.hstack([np.reshape(V, (len(V), -1)) for V in jax.tree.leaves(every)])

        shares = rows(self.shares)
        return Term(
            rows(self.modes),
            shares if np.any(shares) else None,
            None if self.size is None else inferred_size(*self.size),
            names=self.names,
        )


def rigid_motion(
    name: str,
    positions: Mapping[str, np.ndarray],
    shift: float | Sequence[float],
    turn: float | Sequence[float],
    about: Sequence[float] | None = None,
) -> Systematic:
    """Return the error of a frame that moved: all points of some observations shift and turn.

    Parameters
    ----------
    name : the beginning of the unknowns' names, ``camera shift x`` to ``camera turn z``.
    positions : the positions of each observation's points in that frame, (d, 3) mm, by the
        observation's name; displacements of these points are measured.
    shift : standard deviation along x, y and z in mm, or one for all.
    turn : standard deviation about x, y and z in degrees, or one for all.
    about : the point that only shifts, (3,) mm; by default the mean of all positions.

    Raises
    ------
    InputError
        Positions of another shape, or a negative standard deviation.
    """
    points = {key: np.asarray(X, dtype=float) for key, X in positions.items()}
    for key, X in points.items():
        if X.ndim != 2 or X.shape[1] != 3 or not np.isfinite(X).all():
            raise InputError(f"{name}: positions of '{key}' have shape {X.shape}; give (d, 3)")
    sds = [np.broadcast_to(np.asarray(sd, dtype=float), 3) for sd in (shift, turn)]
    if not all((sd >= 0.0).all() and np.isfinite(sd).all() for sd in sds):
        raise InputError(f"{name}: sds {shift} mm and {turn} degrees; they must be 0 or more")
    centre = np.concatenate(list(points.values())).mean(axis=0) if about is None else about
    axes = np.eye(3)[:, None]
    modes = {}
    for key, X in points.items():
        shifts = np.broadcast_to(sds[0] * axes, (3, *X.shape))
        turns = np.deg2rad(sds[1])[:, None, None] * np.cross(axes, X - centre)
        modes[key] = np.concatenate([shifts, turns])
    names = tuple(f"{name} {motion} {axis}" for motion in ("shift", "turn") for axis in "xyz")
    return Systematic(names, modes)


def placement(name: str, observed: Sequence[str], sd: np.ndarray) -> Systematic:
    """Return an error in which every number has an offset, the same in all observations.

    An example is where a marker was at rest, from which its displacements are measured.

    Parameters
    ----------
    observed : names of the observations, whose data have one shape.
    sd : standard deviation of each offset, of the data's shape, in their unit.
    """
    sd = np.asarray(sd, dtype=float)
    offsets = np.diag(sd.ravel()).reshape(-1, *sd.shape)
    names = tuple(f"{name} {','.join(map(str, index))}" for index in np.ndindex(*sd.shape))
    return Systematic(names, dict.fromkeys(observed, offsets))


def curve_correlation(amounts: jax.Array, length: Any, constant: float = 0.0) -> jax.Array:
    """Return C (..., n, n) of points at ``amounts`` (..., n) where omega is 0 and sigma 1.

    ``length``, () or (..., 1, 1), is in the unit of the amounts; ``constant`` is c, 0 to 1.
    """
    distance = (amounts[..., :, None] - amounts[..., None, :]) / length
    return constant + (1.0 - constant) * matern32(distance**2)


def curve_modes(amounts: np.ndarray, length: float, *, constant: float = 0.0) -> np.ndarray:
    """Return modes V (r, n) of :func:`curve_correlation`, :math:`C = V^T V`."""
    return _modes(np.asarray(curve_correlation(jnp.asarray(amounts), length, constant)))


def spatial_modes(points: np.ndarray, length: float) -> np.ndarray:
    """Return modes V (r, d) of Matérn's correlation of smoothness 3/2 at points (d, 3) mm.

    length : the correlation length, mm.
    """
    return _modes(
        np.asarray(matern32(jnp.asarray(cdist(points, points, "sqeuclidean")) / length**2))
    )


def _modes(C: np.ndarray) -> np.ndarray:
    """Return V (r, n), the largest first, with ``C = V^T V`` to round-off."""
    variances, vectors = np.linalg.eigh(C)
    used = variances > _NEGLIGIBLE * max(float(variances.max()), 1e-300)
    return np.sqrt(variances[used])[::-1, None] * vectors.T[used][::-1]
