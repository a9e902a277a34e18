"""The force of a moved support by the work of the body: right to second order, where stresses err.

Displacements that are wrong on purpose are the measure: a hundredth of the motion off at random.
"""

from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import calibrate as cal
import emulator as em
from calibrate.measurements import observations
from calibrate.measurements.outputs import Outputs
from emulator.fem.reactions import SupportForce
from emulator.geometry.generators.box import box
from emulator.mechanics.laws import find_law
from emulator.scenes import Parameter, Scene, Support
from emulator.scenes.loads import FollowerPressure, Gravity
from emulator.scenes.loads.prestress import Prestress
from emulator.scenes.supports.elastic import ElasticSupport
from emulator.surrogates import support_work
from emulator.surrogates.support_work import SupportWork, amount_of
from emulator.surrogates.taylor import expand

X = (1.0, 0.0, 0.0)
Z = (0.0, 0.0, 1.0)


@pytest.fixture(scope="module")
def simulator():
    """A sheet under tension, on springs, one edge of which is pulled and lifted."""
    return em.Simulator(
        Scene(
            name="sheet",
            mesh=box((8.0, 4.0, 1.0), (4, 2, 1), order=2),
            law=find_law("neo_hookean_split"),
            parameters=(
                Parameter("mu", "kPa", 1.0, 10.0, "log"),
                Parameter("pull", "", 0.0, 1.0),
                Parameter("lift", "", -0.5, 0.5),
                Parameter("springs", "kPa/mm", 0.1, 1.0, "log"),
                Parameter("prestress", "kPa", 0.1, 2.0, "log"),
            ),
            constants={"kappa": 50.0},
            loads=(Prestress(),),
            supports=(
                Support("left"),
                Support("right", X, "x", amount="pull"),
                Support("right", Z, "z", amount="lift"),
                Support("front", components="y"),
                Support("back", components="y"),
                ElasticSupport("bottom", None, parameter="springs"),
            ),
            dilatation="mean",
        )
    )


@pytest.fixture(scope="module")
def emulator(simulator):
    return em.Emulator(simulator.scene, taylor=expand(simulator, order=3))


@dataclass(frozen=True)
class Wrong:
    """A displacement that is off by ``size`` times a field that grows with the pull."""

    of: Any
    off: np.ndarray
    size: float

    @property
    def nodes(self):
        return self.of.nodes

    def __call__(self, theta):
        return self.of(theta) + self.size * theta[1] * self.off

    def at(self, nodes):
        rows = [self.of.nodes.tolist().index(node) for node in nodes]
        return Wrong(self.of.at(nodes), self.off[rows], self.size)


KNOWN = {"pull": 0.5, "lift": 0.1, "springs": 0.3, "prestress": 0.5}


def moved(scene):
    return scene.theta(mu=3.0, **KNOWN)


def test_an_error_of_the_displacement_enters_squared(simulator, emulator):
    scene = simulator.scene
    force, theta = SupportForce(scene, "right", X), moved(scene)
    off = np.where(scene.held, 0.0, np.random.default_rng(0).normal(size=scene.held.shape))
    exact = float(force(simulator(theta)[force.nodes], theta))

    def errors(size):
        forward = Wrong(emulator.cache(), off, size)
        work = SupportWork(forward, force, "pull")
        return [
            abs(float(found) - exact) / abs(exact)
            for found in (work(theta), force(forward.at(force.nodes)(theta), theta))
        ]

    (small, at_plate), (large, _) = errors(0.002), errors(0.004)
    assert errors(0.0)[0] < 1e-4
    assert at_plate > 2.0 * small
    assert large / small == pytest.approx(4.0, rel=0.1)


@pytest.mark.parametrize("direction", [X, Z, (0.6, 0.0, 0.8)])
def test_a_few_points_stand_for_all(simulator, emulator, direction, monkeypatch):
    """Weights are 0 or more, and fewer than points; the force is that of all, and FEM's."""
    monkeypatch.setattr(support_work, "_FEWEST", 24)
    monkeypatch.setattr(support_work, "_PER_PARAMETER", 2)
    scene = simulator.scene
    force, theta = SupportForce(scene, "right", direction), moved(scene)
    work = SupportWork(emulator.cache(), force, amount_of(force))
    cells, weights = work._weighed
    assert len(weights) == len(cells.points) + len(cells.springs[0]) <= 24
    assert np.all(weights > 0.0)
    expected = float(force(simulator(theta)[force.nodes], theta))
    assert float(work(theta)) == pytest.approx(expected, rel=1e-2)


def test_which_parameter_moves_a_support(simulator):
    scene = simulator.scene
    assert amount_of(SupportForce(scene, "right", X)) == "pull"
    assert amount_of(SupportForce(scene, "right", Z)) == "lift"
    assert amount_of(SupportForce(scene, "front", (0.0, 1.0, 0.0))) is None
    assert amount_of(SupportForce(scene, "left", X)) is None


@pytest.mark.parametrize(
    "loads",
    [
        (Gravity(density=1.0, acceleration=9.8), Prestress()),
        (FollowerPressure("top", 0.1), Prestress()),
        (Prestress(normal="y"),),  # top and bottom are free
    ],
)
def test_a_body_that_does_not_rest_as_it_lies(simulator, loads):
    scene = replace(simulator.scene, loads=loads)
    assert amount_of(SupportForce(scene, "right", X)) is None


def test_an_amount_that_moves_two_supports(simulator):
    supports = simulator.scene.supports
    scene = replace(simulator.scene, supports=(Support("left", X, amount="pull"), *supports[1:]))
    assert amount_of(SupportForce(scene, "right", X)) is None


def test_a_model_takes_it_cold_under_jit_and_in_batches(simulator, emulator):
    scene = simulator.scene
    observe, theta = cal.Reaction(scene, "right", "x"), moved(scene)
    model = cal.model(emulator.cache(), observe, cal.GaussianNoise(sd=1e-4), known=KNOWN)
    expected = float(observe(simulator(theta)[observe.nodes], theta))

    def predicted(mu):
        return model.predict({"mu": mu})[0]["reaction:right:x"]

    slope = jax.jit(jax.grad(predicted))(jnp.asarray(3.0))  # traced before anything is computed
    at = jax.jit(jax.vmap(predicted))(jnp.array([2.999, 3.0, 3.001]))
    assert float(at[1]) == pytest.approx(expected, rel=2e-3)
    assert float(slope) == pytest.approx(float(at[2] - at[0]) / 0.002, rel=1e-5)
    outputs = Outputs(emulator.cache(), observations({"force": observe}))
    assert outputs.values(theta[None])[0, 0] == pytest.approx(float(at[1]), rel=1e-9)
    assert outputs.slopes(theta[None])[0, 0, 0] == pytest.approx(float(slope), rel=1e-6)


def test_outside_the_box_there_is_no_force(emulator):
    scene = emulator.scene
    observe = cal.Reaction(scene, "right", "x")
    theta = moved(scene).at[0].set(1e3)
    data, valid = cal.model(emulator.cache(), observe, cal.GaussianNoise(sd=1e-4)).means(
        theta[None]
    )
    assert not bool(valid)
    assert float(data["reaction:right:x"]) == 0.0
