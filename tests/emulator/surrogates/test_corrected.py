import jax
import jax.numpy as jnp
import numpy as np
import pytest

import emulator as em
from emulator.core.errors import InputError
from emulator.fem import run_campaign, sobol
from emulator.scenes.scene import all_nodes
from emulator.surrogates.corrected import corrected
from emulator.surrogates.fem import fem_forward
from emulator.surrogates.pod_gp import fit_reduced
from emulator.surrogates.protocol import Prediction, inside_only


class Off:
    """FEM with a smooth error of a known size."""

    kind = label = "off"

    def __init__(self, simulator, size):
        self.simulator, self.scene, self.size = simulator, simulator.scene, size
        self.nodes = all_nodes(self.scene)
        x = self.scene.mesh.nodes / self.scene.mesh.size
        self.fingerprint = f"off by {size}"
        self.error = np.where(self.scene.held, 0.0, np.sin(3 * x) * x[:, :1])

    def __call__(self, theta):
        return self.simulator.solve(theta).displacement + self.size * self.error

    def evaluate(self, theta):
        return Prediction(self(theta), jnp.array(True))

    def at(self, nodes):
        raise AssertionError("the corrector needs every node")


def test_each_step_about_squares_the_error(beam, simulator):
    exact = simulator(beam.centre)
    largest = lambda u: float(jnp.max(jnp.abs(u - exact)))
    errors = {}
    for size in (0.2, 0.1):
        base = Off(simulator, size)
        errors[size] = [largest(corrected(base, simulator, k)(beam.centre)) for k in (1, 2)]
        assert errors[size][0] < 0.3 * largest(base(beam.centre))
        assert errors[size][1] < 0.01 * errors[size][0]
    # Half the error before the step, a quarter after it.
    assert errors[0.2][0] / errors[0.1][0] == pytest.approx(4.0, rel=0.2)


def test_the_derivative_is_the_equilibriums(beam, simulator):
    polished = corrected(Off(simulator, 0.1), simulator, 2)
    weights = jnp.asarray(np.random.default_rng(0).normal(size=beam.held.shape))
    f = jax.grad(lambda t: jnp.vdot(weights, polished(t)))(beam.centre)
    g = jax.grad(lambda t: jnp.vdot(weights, simulator.solve(t).displacement))(beam.centre)
    np.testing.assert_allclose(f, g, rtol=1e-5)


def test_validity_and_nodes(beam, simulator):
    polished = corrected(Off(simulator, 0.1), simulator)
    nodes = np.array([7, 2])
    np.testing.assert_allclose(polished.at(nodes)(beam.centre), polished(beam.centre)[nodes])
    assert polished.evaluate(beam.centre).valid
    wild = corrected(Off(simulator, 1e4), simulator).evaluate(beam.centre)
    assert not wild.valid
    assert np.isfinite(wild.displacement).all()


class Fitted(Off):
    """Known inside the box only: NaN, and so are its slopes, where mu is below it."""

    def __call__(self, theta):
        low = jnp.asarray([parameter.low for parameter in self.scene.parameters])
        return super().__call__(theta) * (1.0 + 1e-3 * jnp.sum(jnp.sqrt(theta - low)))

    def evaluate(self, theta):
        return inside_only(self, theta)


def test_outside_the_box_value_and_slopes_are_finite(beam, simulator):
    polished = corrected(Fitted(simulator, 0.1), simulator)
    outside = [[-20.0, 70.0], [1e-300, 70.0], [jnp.nan, 70.0], [1e308, 70.0]]
    at = jnp.asarray([*outside, beam.centre])
    weights = jnp.asarray(np.random.default_rng(0).normal(size=beam.held.shape))
    f = lambda t: jnp.vdot(weights, polished.evaluate(t).displacement)
    found, slopes = jax.jit(jax.vmap(lambda t: (polished.evaluate(t), jax.grad(f)(t))))(at)
    assert found.valid.tolist() == [False] * 4 + [True]
    assert np.isfinite(found.displacement).all()
    assert np.isfinite(slopes).all()
    np.testing.assert_allclose(slopes[-1], jax.grad(f)(at[-1]), rtol=1e-6)
    for theta in at[:-1]:
        assert np.isfinite(jax.grad(f)(theta)).all()
        _, along = jax.jvp(polished, (theta,), (jnp.ones(2),))
        assert np.isfinite(along).all()


def test_a_start_that_inverts_elements_leaves_slopes_finite(beam, simulator):
    wild = corrected(Off(simulator, 1e4), simulator)
    assert not wild.evaluate(beam.centre).valid
    assert np.isfinite(jax.grad(lambda t: wild(t).sum())(beam.centre)).all()


def test_label_and_fingerprint(beam, cube, simulator):
    base = Off(simulator, 0.1)
    once = corrected(base, simulator)
    assert once.label == "off + 1 Newton step"
    assert corrected(base, simulator, 2).label == "off + 2 Newton steps"
    assert once.fingerprint == corrected(Off(simulator, 0.1), em.Simulator(beam)).fingerprint
    others = [
        corrected(base, simulator, 2),
        corrected(Off(simulator, 0.2), simulator),
        corrected(base, em.Simulator(cube)),
        once.at(np.array([3])),
    ]
    assert len({once.fingerprint, *(other.fingerprint for other in others)}) == 5


def test_bad_corrections(beam, simulator):
    with pytest.raises(InputError, match="0 Newton steps"):
        corrected(Off(simulator, 0.1), simulator, 0)
    runs = run_campaign(simulator, sobol(beam, 4, 0))
    with pytest.raises(InputError, match="over all nodes"):
        corrected(fit_reduced(beam, runs).at(np.array([1])), simulator)
    assert fem_forward(simulator).evaluate(beam.centre).valid
