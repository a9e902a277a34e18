"""Errors of a forward map against reference solutions (Dalton et al. 2023, Eq. 26)."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from emulator.errors import InputError
from emulator.forward import ForwardMap
from emulator.mechanics.energy import displacement_gradient, potential_energy
from emulator.scenes.scene import Scene

UNITS = {"err_u": "mm", "err_F": "1", "err_I1": "1", "err_Pi": "%", "max_u": "mm"}


def quantiles(errors: jax.Array) -> dict[str, float]:
    """Median, mean, 97.5 % quantile and maximum over all entries."""
    values = np.asarray(errors).ravel()
    return {
        "median": float(np.median(values)),
        "mean": float(np.mean(values)),
        "q97_5": float(np.quantile(values, 0.975)),
        "max": float(np.max(values)),
    }


def field_errors(
    scene: Scene, theta: jax.Array, u: jax.Array, reference: jax.Array
) -> dict[str, jax.Array]:
    """Errors of one field ``u`` (n, 3) against ``reference`` (n, 3).

    err_u : (n,) distance in mm at each node.
    err_F : (m, q) Frobenius norm of the error in the deformation gradient.
    err_I1 : (m, q) error in the first invariant.
    err_Pi : () error in the potential energy, percent.
    """
    Pi = potential_energy(scene)
    H, H_reference = displacement_gradient(scene, u), displacement_gradient(scene, reference)
    I1, I1_reference = (
        2.0 * jnp.trace(h, axis1=-2, axis2=-1) + jnp.sum(h * h, (-2, -1)) for h in (H, H_reference)
    )
    least = Pi(reference, theta)
    return {
        "err_u": jnp.sqrt(jnp.sum((u - reference) ** 2, axis=-1)),
        "err_F": jnp.sqrt(jnp.sum((H - H_reference) ** 2, axis=(-2, -1))),
        "err_I1": jnp.abs(I1 - I1_reference),
        "err_Pi": 100.0 * jnp.abs((Pi(u, theta) - least) / least),
    }


def evaluate(forward: ForwardMap, thetas: jax.Array, reference: jax.Array) -> dict[str, Any]:
    """Error quantiles of ``forward`` over test cases.

    Parameters
    ----------
    forward : a map over all nodes of its scene.
    thetas : (c, p).
    reference : (c, n, 3) mm.

    Returns
    -------
    dict with err_u, err_F, err_I1, err_Pi (quantiles; over nodes or points and cases together),
    max_u (largest |u| of each case), units, cases.
    """
    scene = forward.scene
    if len(forward.nodes) != len(scene.mesh.nodes):
        raise InputError("evaluation needs a forward map over all nodes")
    one = jax.jit(lambda theta, u: field_errors(scene, theta, forward(theta), u))
    errors = [one(theta, u) for theta, u in zip(thetas, reference, strict=True)]
    report: dict[str, Any] = {
        name: quantiles(jnp.stack([case[name] for case in errors])) for name in errors[0]
    }
    largest = jnp.max(jnp.sqrt(jnp.sum(jnp.asarray(reference) ** 2, axis=-1)), axis=1)
    report["max_u"] = quantiles(largest)
    return {**report, "units": UNITS, "cases": len(errors)}
