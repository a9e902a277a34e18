r"""The end-diastolic pressure-volume relation of left ventricles, from one measured point.

Klotz et al. (2006, Am J Physiol Heart Circ Physiol 291:H403; protocol: 2007, Nat Protoc 2:2152)
found that volumes in units of their own range follow one curve, with
:math:`A_n = 27.78` mmHg and :math:`B_n = 2.76`,

.. math:: P = A_n \left(\frac{V - V_0}{V_{30} - V_0}\right)^{B_n} .

One volume :math:`V_m` at one pressure :math:`P_m` gives the two volumes,

.. math::
    V_0 = V_m\,(0.6 - 0.006\, P_m / \mathrm{mmHg}), \qquad
    V_{30} = V_0 + (V_m - V_0) \left(\frac{P_m}{A_n}\right)^{-1/B_n},

and, put into the curve, :math:`A_n` cancels:

.. math::
    P = P_m \left(\frac{V - V_0}{V_m - V_0}\right)^{B_n}, \qquad
    V = V_0 + (V_m - V_0) \left(\frac{P}{P_m}\right)^{1/B_n} = V_m\, k(P; P_m) .

:math:`k` does not depend on any volume. So the curves through all volumes at :math:`P_m` cover the
plane once, and a body of volume V at the pressure P lies on the curve through :math:`V_m = V / k`.
:class:`KlotzVolume` predicts this V_m, which a measured volume is compared with. Another point of
the curve gives another curve: V_0 changes with the pressure that is measured.

Scatter: over 0 to 40 mmHg, pressures of the predicted curve were less than 3 mmHg (root mean
square) from measured ones in every group of hearts of the 2006 paper. It holds for groups of hearts
more than for one.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Self

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from calibrate.measurements.observation import Scalar, derive
from calibrate.measurements.volume import CavityVolume
from calibrate.measurements.words import names_of
from emulator.core.errors import InputError
from emulator.core.units import KPA_PER_MMHG
from emulator.scenes.scene import Scene, inflated_cavity

PRESSURE_SCATTER = 3.0 * KPA_PER_MMHG
"""Upper bound of the published root mean square errors of pressure, kPa."""

_B = 2.76
_UNLOADED, _SLOPE = 0.6, 0.006 / KPA_PER_MMHG  # V_0 / V_m at rest, and its fall with P_m in 1/kPa
_LARGEST = 40.0 * KPA_PER_MMHG  # largest pressure at which the relation was compared


@dataclass(frozen=True, eq=False)
class Klotz:
    """The relation through one point; differentiable in it.

    measured_volume : the measured volume V_m, mL.
    measured_pressure : the pressure P_m at which it was measured, kPa, above 0 and up to 5.33
        (40 mmHg).

    Raises
    ------
    InputError
        A number outside these ranges; numbers that JAX traces are not checked.
    """

    measured_volume: ArrayLike
    measured_pressure: ArrayLike

    def __post_init__(self) -> None:
        volume, pressure = self.measured_volume, self.measured_pressure
        if not isinstance(volume, jax.core.Tracer):
            values = np.asarray(volume, dtype=float)
            if not ((values > 0.0) & np.isfinite(values)).all():
                raise InputError(f"klotz: the measured volume is {volume} mL; it must be above 0")
        if not isinstance(pressure, jax.core.Tracer):
            _check_pressure("klotz", pressure)

    @property
    def _point(self) -> tuple[jax.Array, jax.Array]:
        return jnp.asarray(self.measured_volume, float), jnp.asarray(self.measured_pressure, float)

    @property
    def unloaded(self) -> jax.Array:
        """V_0 in mL, the volume without pressure."""
        volume, pressure = self._point
        return volume * (_UNLOADED - _SLOPE * pressure)

    def volume(self, pressure: ArrayLike) -> jax.Array:
        """Return the volume (...) in mL at ``pressure`` (...) in kPa; V_0 at 0 kPa or less."""
        volume, measured = self._point
        return volume * _ratio(pressure, measured)

    def pressure(self, volume: ArrayLike) -> jax.Array:
        """Return the pressure (...) in kPa at ``volume`` (...) in mL; 0 below V_0."""
        measured, pressure = self._point
        filled = jnp.maximum(jnp.asarray(volume) - self.unloaded, 0.0)
        return pressure * (filled / (measured - self.unloaded)) ** _B

    def sd(self, pressure: ArrayLike, scatter: float = PRESSURE_SCATTER) -> jax.Array:
        """Return the sd (...) in mL of :class:`KlotzVolume` at ``pressure`` (...) in kPa, above 0.

        It follows from the ``scatter`` of pressure in kPa to first order: scatter dV/dP / k, with
        dV/dP = (V - V_0) / (B_n P). The default scatter is an upper bound.
        """
        slope = (self.volume(pressure) - self.unloaded) / (_B * jnp.asarray(pressure))
        return scatter * slope / _ratio(pressure, self._point[1])


def _ratio(pressure: ArrayLike, measured: ArrayLike) -> jax.Array:
    """Return k, the volume at ``pressure`` over the volume at ``measured``, both in kPa.

    The slope of k at no pressure is infinite; derivatives are 0 there.
    """
    p, m = jnp.asarray(pressure, float), jnp.asarray(measured, float)
    rest, above = _UNLOADED - _SLOPE * m, p > 0.0
    filled = (jnp.where(above, p, m) / m) ** (1.0 / _B)
    return rest + (1.0 - rest) * jnp.where(above, filled, 0.0)


def _check_pressure(name: str, pressure: ArrayLike) -> None:
    values = np.asarray(pressure, dtype=float)
    if not ((values > 0.0) & (values <= _LARGEST)).all():
        raise InputError(
            f"{name}: the measured pressure is {pressure} kPa; it must be above 0 and up to "
            f"{_LARGEST:.3g} kPa (40 mmHg; 1 mmHg = {KPA_PER_MMHG} kPa)"
        )


@dataclass(frozen=True, eq=False)
class KlotzVolume(Scalar):
    """The volume at one pressure whose Klotz curve passes through the body, one number in mL.

    The body's point is the volume of its first cavity whose pressure is a parameter, at that
    pressure in the observation's load state. Where the two pressures agree, it is the volume.
    The relation's scatter in mL depends on the pressure (:meth:`Klotz.sd`), so its noise is given.

    scene : the scene, with such a cavity.
    measured_pressure : P_m in kPa, at which the data were measured.
    volume, column : the volume of the cavity and the column of its pressure in theta, derived.

    Raises
    ------
    InputError
        No such cavity, or a pressure that is not above 0 and up to 5.33 kPa.
    """

    scene: Scene
    measured_pressure: float
    volume: CavityVolume = field(init=False)
    column: int = field(init=False)

    kind = "klotz"
    hint = " in kPa, such as klotz:1.3"
    quantity = "volume"
    unit = CavityVolume.unit
    arguments = ("measured_pressure",)

    def __post_init__(self) -> None:
        _check_pressure(names_of(self)[0], self.measured_pressure)
        inflated = inflated_cavity(self.scene)
        if inflated is None:
            raise InputError(
                f"{names_of(self)[0]}: scene '{self.scene.name}' has no cavity whose pressure is a "
                f"parameter; it has {', '.join(self.scene.parameter_names)}"
            )
        volume = CavityVolume(self.scene, inflated[0])
        column = self.scene.parameter_names.index(inflated[1])
        derive(self, volume=volume, column=column, nodes=volume.nodes)

    @classmethod
    def of(cls, scene: Scene, pressure: str) -> Self:
        """Return the observation of the volume at this pressure in kPa."""
        return cls(scene, float(pressure))

    def evaluate(self, displacement: jax.Array, theta: jax.Array) -> jax.Array:
        """Return V_m (...) in mL."""
        pressure = theta[..., self.column]
        return self.volume(displacement, theta) / _ratio(pressure, self.measured_pressure)


def klotz_of(scene: Scene, volume: Any, pressure: Any) -> Klotz | None:
    """Return the relation behind a scene's curve; None for muscle that may contract.

    volume : the volume of the scene's cavity, mL.
    pressure : the pressure there, kPa. None is returned for numbers out of the relation's range.
    """
    if any(load.fibres for load in scene.loads):
        return None
    try:
        return Klotz(float(volume), float(pressure))
    except InputError:
        return None
