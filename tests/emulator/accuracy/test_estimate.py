import jax
import jax.numpy as jnp
import numpy as np
import pytest

import emulator as em
from emulator.accuracy.estimate import ErrorBar
from emulator.core.errors import InputError
from emulator.scenes.scene import all_nodes
from emulator.surrogates.corrected import newton_step
from emulator.surrogates.fem import fem_forward
from emulator.surrogates.protocol import Prediction


class Off:
    """The solution at the centre of the box, plus a smooth error of a known size."""

    kind = "off"

    def __init__(self, scene, exact, size=0.0):
        self.scene, self.nodes = scene, all_nodes(scene)
        x = scene.mesh.nodes / scene.mesh.size
        self.exact, self.error = exact, size * np.where(scene.held, 0.0, np.sin(3 * x) * x[:, :1])

    def __call__(self, theta):
        return self.exact + self.error + 0.0 * jnp.sum(theta)

    def evaluate(self, theta):
        return Prediction(self(theta), jnp.array(True))

    def at(self, nodes):
        raise AssertionError("an error bar needs every node")


@pytest.fixture(scope="module")
def exact(beam, simulator):
    return simulator(beam.centre)


@pytest.fixture(scope="module")
def off(beam, exact):
    return lambda size: Off(beam, exact, size)


@pytest.fixture(scope="module")
def bar(simulator, off):
    """One for all sizes, so that it compiles once."""
    return ErrorBar(off(0.0), simulator)


def far(field, error):
    return float(jnp.linalg.norm(field - error) / np.linalg.norm(error))


def test_wrong_by_a_term_proportional_to_the_error(beam, bar, exact, off):
    Pi = em.fem.potential_energy(beam)
    field, energy = [], []
    for size in (0.1, 0.05):
        error = off(size).error
        estimate = bar.of_field(exact + error, beam.centre)
        assert estimate.valid
        assert estimate.iterations == 0
        assert estimate.guard.trusted
        field.append(far(estimate.field, error))
        gap = Pi(exact + error, beam.centre) - Pi(exact, beam.centre)
        energy.append(abs(float(estimate.energy_gap / gap) - 1.0))
        # What the contraction is for.
        assert estimate.contraction == pytest.approx(field[-1], rel=0.3)
        assert estimate.least_energy == pytest.approx(float(Pi(exact, beam.centre)), rel=1e-3)
        np.testing.assert_allclose(estimate.err_u, jnp.linalg.norm(estimate.field, axis=1))
        assert estimate.max == jnp.max(estimate.err_u)
    assert field[0] / field[1] == pytest.approx(2.0, rel=0.1)
    assert energy[0] / energy[1] == pytest.approx(2.0, rel=0.2)
    assert field[1] < 0.1


def test_no_error_no_bar(beam, bar, exact):
    estimate = bar.of_field(exact, beam.centre)
    assert estimate.valid
    assert estimate.max < 1e-8


def test_error_of_a_quantity(beam, bar, exact, off):
    estimate = bar.of_field(exact + off(0.05).error, beam.centre)
    quantity = lambda u: jnp.stack([jnp.sum(u[7] ** 2), u[3, 0] * u[5, 2]])
    ahead, behind = (quantity(estimate.displacement + h * estimate.field) for h in (1e-4, -1e-4))
    np.testing.assert_allclose(estimate.of(quantity), (ahead - behind) / 2e-4, rtol=1e-6)
    true = quantity(exact + off(0.05).error) - quantity(exact)
    np.testing.assert_allclose(estimate.of(quantity), true, rtol=0.2)


@pytest.fixture(scope="module")
def wild(beam, exact):
    """Far too bent, and rough: Newton's step is too short by half, and much too long."""
    rough = np.random.default_rng(0).normal(0.0, 0.3, exact.shape)
    return {"bent": np.asarray(exact), "rough": np.where(beam.held, 0.0, rough)}


@pytest.fixture(scope="module")
def one_step(simulator):
    return jax.jit(lambda u, theta: newton_step(simulator.system, u, theta))


@pytest.mark.parametrize("how", ["bent", "rough"])
def test_where_one_step_is_wild_the_bar_is_not(beam, one_step, bar, exact, wild, how):
    error = wild[how]
    u = exact + error
    once = u - one_step(u, beam.centre)
    assert not 0.5 < float(jnp.linalg.norm(once)) / np.linalg.norm(error) < 2.0
    estimate = bar.of_field(u, beam.centre)
    assert estimate.iterations > 0
    assert estimate.valid
    assert far(estimate.field, error) < 0.1
    Pi = em.fem.potential_energy(beam)
    gap = Pi(u, beam.centre) - Pi(exact, beam.centre)
    assert estimate.energy_gap == pytest.approx(float(gap), rel=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("corner", [(3.0, -2.0), (3.0, 3.0)])
def test_a_short_step_far_from_balance_is_not_believed(corner):
    """Two box lengths outside, a network's strains stiffen the beam: each step is a third of what
    is needed, and the next one with the same tangent shorter still."""
    forward = em.load("once_clamped_beam").cache()
    scene, theta = forward.scene, forward.scene.from_unit(jnp.array(corner))
    simulator = em.Simulator(scene)
    error = forward(theta) - simulator(theta)
    once = newton_step(simulator.system, forward(theta), theta) - forward(theta)
    assert jnp.linalg.norm(once) < 0.5 * jnp.linalg.norm(error)
    bar = ErrorBar(forward, simulator)
    for estimate in (bar(theta), jax.jit(bar)(theta)):
        assert estimate.valid
        assert far(estimate.field, error) < 0.25


@pytest.mark.slow
def test_the_same_inside_jit_and_vmap(beam, bar, exact, off, wild):
    fields = jnp.stack([exact + off(0.05).error, exact + wild["bent"]])
    thetas = jnp.stack([beam.centre, beam.centre])
    many = jax.jit(jax.vmap(bar.of_field))(fields, thetas)
    for k, u in enumerate(fields):
        one = bar.of_field(u, beam.centre)
        np.testing.assert_allclose(many.field[k], one.field, rtol=1e-4, atol=1e-7)
        np.testing.assert_allclose(many.energy_gap[k], one.energy_gap, rtol=1e-5)
        assert bool(many.valid[k]) == bool(one.valid)


def test_a_climbing_step_is_seen(beam, simulator, bar, exact):
    """Squeezed along its axis beyond buckling, a beam's tangent is indefinite."""
    squeezed = jnp.asarray(-0.4 * beam.mesh.nodes * np.array([1.0, 0.0, 0.0]))
    system = simulator.system
    along = lambda v: system.residual(squeezed + system.extend(v), beam.centre)
    K = jax.jit(jax.jacfwd(along))(jnp.zeros(len(system.free)))
    assert np.linalg.eigvalsh(np.asarray(K)).min() < 0.0
    estimate = bar.of_field(squeezed, beam.centre)
    assert estimate.guard.indefinite
    assert "indefinite" in estimate.guard.sentence(beam)
    true = np.asarray(squeezed - exact)
    ratio = float(estimate.max) / np.linalg.norm(true, axis=1).max()
    assert 0.5 < ratio < 2.0


def test_a_prediction_that_inverts_elements(beam, bar, exact):
    u = jnp.where(beam.held, 0.0, exact - 1.5 * beam.mesh.nodes)
    estimate = bar.of_field(u, beam.centre)
    assert "an element is inverted" in estimate.guard.sentence(beam)
    assert not estimate.guard.trusted
    assert far(estimate.field, np.asarray(u - exact)) < 0.2


def test_off_its_supports(beam, bar, exact):
    shift = jnp.full((3,), 0.01)
    estimate = bar.of_field(exact + shift, beam.centre)
    np.testing.assert_allclose(estimate.field[beam.held.all(axis=1)], 0.01)
    assert far(estimate.field, np.broadcast_to(shift, exact.shape)) < 0.05


@pytest.mark.parametrize("what", ["theta", "prediction", "overflow"])
def test_nothing_that_is_not_finite_comes_out(beam, bar, exact, what):
    u = {"theta": exact, "prediction": exact.at[3, 1].set(jnp.nan), "overflow": 1e200 * exact}[what]
    theta = beam.centre.at[1].set(jnp.nan) if what == "theta" else beam.centre
    estimate = bar.of_field(u, theta)
    numbers = estimate._replace(guard=estimate.guard._replace(theta=0.0))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(numbers))
    assert not estimate.valid
    assert not estimate.guard.trusted
    assert "not finite" in estimate.guard.sentence(beam)
    assert estimate.max > 0.0  # not known to be wrong is not known to be right


def test_refusals(beam, simulator, off, cube):
    with pytest.raises(InputError, match="over all nodes"):
        ErrorBar(fem_forward(simulator).at(np.array([3])), simulator)
    with pytest.raises(InputError, match="the simulator of 'twisting_cube'"):
        ErrorBar(off(0.1), em.Simulator(cube))
    with pytest.raises(InputError, match=r"theta has shape \(3,\)"):
        ErrorBar(off(0.1), simulator)(jnp.ones(3))
    with pytest.raises(InputError, match=r"displacement has shape \(4, 3\); expected \(45, 3\)"):
        ErrorBar(off(0.1), simulator).of_field(jnp.ones((4, 3)), jnp.ones(2))
