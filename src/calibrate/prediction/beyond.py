r"""How far a prediction goes beyond the data, by the law's own measures, and what that costs.

A law of exponentials is known where tissue was stretched, and guessed beyond. The measures are
:math:`I_1 = \operatorname{tr} F^T F` and, of a law with fibres, :math:`I_{4f} = |F f|^2`. Their
ranges over the bodies that it was learned on, in every load state at the posterior's mean and at
rest, are compared with the body that is predicted, at its mean draw.

**Distance.** Strains are as :math:`\sqrt{I_1 - 3}` and :math:`I_{4f} - 1`. Of a point of the body

.. math:: d = \max\Big(0,\ \tfrac12 \ln \frac{I_1 - 3}{\max_\text{data} (I_1 - 3)},\
              \ln \frac{I_{4f} - 1}{\max_\text{data} (I_{4f} - 1)}\Big),

0.41 where it is strained half as much again as the data was. Of the body it is the mean, weighted
by :math:`I_1 - 3`, as its energy is; each state of a specimen has its own.

**What laws miss there.** Of five sets of real tests the first half or two thirds of each curve were
given, and the rest predicted. The logarithm of measured over predicted stresses grew with the
distance: bands of 90 % held 57 % of the points, and 93 % once the response at each draw was
multiplied by :math:`e^{s d \epsilon}` with a normal :math:`\epsilon` and :math:`s = 1`
(docs/experiments.md, "How far do laws miss beyond the data?"). Between sets s is 0 to 2, so these
bands are too wide for some tissues and too narrow for others.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np

from calibrate.prediction.predict import Predicted
from calibrate.prediction.transfer import Learned
from calibrate.state_names import in_state, split
from emulator.fem.fields import element_fields
from emulator.scenes.forward_problem import ForwardProblem
from emulator.scenes.scene import Scene, with_mesh
from emulator.specimens.specimen import Specimen
from emulator.surrogates.protocol import ForwardMap

_AT_REST = {"I1": 3.0, "I4f": 1.0}
_POWER = {"I1": 0.5, "I4f": 1.0}  # by which a strain follows from a measure less its value at rest
_SLACK = 0.01  # of a range of the data, by which it may be exceeded
_LOG_SD = 1.0  # of the response, for a distance of 1


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


@dataclass(frozen=True)
class Beyond:
    """How far a prediction goes beyond the data.

    reaches : each measure in each load state.
    distances : the distance of each load state, of a specimen those of its states (m,).
    """

    reaches: list[Reach]
    distances: Mapping[str, np.ndarray]

    def __str__(self) -> str:
        """Return the largest distances as a sentence; empty where all is within the data."""
        most = {state: float(np.max(d)) for state, d in self.distances.items()}
        far = [f"{d:.2g}{state and f' in {state}'}" for state, d in most.items() if d > 0.0]
        if not far:
            return ""
        return (
            f"beyond the data by {', '.join(far)} (log of strain over the data's): real tissue "
            f"missed laws there by a factor of log sd {_LOG_SD:g} times that, which the outer "
            "band has"
        )


def how_far_beyond(
    learned: Learned,
    scene: ForwardProblem,
    forward: ForwardMap,
    states: Sequence[str],
    thetas: jax.Array,
) -> Beyond:
    """Return how far a prediction goes beyond what ``learned`` saw.

    forward : a map of the whole body. thetas : theta (s, S, p) of all draws.
    """
    there: dict[str, list[np.ndarray]] = {}
    for body, thetas_there in learned.bodies:
        for theta in thetas_there:
            for name, (values, _) in _measures(body, body.scene, theta).items():
                there.setdefault(name, [np.array([_AT_REST[name]])]).append(values)
    ranges = {name: (min(map(np.min, v)), max(map(np.max, v))) for name, v in there.items()}
    accounts, distances = list[Reach](), dict[str, np.ndarray]()
    for state, theta in zip(states, jnp.mean(thetas, axis=0), strict=True):
        measures = _measures(forward, scene, theta)
        far = np.zeros(1)
        for name, (values, weights) in measures.items():
            if name not in ranges:
                continue
            low, high = ranges[name]
            slack = _SLACK * (high - low)
            outside = (values < low - slack) | (values > high + slack)
            share = float(weights[outside].sum() / weights.sum())
            reached = float(values.min()), float(values.max())
            accounts.append(Reach(name, state, (float(low), float(high)), reached, share))
            most = high - _AT_REST[name]
            if most > 0.0:
                ratio = np.maximum(values - _AT_REST[name], most) / most
                far = np.maximum(far, _POWER[name] * np.log(ratio))
        strained, weights = measures.get("I1", (np.full(1, 4.0), np.ones(1)))
        energy = weights * np.maximum(strained - 3.0, np.finfo(float).tiny)
        is_each = isinstance(scene, Specimen) and scene.tube is None
        distances[state] = far if is_each else (far * energy).sum() / energy.sum()
    return Beyond(accounts, distances)


def widened(predicted: Predicted, beyond: Beyond, seed: int = 0) -> Predicted:
    """Return the prediction with what laws miss at its distances from the data.

    The factor is one of all numbers of a draw, of what differs from the body at rest.
    """
    epsilon = np.random.default_rng([seed, 7]).normal(size=len(predicted.thetas))
    observe, at_rest = predicted.observe, predicted.observe.nodes
    nothing = jnp.zeros((len(observe.states), len(at_rest), 3))
    rest = observe(nothing, jnp.mean(predicted.thetas, axis=0))
    values = {}
    for name, y in predicted.values.items():
        distance = np.asarray(beyond.distances[split(name)[1]])
        # Over the draws first, over the states of a specimen next.
        sizes = distance.reshape((1, *distance.shape, *[1] * (y.ndim - 1 - distance.ndim)))
        factor = np.exp(_LOG_SD * sizes * epsilon.reshape((-1, *[1] * (y.ndim - 1))))
        begin = np.nan_to_num(np.asarray(rest[name]))
        values[name] = begin + (y - begin) * factor
    return replace(predicted, values=values)


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
