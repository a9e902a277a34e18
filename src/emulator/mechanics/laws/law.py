r"""The interface of a hyperelastic law, its identity, and energies of volume change.

A law's code can change while its name stays. The identity of a law therefore includes the values

.. math:: W(H_i; p_i), \qquad i = 1, \dots, 24

of its energy at fixed displacement gradients that stretch, squeeze and shear the fibres, with fixed
parameters; the values are rounded to eight digits, so that processors and releases of JAX agree.

Nearly incompressible laws share energies of volume change:

==================  =============================================
quadratic           :math:`\frac{\kappa}{2} (J - 1)^2`
quadratic_logarithmic  :math:`\kappa (J^2 - 1 - 2 \ln J)`
logarithmic         :math:`\frac{\kappa}{2} (\ln J)^2`
==================  =============================================

Near :math:`J = 1` the second is :math:`2 \kappa (J - 1)^2`, four times as stiff as the others.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.kept import kept
from emulator.mechanics.kinematics import Strain


@dataclass(frozen=True)
class Quantity:
    """A parameter of a law or a load.

    Parameters
    ----------
    name : its name in scenes.
    unit : of its values; empty when dimensionless.
    low, high : values lie between these, both excluded.
    hint : added to the message that refuses a wrong unit.
    low_admitted : whether a value may be ``low`` itself.
    """

    name: str
    unit: str = ""
    low: float = 0.0
    high: float = math.inf
    hint: str = ""
    low_admitted: bool = False

    def unit_fault(self, unit: str, owner: str) -> str | None:
        """Return a message if ``owner`` cannot take a value in ``unit``, else ``None``."""
        if unit == self.unit:
            return None
        given_unit = f"in {unit}" if unit else "given no unit"
        expected = self.unit or "it without a unit"
        hint = f" ({self.hint})" if self.hint else ""
        return f"parameter '{self.name}' is {given_unit}; {owner} takes {expected}{hint}"

    def range_fault(self, low: float, high: float) -> str | None:
        """Return a message if the range ``low`` to ``high`` is not admissible, else ``None``."""
        if not self._high_enough(low):
            least = "not go below" if self.low_admitted else "stay above"
            return f"{self._with_unit('ranges down to', low)}; it must {least} {self.low:g}"
        if not high < self.high:
            return f"{self._with_unit('ranges up to', high)}; it must stay below {self.high:g}"
        return None

    def value_fault(self, value: float) -> str | None:
        """Return a message if ``value`` is not admissible, else ``None``."""
        if not math.isfinite(value):
            return f"{self._with_unit('is', value)}; it must be finite"
        if not self._high_enough(value):
            least = f"{self.low:g} or more" if self.low_admitted else f"above {self.low:g}"
            return f"{self._with_unit('is', value)}; it must be {least}"
        if not value < self.high:
            return f"{self._with_unit('is', value)}; it must be below {self.high:g}"
        return None

    def _high_enough(self, value: float) -> bool:
        return value >= self.low if self.low_admitted else value > self.low

    def _with_unit(self, verb: str, value: float) -> str:
        return f"parameter '{self.name}' {verb} {value:g} {self.unit}".rstrip()


def modulus(name: str) -> Quantity:
    """Return a quantity that is a stiffness in kPa, above 0."""
    return Quantity(name, "kPa")


def number(name: str, low: float = 0.0, high: float = math.inf) -> Quantity:
    """Return a dimensionless quantity between ``low`` and ``high``."""
    return Quantity(name, "", low, high)


@dataclass(frozen=True)
class Law:
    """A hyperelastic law; stress and tangent follow by differentiation.

    Parameters
    ----------
    name : key in the registry.
    quantities : its parameters, each with unit and admissible values, in the order ``energy``
        takes them.
    energy : ``energy(strain, *parameters) -> W``, the strain energy density (kPa) of one point.
    fibres : whether the energy reads ``strain.fibre``.
    sheets : whether the energy reads ``strain.sheet`` too.
    shape_moduli : multiplying all of these by a factor multiplies the energy, except its
        volumetric part, by that factor. Regions of a scene scale these; a law without them cannot
        have regions.
    exponential : whether stress grows exponentially with strain. It only affects how the solver
        starts, see :mod:`emulator.fem.stress_iterates`.
    objective : whether a rotation of the body leaves the energy unchanged. A law of small strains
        is not.
    simpler : laws with one effect less, which take some of its parameters: the effect's name, and
        the law without it.
    """

    name: str
    quantities: tuple[Quantity, ...]
    energy: Callable[..., jax.Array]
    fibres: bool = False
    sheets: bool = False
    shape_moduli: tuple[str, ...] = ()
    exponential: bool = False
    objective: bool = True
    simpler: tuple[tuple[str, Law], ...] = ()

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the parameters, in the order ``energy`` takes them."""
        return tuple(quantity.name for quantity in self.quantities)


_PROBES = 24
_DIGITS = 8
_LARGEST = 0.25  # bound of a probe's displacement gradient, entry by entry


@kept
def law_identity(law: Law) -> str:
    """Return the name of the law and a hash of its parameters and of its energy at the probes."""
    parameters = [[q.name, q.unit, q.low, q.high] for q in law.quantities]
    values = [np.format_float_scientific(w, precision=_DIGITS - 1) for w in probed(law)]
    content = json.dumps([parameters, list(law.shape_moduli), values])
    return f"{law.name}:{hashlib.sha256(content.encode()).hexdigest()[:16]}"


def probed(law: Law) -> np.ndarray:
    """Return the energies (kPa) of the law at the probes, (24,); NaN where undefined."""
    rng = np.random.default_rng(20_231)
    gradients = _LARGEST * rng.uniform(-1.0, 1.0, (_PROBES, 3, 3))
    positions = rng.random((_PROBES, len(law.quantities)))
    parameters = np.column_stack([_value(q, positions[:, k]) for k, q in enumerate(law.quantities)])
    directions = jnp.asarray(np.linalg.qr(rng.normal(size=(3, 3)))[0][:2])

    def energy(H: jax.Array, parameters: jax.Array) -> jax.Array:
        return law.energy(Strain(H, None, directions), *parameters)

    with jax.ensure_compile_time_eval():  # numbers even inside jit
        return np.asarray(jax.jit(jax.vmap(energy))(gradients, parameters))


def _value(quantity: Quantity, position: np.ndarray) -> np.ndarray:
    """Return admissible values of a parameter at ``position`` in (0, 1)."""
    low = quantity.low if np.isfinite(quantity.low) else -1.0
    high = quantity.high if np.isfinite(quantity.high) else low + 4.0
    return low + (high - low) * (0.1 + 0.8 * position)


def quadratic(strain: Strain, kappa: jax.Array) -> jax.Array:
    """Return ``kappa/2 (J-1)^2`` in the unit of ``kappa``; finite even for an inverted point."""
    return 0.5 * kappa * strain.J_minus_1**2


def quadratic_logarithmic(strain: Strain, kappa: jax.Array) -> jax.Array:
    """Return ``kappa (J^2 - 1 - 2 ln J)`` in the unit of ``kappa``."""
    change = strain.J_minus_1
    # J^2 - 1 - 2 ln J = (J-1)^2 + 2 [(J-1) - ln J], without cancellation near J = 1.
    return kappa * (change**2 + 2.0 * (change - jnp.log1p(change)))


def logarithmic(strain: Strain, kappa: jax.Array) -> jax.Array:
    """Return ``kappa/2 (ln J)^2`` in the unit of ``kappa``."""
    return 0.5 * kappa * strain.ln_J**2
