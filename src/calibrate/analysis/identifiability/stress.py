r"""The stress-stretch band a posterior implies: often well known where its parameters are not.

Along an isochoric stretch :math:`\lambda` of direction e, transversely :math:`\lambda^{-1/2}`,

.. math:: F = \lambda\, e \otimes e + \lambda^{-1/2} (I - e \otimes e), \qquad
          \sigma_{ee} - \sigma_\perp = \lambda \frac{dW}{d\lambda}

with :math:`\sigma_\perp` the mean of the two transverse Cauchy stresses: J is 1 on the whole path,
so that :math:`\dot W = \sigma : d` and :math:`d = \frac{\dot\lambda}{\lambda}\,
\text{diag}(1, -\frac12, -\frac12)`. The pressure that incompressibility leaves free drops out.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from calibrate.posterior import Posterior
from emulator.core.errors import InputError, look_up
from emulator.fem.energy import point_energy
from emulator.scenes.regions import Tissue
from emulator.scenes.scene import Scene

STRETCHES = np.linspace(1.0, 1.25, 26)
_DRAWS = 500
_FIBRE, _CROSS = jnp.array([1.0, 0.0, 0.0]), jnp.array([0.0, 1.0, 0.0])


class StressBand(NamedTuple):
    """Difference of axial and transverse Cauchy stress, kPa, over ``stretch`` (n,).

    direction : ``fibre`` or ``cross-fibre``.
    low, median, high : (n,) quantiles over the posterior's draws.
    """

    direction: str
    stretch: np.ndarray
    low: np.ndarray
    median: np.ndarray
    high: np.ndarray


def stress_band(
    posterior: Posterior,
    direction: str = "fibre",
    *,
    stretches: Sequence[float] | np.ndarray = STRETCHES,
    probability: float = 0.9,
) -> StressBand:
    """The band of stresses under a stretch along ``fibre`` or ``cross-fibre``.

    A law without fibres has no directions; both are the same then. In a scene with regions it is
    that of a stiffness factor of the first.

    Raises
    ------
    InputError
        Another direction, or a stretch that is not above 0.
    """
    axis = look_up({"fibre": _FIBRE, "cross-fibre": _CROSS}, direction, "stress: direction")
    stretch = np.asarray(stretches, dtype=float)
    if not (stretch > 0.0).all():
        raise InputError("stress: stretches must be above 0; 1 is no stretch")
    model = posterior.model
    state = model.states.states[0]  # the material is the same in every load state
    thetas = posterior.thetas(state)
    rows = np.linspace(0, len(thetas) - 1, min(_DRAWS, len(thetas))).astype(int)
    curve = jax.jit(jax.vmap(lambda t: stresses(model.forward.scene, t, axis, stretch)))
    edge = 0.5 * (1.0 - probability)
    found = np.quantile(np.asarray(curve(thetas[rows])), [edge, 0.5, 1.0 - edge], axis=0)
    return StressBand(direction, stretch, *found)


def stresses(scene: Scene, theta: jax.Array, axis: jax.Array, stretch: np.ndarray) -> jax.Array:
    """Stress difference (n,) in kPa along ``axis`` (3,); fibres are along x, sheets along y."""
    energy, at = point_energy(scene, theta), _tissue(scene)

    def along(value: jax.Array) -> jax.Array:
        projection = jnp.outer(axis, axis)
        F = value * projection + (jnp.eye(3) - projection) / jnp.sqrt(value)
        return energy(F - jnp.eye(3), at)

    lam = jnp.asarray(stretch)
    return lam * jax.vmap(jax.grad(along))(lam)


def _tissue(scene: Scene) -> Tissue:
    """One element's tissue with the fibre along x, and the sheet along y."""
    directions = None
    if scene.law.sheets:
        directions = jnp.stack([_FIBRE, _CROSS])
    elif scene.law.fibres:
        directions = _FIBRE
    return Tissue(directions, None if scene.regions is None else jnp.array(0))
