"""Errors of a forward map against reference solutions (Dalton et al. 2023, Eqs. 26-28)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.stats import gaussian_kde

from emulator.core.errors import InputError, SolverError
from emulator.fem.energy import potential_energy
from emulator.fem.reactions import SupportForce, support_forces
from emulator.geometry.facets import Cavity
from emulator.scenes.loads.force import MN_PER_N
from emulator.scenes.scene import Scene, cavity_sets, with_mesh
from emulator.surrogates.protocol import ForwardMap

UNITS = {
    "err_u": "mm",
    "err_F": "1",
    "err_I1": "1",
    "err_E": "1",
    "err_Pi": "%",
    "err_V": "%",
    "err_R": "N",
    "max_u": "mm",
    "mean_u": "mm",
    "max_R": "N",
}
_VALUES = 20_000  # from which a density is estimated; more do not change the curve visibly


def quantiles(errors: jax.Array | np.ndarray) -> dict[str, float]:
    """Return median, mean, 97.5 % quantile and maximum over all entries."""
    values = np.asarray(errors).ravel()
    return {
        "median": float(np.median(values)),
        "mean": float(np.mean(values)),
        "q97_5": float(np.quantile(values, 0.975)),
        "max": float(np.max(values)),
    }


def log_density(errors: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Return errors (300,) and the density of ``log10(errors)`` there; None where all are equal."""
    positive = errors[errors > 0.0]  # prescribed nodes have zero error, without a logarithm
    logs = np.log10(positive[:: max(1, len(positive) // _VALUES)])
    if len(logs) < 2 or np.ptp(logs) < 1e-6:
        return None
    estimate = gaussian_kde(logs)
    width = 3.0 * float(np.sqrt(estimate.covariance[0, 0]))
    low, high = np.quantile(logs, [0.001, 0.999])
    at = np.linspace(low - width, high + width, 300)
    return 10.0**at, estimate(at)


def field_errors(
    scene: Scene,
    theta: jax.Array,
    u: jax.Array,
    reference: jax.Array,
    cavities: Sequence[Cavity] = (),
    supports: Sequence[SupportForce] = (),
    forces: jax.Array | None = None,
) -> dict[str, jax.Array]:
    """Return the errors of one field ``u`` (n, 3) against ``reference`` (n, 3).

    forces : the force (r,) in N of each of the ``supports``; by default as ``u`` has it.

    err_u : the distance (n,) in mm at each node.
    err_F : the Frobenius norm (m, q) of the error in the deformation gradient.
    err_I1 : the error (m, q) in the first invariant.
    err_E : the largest error (m, q) among the components of the Green-Lagrange strain.
    err_Pi : the error () in the potential energy, percent; absent where the mesh is the loaded
        (``Scene.loaded_by``), since the energy needs displacements from rest.
    err_V : the error (v,) in the volume of each of the ``cavities``, percent; absent without any.
    err_R, max_R : the error (r,) in the force of each of the ``supports``, and the largest force ()
        of the reference, N; absent without any.
    """
    H, H_reference = scene.gradients(u), scene.gradients(reference)
    I1, I1_reference = (
        2.0 * jnp.trace(h, axis1=-2, axis2=-1) + jnp.sum(h * h, (-2, -1)) for h in (H, H_reference)
    )
    F, F_reference = (h + jnp.eye(3) for h in (H, H_reference))
    C, C_reference = (jnp.swapaxes(f, -1, -2) @ f for f in (F, F_reference))
    errors = {
        "err_u": jnp.sqrt(jnp.sum((u - reference) ** 2, axis=-1)),
        "err_F": jnp.sqrt(jnp.sum((H - H_reference) ** 2, axis=(-2, -1))),
        "err_I1": jnp.abs(I1 - I1_reference),
        "err_E": 0.5 * jnp.max(jnp.abs(C - C_reference), axis=(-2, -1)),
    }
    if not scene.loaded_by:
        Pi = potential_energy(scene)
        errors["err_Pi"] = _percent(Pi(u, theta), Pi(reference, theta))
    if cavities:
        volumes = [_percent(V(u[V.nodes]), V(reference[V.nodes])) for V in cavities]
        errors["err_V"] = jnp.stack(volumes)
    if supports:
        resultants, exact = (
            jnp.stack([R(v[R.nodes], theta) / MN_PER_N for R in supports]) for v in (u, reference)
        )
        resultants = resultants if forces is None else forces
        errors |= {"err_R": jnp.abs(resultants - exact), "max_R": jnp.max(jnp.abs(exact))}
    return errors


def _percent(value: jax.Array, exact: jax.Array) -> jax.Array:
    return 100.0 * jnp.abs((value - exact) / exact)


@dataclass(frozen=True, eq=False)
class Errors:
    """Errors of each test case for which the forward map returns a valid prediction.

    thetas : the theta of the test cases, (c, p).
    fields : name -> (c, ...), as in :func:`field_errors`, with ``max_u`` and ``mean_u`` (c,), the
        size of the reference.
    invalid : the number of cases left out.
    """

    thetas: np.ndarray
    fields: Mapping[str, np.ndarray]
    invalid: int

    def report(self) -> dict[str, Any]:
        """Return quantiles of every field, ``units``, ``cases`` and ``invalid``, as plain JSON."""
        summary = {name: quantiles(values) for name, values in self.fields.items()}
        units = {name: unit for name, unit in UNITS.items() if name in self.fields}
        return {**summary, "units": units, "cases": len(self.thetas), "invalid": self.invalid}


def case_errors(forward: ForwardMap, thetas: jax.Array, reference: jax.Array) -> Errors:
    """Return the errors of ``forward`` at ``thetas`` (c, p) against ``reference`` (c, n, 3).

    :class:`InputError` for a map over some nodes, or a load without a potential;
    :class:`SolverError` where the map has no valid prediction for any case.
    """
    scene = with_mesh(forward.scene)
    if len(forward.nodes) != scene.node_count:
        raise InputError("evaluation needs a forward map over all nodes")
    cavities = [Cavity(scene.mesh, name) for name in cavity_sets(scene)]
    # The forces of a mesh that is the loaded one need displacements from rest, too.
    supports = () if scene.loaded_by else tuple(support_forces(scene).values())
    by_work = getattr(forward, "support_force", lambda _: None)
    work_forces = [by_work(support) for support in supports]

    @jax.jit
    def one(theta: jax.Array, exact: jax.Array) -> tuple[dict[str, jax.Array], jax.Array]:
        prediction = forward.evaluate(theta)
        u = prediction.displacement
        forces = [
            (R(u[R.nodes], theta) if known is None else known(theta)) / MN_PER_N
            for R, known in zip(supports, work_forces, strict=True)
        ]
        stacked = jnp.stack(forces) if forces else None
        errors = field_errors(scene, theta, u, exact, cavities, supports, stacked)
        size = jnp.sqrt(jnp.sum(exact**2, axis=-1))
        errors |= {"max_u": jnp.max(size), "mean_u": jnp.mean(size)}
        finite = jnp.array([jnp.all(jnp.isfinite(value)) for value in errors.values()])
        return errors, prediction.valid & jnp.all(finite)

    cases = [one(theta, u) for theta, u in zip(thetas, reference, strict=True)]
    valid = np.array([bool(ok) for _, ok in cases])
    if not valid.any():
        raise SolverError(
            f"the {forward.kind} map has no valid answer for any of {len(cases)} test cases"
        )
    errors = [errors for errors, ok in cases if ok]
    fields = {name: np.stack([case[name] for case in errors]) for name in errors[0]}
    return Errors(np.asarray(thetas)[valid], fields, int((~valid).sum()))


def evaluate(forward: ForwardMap, thetas: jax.Array, reference: jax.Array) -> dict[str, Any]:
    """Return error quantiles of ``forward`` over test cases.

    Parameters
    ----------
    forward : a map over all nodes of its scene.
    thetas : the theta of the test cases, (c, p).
    reference : the reference displacements, (c, n, 3) mm.

    Returns
    -------
    dict with err_u, err_F, err_I1, err_E, err_Pi (of a body at rest) and, where the scene has
    cavities or supports that prescribe displacements, err_V or err_R and max_R (quantiles; over
    nodes, points, cavities or supports and cases together), max_u and mean_u (of |u| over the nodes
    of each case), units, cases (valid ones), and invalid, the number of the others.
    """
    return case_errors(forward, thetas, reference).report()
