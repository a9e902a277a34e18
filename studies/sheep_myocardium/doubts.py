r"""What is not known of a heart, in terms of what its data says.

A cube's process does not know q to :math:`B \lambda` (:mod:`.process`). Where forces fit, that adds

.. math:: d^2 = \lambda \sum_m \mathrm{tr}\, C_m^{-1} (B_m \circ F_m F_m^T)

to the square of the cube's misfit in the mean, C the data's covariance of a mode m and F its
forces. The log likelihood moves by about d where the data is an sd off.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from studies.sheep_myocardium.curves import Fit
from studies.sheep_myocardium.inference import Found, covariances

KNOWN = 0.2
"""Root mean square of :func:`doubts` at draws of a posterior, of a cube whose forces are known."""
UNKNOWN = 1.0
"""The same of one whose forces are not known: an sd of the data."""


def doubts(fitted: Fit, found: Found) -> np.ndarray:
    """d of each cube at draws, (d, 3)."""
    each = [_of_cube(k, fitted, found) for k in range(len(fitted.known))]
    return np.stack(each, axis=1)


def known_to(each: np.ndarray) -> np.ndarray:
    """Root mean square (3,) of :func:`doubts` over draws: what log likelihoods are known to."""
    root: np.ndarray = np.sqrt((each**2).mean(axis=0))
    return root


def _of_cube(number: int, fitted: Fit, found: Found) -> np.ndarray:
    share, B = fitted.unknown(number, found.positions[:, number])
    amounts = fitted.emulated.amounts[number]
    modes, j = amounts.shape
    own = np.moveaxis(np.diagonal(B.reshape(modes, j, modes, j), axis1=0, axis2=2), -1, 0)
    force = found.draws["means"][:, number * modes : (number + 1) * modes]
    omega = found.draws["omega"][:, None, None, None]
    C = np.asarray(covariances(amounts, jnp.asarray(force), jnp.asarray(omega)))
    moved = own * force[..., None, :] * force[..., :, None]
    added = np.trace(np.linalg.solve(C, moved), axis1=2, axis2=3).sum(axis=1)
    root: np.ndarray = np.sqrt(share * added)
    return root
