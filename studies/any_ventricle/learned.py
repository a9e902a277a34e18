"""What a network leaves of runs that are at hand."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from flax import nnx
from studies.any_ventricle.training import BodyRuns

from emulator.surrogates.network.family import FamilyEnsemble

_LOADED = 0.33  # position in the box from which a pressure counts as one of diastole


def error_of(learned: FamilyEnsemble, runs: BodyRuns) -> float:
    """The median over nodes and runs under a diastole's pressure of \\|u - u_FEM\\|, mm."""
    definition, _ = nnx.split(learned.outline)
    body = learned.standard.of(runs.features)
    which = learned.space.names.index(learned.pressure)
    loaded = runs.position[:, which] > _LOADED
    if not loaded.any():
        return float("nan")
    position, u = jnp.asarray(runs.position[loaded]), np.zeros(())
    for weights in learned.members:
        module = nnx.merge(definition, weights)
        modes, summary = module.prepare(body)
        coefficients = module.coefficients(position, body.numbers, summary, which)
        u = u + np.tensordot(coefficients, modes, axes=1) * learned.scale / len(learned.members)
    u = u * ~runs.held[:, None]
    return float(np.median(np.linalg.norm(u - runs.displacement[loaded], axis=-1)))
