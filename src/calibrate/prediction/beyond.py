r"""How far a prediction goes beyond the data, by the law's own measures.

A law of exponentials is known where tissue was stretched, and guessed beyond. The measures are
:math:`I_1 = \operatorname{tr} F^T F` and, of a law with fibres, :math:`I_{4f} = |F f|^2`. Their
ranges over the bodies that it was learned on, in every load state at the posterior's mean and at
rest, are compared with the body that is predicted, at its mean draw.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from calibrate.prediction.transfer import Learned
from calibrate.state_names import in_state
from emulator.fem.fields import element_fields
from emulator.scenes.forward_problem import ForwardProblem
from emulator.scenes.scene import Scene, with_mesh
from emulator.specimens.specimen import Specimen
from emulator.surrogates.protocol import ForwardMap

_AT_REST = {"I1": 3.0, "I4f": 1.0}
_SLACK = 0.01  # of a range of the data, by which it may be exceeded


@dataclass(frozen=True)
class Reach:
    """One measure in one load state.

    measure, state : their names. learned : its range over the data's bodies.
    reached : its range over the body that is predicted.
    share : the share of that body's volume, or of its states, where it is outside.
    """

    measure: str
    state: str
    learned: tuple[float, float]
    reached: tuple[float, float]
    share: float

    def __str__(self) -> str:
        """Return the account as a sentence."""
        learned, reached = ("{:.3g} to {:.3g}".format(*r) for r in (self.learned, self.reached))
        return (
            f"{in_state(self.measure, self.state)} is {reached}, and the data had {learned}: "
            f"{100.0 * self.share:.0f} % of the body lies beyond"
        )


def reaches(
    learned: Learned,
    scene: ForwardProblem,
    forward: ForwardMap,
    states: tuple[str, ...],
    thetas: jax.Array,
) -> list[Reach]:
    """Return the reach of each measure in each load state of a prediction.

    forward : a map of the whole body. thetas : theta (s, S, p) of all draws.
    """
    there: dict[str, list[np.ndarray]] = {}
    for body, thetas_there in learned.bodies:
        for theta in thetas_there:
            for name, (values, _) in _measures(body, body.scene, theta).items():
                there.setdefault(name, [np.array([_AT_REST[name]])]).append(values)
    accounts = []
    for state, theta in zip(states, jnp.mean(thetas, axis=0), strict=True):
        for name, (values, weights) in _measures(forward, scene, theta).items():
            if name not in there:
                continue
            low, high = (f(np.concatenate(there[name])) for f in (np.min, np.max))
            slack = _SLACK * (high - low)
            outside = (values < low - slack) | (values > high + slack)
            share = float(weights[outside].sum() / weights.sum())
            reached = float(values.min()), float(values.max())
            accounts.append(Reach(name, state, (float(low), float(high)), reached, share))
    return accounts


def _measures(
    forward: ForwardMap, scene: ForwardProblem, theta: jax.Array
) -> Mapping[str, tuple[np.ndarray, np.ndarray]]:
    """Return values (k,) and weights (k,) of each measure, over elements or a specimen's states.

    There are none of a mesh that is the loaded shape: its displacement is not from rest.
    """
    if isinstance(scene, Scene) and scene.loaded_by:
        return {}
    u = forward(theta)
    if isinstance(scene, Specimen):
        F = np.asarray(scene.gradients(u)) + np.eye(3)
        weights, fibres = np.ones(len(F)), scene.fibres
        values = {"I1": np.einsum("kij,kij->k", F, F)}
        if fibres is not None:
            along = np.einsum("kij,kj->ki", F, np.asarray(fibres).reshape(len(F), 3))
            values["I4f"] = np.einsum("ki,ki->k", along, along)
    else:
        body = with_mesh(scene)
        fields = element_fields(body, u, theta)
        weights = np.asarray(body.discretisation.weights).sum(axis=1)
        values = {"I1": 3.0 + 2.0 * np.einsum("kii->k", fields["green_lagrange"])}
        if scene.law.fibres:
            values["I4f"] = fields["fibre_stretch"] ** 2
    return {name: (array, weights) for name, array in values.items()}
