r"""Modes for a separable decoder, computed from mechanics.

They span the Taylor series of the equilibrium about the centre, and so the body's response to these
parameters, and they are orthonormal in the tangent there:
:math:`\phi_j \cdot K_c\, \phi_k = \delta_{jk}`. In their coefficients the potential energy is round
near the centre, which keeps training on it from leaving the soft modes behind.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from emulator.fem import Simulator
from emulator.surrogates.taylor import Expansion

_SAMPLES = 400
_TRUNCATION = 1e-12  # relative to the largest energy
_STEP = 0.1  # a unit of the network's output, in root mean squares of a mode's coefficient


def mechanical_modes(simulator: Simulator, series: Expansion, most: int) -> np.ndarray:
    """Modes (f, n, 3) mm, f at most ``most``, scaled so that coefficients of order 1 are typical.

    There are none for a series of order 0.
    """
    count, shape = len(series.indices), series.displacement.shape
    if count == 0 or most == 0:
        return np.zeros((0, *shape))
    scene = simulator.scene
    samples = np.random.default_rng(0).random((_SAMPLES, len(scene.parameters)))
    rms = np.sqrt(np.mean(np.asarray(series.monomials(jnp.asarray(samples))) ** 2, axis=0))
    fields = np.asarray(series.derivatives) * rms[:, None, None]
    energies, vectors = np.linalg.eigh(_energies(simulator, series, fields))
    order = np.argsort(energies)[::-1][:most]
    order = order[energies[order] > _TRUNCATION * energies.max()]
    # Each is a unit vector in K_c times the root of its energy, the rms of its coefficient.
    return _STEP * np.tensordot(vectors[:, order].T, fields, axes=1)


def _energies(simulator: Simulator, series: Expansion, fields: np.ndarray) -> np.ndarray:
    """Products (t, t) of ``fields`` (t, n, 3) in the tangent at the centre, mN mm."""
    system = simulator.system
    theta = simulator.scene.from_unit(jnp.asarray(series.centre))

    @jax.jit
    def pulled(field: jax.Array) -> jax.Array:
        force = lambda u: system.residual(u, theta)  # noqa: E731
        return jax.jvp(force, (series.displacement,), (field,))[1]

    forces = np.stack([np.asarray(pulled(jnp.asarray(field))) for field in fields])
    free = fields.reshape(len(fields), -1)[:, np.asarray(system.free)]
    products = free @ forces.T
    return 0.5 * (products + products.T)
