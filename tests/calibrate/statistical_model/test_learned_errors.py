"""The forward map's own error in the likelihood, against densities written by hand."""

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
import pytest
from numpyro.infer.util import log_density
from scipy.stats import multivariate_normal

import calibrate as cal
import emulator as em
from calibrate.model_error import ModelError, Systematic
from calibrate.model_error.algebra import marginalised
from calibrate.posterior import sample
from calibrate.posterior.diagnosis import map_fault
from calibrate.statistical_model import with_error
from calibrate.statistical_model.errors import fit, map_errors
from emulator.accuracy.estimate import newton_distance
from emulator.core.errors import InputError
from emulator.fem.newton import NewtonOptions
from emulator.surrogates.emulator import CachedEmulator
from emulator.surrogates.protocol import Prediction
from emulator.surrogates.taylor import constant, expand
from linear_support import LinearSimulator, closed_form, linear_forward

NODES = np.array([3, 11, 20, 30])
NOISE = 0.02
TRUTH = jnp.array([72.0, 68.0])
MEAN, SD = np.array([75.0, 75.0]), np.array([8.0, 8.0])


@pytest.fixture(scope="module")
def truth(beam):
    return linear_forward(beam)


@pytest.fixture(scope="module")
def poor(truth):
    """A map that is wrong by some five noise sd, in a way that changes with theta."""
    other = linear_forward(truth.scene, seed=9)
    return replace(truth, matrix=truth.matrix + 0.15 * other.matrix, shift=truth.shift)


def model_of(forward, noise=NOISE):
    prior = {n: dist.Normal(m, s) for n, m, s in zip(("mu", "lam"), MEAN, SD, strict=True)}
    observe = cal.nodal_displacements(forward.scene, NODES)
    return cal.model(forward, observe, cal.GaussianNoise(sd=noise), prior, check_scale=False)


@pytest.fixture(scope="module")
def aware(truth, poor):
    return with_error(model_of(poor), LinearSimulator(truth), 40)


def test_the_density_is_that_of_the_sum_of_noise_and_error(aware, truth):
    """Against SciPy's multivariate normal with the whole covariance."""
    data = aware.check_data(np.asarray(truth.at(NODES)(TRUTH)))
    draw = {"mu": jnp.asarray(70.0), "lam": jnp.asarray(81.0)}
    size = float(aware.error.size(jnp.array([70.0, 81.0])))
    spread = size**2 * aware.error.terms[0].modes.T @ aware.error.terms[0].modes
    covariance = NOISE**2 * np.eye(spread.shape[0]) + spread
    mean = np.asarray(aware.forward(jnp.array([70.0, 81.0]))).ravel()
    wanted = multivariate_normal(mean, covariance).logpdf(np.ravel(data["displacement"]))
    assert float(aware.map_log_likelihood(draw, data)) == pytest.approx(wanted, rel=1e-9)
    found, _ = log_density(aware, (data,), {}, draw)
    prior = sum(float(aware.prior[n].log_prob(v)) for n, v in draw.items())
    assert float(found) == pytest.approx(wanted + prior, rel=1e-9)


def test_what_is_left_of_the_information_is_that_of_the_sum(aware):
    """Against the inverse of the whole covariance, where the error is as large as it is there."""
    at = jnp.array([70.0, 81.0])
    modes, size = aware.error.terms[0].modes, float(aware.error.size(at))
    noise = NOISE**2 * np.eye(modes.shape[1])
    found = aware.error.information_left(jnp.asarray(np.linalg.inv(noise)), at, {})
    wanted = np.linalg.inv(noise + size**2 * modes.T @ modes)
    np.testing.assert_allclose(found, wanted, atol=1e-9 * np.abs(wanted).max())


def test_fem_on_the_mesh_shares_the_error_of_the_mesh_only(aware, truth):
    """Against SciPy's normal; the error of the map alone leaves FEM's likelihood as it is."""
    data = aware.check_data(np.asarray(truth.at(NODES)(TRUTH)))
    draw = {"mu": jnp.asarray(70.0), "lam": jnp.asarray(81.0)}
    means = aware.predict(draw)[0]
    size = float(aware.error.size(jnp.array([70.0, 81.0])))
    of_noise = NOISE**2 * np.eye(aware.error.terms[0].modes.shape[1])
    of_mesh = size**2 * aware.error.terms[0].modes.T @ aware.error.terms[0].modes
    whole = replace(aware, error=ModelError((replace(aware.error.terms[0], of_mesh=True),)))
    mean, y = (np.ravel(d["displacement"]) for d in (means, data))
    for model, covariance in ((aware, of_noise), (whole, of_noise + of_mesh)):
        found = float(model.fem_log_likelihood(draw, means, data))
        assert found == pytest.approx(multivariate_normal(mean, covariance).logpdf(y), rel=1e-9)
    keys = jax.random.split(jax.random.key(0), 4000)
    moved = jax.vmap(lambda key: whole.fem_means(key, draw, means)["displacement"])(keys)
    spread = np.cov(np.asarray(moved).reshape(len(keys), -1).T)
    np.testing.assert_allclose(spread, of_mesh, atol=0.1 * np.abs(of_mesh).max())
    again = ModelError.restore(whole.error.arrays(), {})
    assert again.of_mesh
    assert again.fingerprint == whole.error.fingerprint != aware.error.fingerprint


def test_the_covariance_is_that_of_the_errors():
    """Errors of one size everywhere: their second moment."""
    rng = np.random.default_rng(0)
    root = rng.normal(size=(4, 4))
    errors = rng.normal(size=(600, 2)) @ root[:2]
    noise = np.diag([0.1, 0.2, 0.3, 0.4]) ** 2
    found = fit(rng.random((600, 2)), errors, np.linalg.inv(noise))
    assert found.modes.shape == (2, 4)
    size = np.array([float(found.size(jnp.array(x))) for x in rng.random((20, 2))])
    middle = np.median(size) ** 2 * found.modes.T @ found.modes
    np.testing.assert_allclose(middle, root[:2].T @ root[:2], atol=0.6 * np.abs(middle).max())
    # Integrated out they are the same, and G is diagonal: V^T W V.
    (term,) = marginalised([found], np.linalg.inv(noise)).terms
    G = term.modes @ np.linalg.inv(noise) @ term.modes.T
    np.testing.assert_allclose(G, np.diag(term.strength), atol=1e-9 * G.max())
    np.testing.assert_allclose(term.modes.T @ term.modes, found.modes.T @ found.modes, atol=1e-9)


def test_its_size_follows_the_unknowns():
    """Errors ten times larger at one end than at the other."""
    rng = np.random.default_rng(1)
    x = rng.random((60, 1))
    errors = 10.0**x * rng.normal(size=(60, 5))
    found = fit(x, errors, np.eye(5))
    low, high = (float(found.size(jnp.array([v]))) for v in (0.05, 0.95))
    assert 4.0 < high / low < 15.0
    # Far outside the runs it stays between the sizes they have.
    assert float(found.size(jnp.array([50.0]))) <= np.exp(found.size.log_sizes.max()) * (1 + 1e-12)


def test_it_is_beside_systematic_errors(truth, poor):
    """Against SciPy's normal: of the map with both errors, of FEM with those of the measurement."""
    rng = np.random.default_rng(4)
    V = 0.1 * rng.normal(size=(2, 12))
    camera = Systematic(("a", "b"), {"displacement": V.reshape(2, 4, 3)})
    told = cal.with_systematic(model_of(poor), camera)
    whole = with_error(told, LinearSimulator(truth), 40)
    learned = whole.error.terms[-1]
    data = whole.check_data(np.asarray(truth.at(NODES)(TRUTH)))
    draw, x = {"mu": jnp.asarray(70.0), "lam": jnp.asarray(81.0)}, jnp.array([70.0, 81.0])
    means = whole.predict(draw)[0]
    mean, y = (np.ravel(d["displacement"]) for d in (means, data))
    of_fem = NOISE**2 * np.eye(12) + V.T @ V
    of_map = of_fem + float(learned.size(x)) ** 2 * learned.modes.T @ learned.modes
    wanted = [multivariate_normal(mean, covariance).logpdf(y) for covariance in (of_map, of_fem)]
    assert float(whole.map_log_likelihood(draw, data)) == pytest.approx(wanted[0], rel=1e-9)
    assert float(whole.fem_log_likelihood(draw, means, data)) == pytest.approx(wanted[1], rel=1e-9)
    # In whichever order they are added; and what is kept is the same.
    after = cal.with_systematic(with_error(model_of(poor), LinearSimulator(truth), 40), camera)
    assert float(after.map_log_likelihood(draw, data)) == pytest.approx(wanted[0], rel=1e-9)
    back = ModelError.restore(whole.error.arrays(), whole.error.words)
    assert back.fingerprint == whole.error.fingerprint
    residual = {"displacement": data["displacement"] - means["displacement"]}
    np.testing.assert_array_equal(
        back.log_ratio(x, residual, means), whole.error.log_ratio(x, residual, means)
    )
    assert not back.of_mesh
    assert len(back.of_fem.terms) == 1
    gain = Systematic(("gain",), {}, shares={"displacement": np.full((1, 4, 3), 0.1)})
    with_gain = with_error(cal.with_systematic(told, gain), LinearSimulator(truth), 40)
    of_gain = 0.01 * np.outer(mean, mean)
    for model in (with_gain, with_error(with_gain, LinearSimulator(truth), 40)):
        found = float(model.map_log_likelihood(draw, data))
        wanted_too = multivariate_normal(mean, of_map + of_gain).logpdf(y)
        assert found == pytest.approx(wanted_too, rel=1e-9)
        by_fem = float(model.fem_log_likelihood(draw, means, data))
        wanted_too = multivariate_normal(mean, of_fem + of_gain).logpdf(y)
        assert by_fem == pytest.approx(wanted_too, rel=1e-9)
    # A second error of the map takes the place of the first; one of unknown size has no place.
    again = with_error(whole, LinearSimulator(truth), 40)
    assert float(again.map_log_likelihood(draw, data)) == pytest.approx(wanted[0], rel=1e-9)
    sized = cal.with_systematic(
        told, Systematic(("c",), {"displacement": np.ones((1, 4, 3))}, ("c", 0.1))
    )
    with pytest.raises(InputError, match="only one size can be unknown, by one name and scale"):
        with_error(sized, LinearSimulator(truth), 40)


def test_a_poor_map_widens_the_posterior_instead_of_moving_it(truth, poor, aware):
    """Shift from the true map's posterior in sd of its own: 20 data sets, many sd against one."""
    rng = np.random.default_rng(2)
    A, B = truth.matrix[NODES].reshape(-1, 2), poor.matrix[NODES].reshape(-1, 2)
    shifts = {"blind": [], "aware": []}
    for theta in rng.normal(MEAN, SD, (20, 2)):
        y = A @ theta + NOISE * rng.normal(size=len(A))
        right, _ = closed_form(truth, NODES, y.reshape(-1, 3), NOISE, MEAN, SD)
        # The posterior of the aware model is Gaussian but for the size: taken at the truth.
        size = float(aware.error.size(jnp.asarray(theta)))
        error = size**2 * aware.error.terms[0].modes.T @ aware.error.terms[0].modes
        for name, spread in (("blind", 0.0 * error), ("aware", error)):
            precision = np.linalg.inv(NOISE**2 * np.eye(len(A)) + spread)
            C = np.linalg.inv(B.T @ precision @ B + np.diag(SD**-2.0))
            mean = C @ (B.T @ precision @ y + MEAN / SD**2)
            shifts[name].append((mean - right) / np.sqrt(np.diagonal(C)))
    rms = {name: float(np.sqrt(np.mean(np.square(v)))) for name, v in shifts.items()}
    assert rms["blind"] > 5.0
    assert 0.3 < rms["aware"] < 1.5


@pytest.mark.slow
def test_nuts_and_replicated_data_know_of_it(truth, aware):
    data = np.asarray(truth.at(NODES)(TRUTH))
    options = cal.samplers.NUTSOptions(warmup=200, draws=300, chains=2, rounds=1)
    posterior = sample(aware, data, options=options)
    table = posterior.summary()
    for name, value in zip(("mu", "lam"), TRUTH, strict=True):
        assert abs(table[name]["mean"] - float(value)) < 3.0 * table[name]["sd"]
    # The replicates spread as the error and the noise together, far more than the noise.
    replicated = np.asarray(posterior.tree["posterior_predictive"]["displacement"])
    assert replicated.std(axis=(0, 1)).mean() > 3.0 * NOISE


def test_an_exact_map_changes_nothing(truth):
    model = with_error(model_of(truth), LinearSimulator(truth), 10)
    data = model.check_data(np.asarray(truth.at(NODES)(TRUTH)))
    draw = {"mu": jnp.asarray(70.0), "lam": jnp.asarray(81.0)}
    plain = replace(model, error=ModelError()).map_log_likelihood(draw, data)
    assert float(model.map_log_likelihood(draw, data)) == pytest.approx(float(plain), rel=1e-9)


def test_it_is_kept_and_restored(aware):
    back = ModelError.restore(aware.error.arrays(), aware.error.words)
    x = jnp.array([71.0, 66.0])
    assert float(back.size(x)) == float(aware.error.size(x))
    key = jax.random.key(0)
    means = {"displacement": jnp.zeros((4, 3))}
    np.testing.assert_array_equal(
        back.draw(key, x, means)["displacement"], aware.error.draw(key, x, means)["displacement"]
    )


def test_what_is_refused(truth, poor, cube):
    model = model_of(poor)
    with pytest.raises(InputError, match="5 FEM runs; give 8 or more"):
        with_error(model, LinearSimulator(truth), 5)
    with pytest.raises(InputError, match="the simulator is for another scene"):
        with_error(model, LinearSimulator(linear_forward(cube)), 10)
    observe = cal.nodal_displacements(poor.scene, NODES)
    unknown = cal.model(poor, observe, cal.GaussianNoise(sd_scale=0.1))
    with pytest.raises(InputError, match="the noise of displacement must be of known sd; noise_sd"):
        with_error(unknown, LinearSimulator(truth), 10)
    nowhere = cal.model(
        replace(poor, limit=10.0), observe, cal.GaussianNoise(sd=0.1), check_scale=False
    )
    with pytest.raises(InputError, match="answered at 0 of 10 draws of the prior; 8 are needed"):
        with_error(nowhere, LinearSimulator(truth), 10)


def test_a_newton_step_tells_what_the_map_misses(beam, simulator, aware):
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
    assert not map_errors(replace(model, error=aware.error), simulator, draws, data).sizes
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
