r"""The identity of a law: its name, its parameters, and its energy at fixed probes.

A law's code can change while its name stays. So the identity includes the values

.. math:: W(H_i; p_i), \qquad i = 1, \dots, 24

of its energy at fixed displacement gradients that stretch, squeeze and shear the fibres, with fixed
parameters; the values are rounded to eight digits, so that processors and releases of JAX agree.
"""

from __future__ import annotations

import hashlib
import json
from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np

from emulator.mechanics.kinematics import Strain
from emulator.mechanics.laws.law import Law
from emulator.mechanics.quantity import Quantity

_PROBES = 24
_DIGITS = 8
_LARGEST = 0.25  # bound of a probe's displacement gradient, entry by entry


@lru_cache(maxsize=64)
def law_identity(law: Law) -> str:
    """Name of the law and a hash of its parameters and of its energy at the probes."""
    parameters = [[q.name, q.unit, q.low, q.high] for q in law.quantities]
    values = [np.format_float_scientific(w, precision=_DIGITS - 1) for w in probed(law)]
    content = json.dumps([parameters, list(law.shape_moduli), values])
    return f"{law.name}:{hashlib.sha256(content.encode()).hexdigest()[:16]}"


def probed(law: Law) -> np.ndarray:
    """Energies (kPa) of the law at the probes, (24,); NaN where undefined."""
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
    """Admissible values of a parameter at ``position`` in (0, 1)."""
    low = quantity.low if np.isfinite(quantity.low) else -1.0
    high = quantity.high if np.isfinite(quantity.high) else low + 4.0
    return low + (high - low) * (0.1 + 0.8 * position)
