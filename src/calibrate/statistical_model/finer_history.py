"""FEM of a body in time on a finer mesh, in steps half as long."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from calibrate.measurements.observation import Observation
from calibrate.measurements.words import kinds_of, names_of, parse
from calibrate.statistical_model.finer_fem import Known, MeshPair, flat_data
from calibrate.statistical_model.model import Model
from emulator.core.errors import InputError
from emulator.fem.campaign import at_once
from emulator.fem.history import BodyInTime, HistorySolver
from emulator.scenes.finer import finer


def finer_history(model: Model, solver: HistorySolver) -> FinerHistory:
    """Return FEM on the next finer mesh, or on the same where there is none, in shorter steps."""
    body, of = solver.scene.halved, "steps"
    with suppress(InputError):  # else by its steps alone
        body, of = replace(body, scene=finer(body.scene).scene), "mesh and steps"
    kinds = kinds_of(body)
    parts = {
        name: parse(kinds[part.kind], body, names_of(part)[-1])[1]
        for name, part in model.observe.parts.items()
    }
    return FinerHistory(model, solver, replace(solver, scene=body), parts, of)


@dataclass(frozen=True, eq=False)
class FinerHistory:
    """FEM of a body in time, of higher fidelity than ``solver``.

    parts : what is observed by the finer one, by name, at every second row as the model's.
    of : the word for what is finer (:class:`~calibrate.certificate.evidence.MeshChange`).
    """

    model: Model
    solver: HistorySolver
    fine: HistorySolver
    parts: Mapping[str, Observation]
    of: str

    @property
    def _body(self) -> BodyInTime:
        return self.fine.scene

    @property
    def nodes(self) -> int:
        """The number of nodes of the finer mesh."""
        return self._body.scene.node_count

    @property
    def workers(self) -> int:
        """The number of draws that are solved at once."""
        return at_once(self.fine)

    def __call__(self, draw: Mapping[str, Any], known: Known = ()) -> MeshPair:  # noqa: ARG002
        """Return the data at ``draw``; :class:`SolverError` where a step fails."""
        (theta,) = self.model.states.thetas(draw)
        u, observe = self.fine(theta), self.model.observe
        seen = {n: jnp.ravel(part(u[part.nodes], theta)[1::2]) for n, part in self.parts.items()}
        seen = {n: values[observe.entries.get(n, slice(None))] for n, values in seen.items()}
        coarse = flat_data(observe, [self.solver(theta)], theta[None])
        return MeshPair(np.asarray(ravel_pytree(seen)[0]), coarse)

    def forget(self) -> None:
        """Do nothing: factors are not kept."""
