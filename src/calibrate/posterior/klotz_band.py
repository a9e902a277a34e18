r"""Whether a prior's pressure-volume curves have the shape that left ventricles have.

At a draw of the prior the cavity has the volumes :math:`V_k` at the pressures :math:`P_k` over the
range of its pressure. With Klotz's relation :math:`P(V)` through a measured point, or through the
draw's own last one, the draw lies in the band of half-width h where

.. math:: \max_k |P(V_k) - P_k| \le h .

The band of a measured point says whether the prior can explain it; that of the draw's own point
judges the shape alone.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from calibrate.measurements.klotz import PRESSURE_SCATTER, Klotz
from calibrate.measurements.volume import pressure_volume
from calibrate.statistical_model import Model
from emulator.core.errors import InputError, check_known, check_seed

DRAWS = 200


class KlotzBand(NamedTuple):
    """Curves of a prior against Klotz's relation.

    apart : the largest difference of pressure at each draw, (s,) kPa.
    band : the half-width of the band, kPa.
    left_out : the number of draws at which the forward map has no answer.
    """

    apart: np.ndarray
    band: float
    left_out: int

    @property
    def fraction(self) -> float:
        """Share of the draws that lie in the band."""
        return float(np.mean(self.apart <= self.band))


def klotz_band(
    model: Model,
    point: Klotz | None = None,
    band: float = PRESSURE_SCATTER,
    count: int = DRAWS,
    seed: int = 0,
    state: str | None = None,
) -> KlotzBand:
    """Return the band in which ``count`` curves of the prior lie.

    Parameters
    ----------
    point : the relation through a measured volume; by default each draw's own, at its largest
        pressure.
    band : the half-width of the band in kPa; by default 3 mmHg, which is above the published root
        mean square errors of the relation.
    state : the load state whose parameters, but for the pressure, a curve has; by default the last.
        Muscle must be at rest there.

    Raises
    ------
    InputError
        A scene without a cavity whose pressure is a parameter, a band or count that is not above 0,
        pressures beyond the relation's, an unknown state, or no valid curve.
    """
    if not band > 0.0 or count < 1:
        raise InputError(f"klotz: band {band} kPa and {count} draws; both must be above 0")
    check_seed(seed, "klotz")
    curve = pressure_volume(model.full)
    if curve is None:
        raise InputError(
            f"klotz: scene '{model.forward.scene.name}' has no cavity whose pressure is a parameter"
        )
    if point is None:
        Klotz(1.0, curve.pressures[-1])  # refuses what the relation does not reach
    pressures = jnp.asarray(curve.pressures)

    def apart(theta: jax.Array) -> jax.Array:
        volumes = curve.volumes(theta)
        through = Klotz(volumes[-1], pressures[-1]) if point is None else point
        return jnp.max(jnp.abs(through.pressure(volumes) - pressures))

    if state is not None:
        check_known(state, model.states.states, "klotz: load state")
    row = -1 if state is None else model.states.states.index(state)
    thetas = model.states.thetas(model.prior_draws(jax.random.key(seed), count))[:, row]
    curves = np.asarray(jax.jit(partial(jax.lax.map, apart))(thetas))
    valid = curves[np.isfinite(curves)]
    if not valid.size:
        raise InputError(f"klotz: the forward map has no answer at any of {count} draws")
    return KlotzBand(valid, band, count - valid.size)
