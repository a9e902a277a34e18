"""How far a forward map is from FEM, and what FEM in its place would move, by quadrature."""

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import calibrate as cal
import emulator as em
from calibrate.posterior.diagnosis import map_fault
from calibrate.statistical_model.errors import map_errors
from emulator.accuracy.estimate import newton_distance
from emulator.fem.newton import NewtonOptions
from emulator.surrogates.emulator import CachedEmulator
from emulator.surrogates.protocol import Prediction
from emulator.surrogates.taylor import constant, expand

NODES = np.array([3, 11, 20, 30])
NOISE = 0.02


def test_a_newton_step_tells_what_the_map_misses(beam, simulator):
    forward = em.Emulator(beam, taylor=expand(simulator, order=1)).cache()
    model = cal.model(forward, cal.nodal_displacements(beam, NODES), cal.GaussianNoise(sd=NOISE))
    theta = beam.theta(mu=95.0, lam=55.0)
    draws = {
        name: np.full(20, float(value)) for name, value in zip(model.names, theta, strict=True)
    }
    off = np.asarray(forward(theta) - simulator(theta))[NODES]
    data = model.check_data(np.asarray(simulator(theta))[NODES])
    told = map_errors(model, simulator, draws, data).sizes
    assert told == {"displacement": pytest.approx(np.sqrt(np.mean(off**2)) / NOISE, rel=0.1)}
    assert told["displacement"] > 1.0
    # Noise that is inferred, and that correlates: the sd of one number, as the draws have it.
    noise = cal.CorrelatedNoise(length=20.0, sd_scale=100.0, spatial_sd=0.4 * NOISE)
    model = cal.model(forward, cal.nodal_displacements(beam, NODES), noise)
    draws |= {"noise_sd": np.full(20, 0.3 * NOISE)}
    inferred = map_errors(model, simulator, draws, data)
    assert inferred.sizes["displacement"] == pytest.approx(2.0 * told["displacement"])


def posteriors(beam, noise, y, *maps):
    """Return means and sds (2,) of the posterior of each map by quadrature, and 2000 draws."""
    grid = np.stack(np.meshgrid(np.linspace(0.0, 1.0, 241), np.linspace(0.0, 1.0, 241)), axis=-1)
    thetas = beam.from_unit(jnp.asarray(grid.reshape(-1, 2)))
    for forward in maps:
        seen = jax.jit(jax.vmap(forward.at(np.array(NODES))))(thetas)
        heights = -0.5 * np.sum((np.asarray(seen) - y) ** 2, axis=(1, 2)) / noise**2
        weights = np.exp(heights - heights.max())
        weights /= weights.sum()
        mean = weights @ np.asarray(thetas)
        sd = np.sqrt(weights @ (np.asarray(thetas) - mean) ** 2)
        rows = np.random.default_rng(5).choice(len(weights), size=2000, p=weights)
        yield mean, sd, dict(zip(beam.parameter_names, np.asarray(thetas)[rows].T, strict=True))


@pytest.mark.parametrize("lacks", [False, True])
def test_the_move_of_a_mean_is_that_by_quadrature(beam, simulator, lacks):
    """Of a series cut short, and of a map that is right at its draws and far off beyond them."""

    def series(order):
        return em.Emulator(beam, taylor=expand(simulator, order=order)).cache()

    truth, noise = series(3), 0.1
    theta = beam.theta(mu=75.0, lam=75.0)
    y = np.asarray(truth(theta))[NODES]
    y = y + noise * np.random.default_rng(2).normal(size=y.shape)
    off = Half(truth, float(theta[1])) if lacks else series(1)
    (mean, _, _), (wrong, sd, draws) = posteriors(beam, noise, y, truth, off)
    model = cal.model(off, cal.nodal_displacements(beam, NODES), cal.GaussianNoise(sd=noise))
    told = map_errors(model, simulator, draws, model.check_data(y))
    move = np.max(np.abs(mean - wrong) / sd)
    if lacks:
        assert move > 0.5
        assert told.sizes["displacement"] < 0.05  # nothing is wrong where it has draws
        assert told.moves > 0.5
    else:
        assert told.moves == pytest.approx(move, abs=0.05)


@dataclass(frozen=True, eq=False)
class Half:
    """A map that errs by a few noise sd where lam is larger than ``end``."""

    right: CachedEmulator
    end: float
    kind = label = fingerprint = "half"

    @property
    def scene(self):
        return self.right.scene

    @property
    def nodes(self):
        return self.right.nodes

    def __call__(self, theta):
        return self.right(theta) * (1.0 + 0.05 * jax.nn.sigmoid(4.0 * (theta[1] - self.end)))

    def evaluate(self, theta):
        return Prediction(self(theta), jnp.array(True))

    def at(self, nodes):
        return replace(self, right=self.right.at(nodes))


def test_fem_tells_what_a_map_misses_where_no_newton_step_does(beam, simulator):
    """A field so rough that its tangent is indefinite, as a network's may be."""
    theta, observe = beam.centre, cal.nodal_displacements(beam, NODES)
    u = simulator(theta)
    rough = jnp.where(beam.held, 0.0, 3.0 * np.random.default_rng(1).normal(size=u.shape))
    assert not newton_distance(simulator.system, u + rough, theta).accepted
    forward = em.Emulator(beam, taylor=constant(np.full(len(theta), 0.5), u + rough)).cache()
    model = cal.model(forward, observe, cal.GaussianNoise(sd=NOISE))
    values = zip(model.names, theta, strict=True)
    draws = {name: np.full(20, float(value)) for name, value in values}
    expected = np.sqrt(np.mean(np.asarray(rough)[NODES] ** 2)) / NOISE
    data = model.check_data(np.asarray(u)[NODES])
    told = map_errors(model, simulator, draws, data)
    assert told.moves == 0.0  # the draws are all the same
    assert told.sizes == {"displacement": pytest.approx(expected, rel=1e-6)}
    lost = em.Simulator(beam, NewtonOptions(max_iterations=1))
    told = map_errors(model, lost, draws, data)
    assert told.moves == np.inf
    assert "misses FEM by an unknown amount in displacement" in map_fault(*told)[0]
