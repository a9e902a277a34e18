"""Importance sampling against closed forms and quadrature, and when it is chosen by default."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.scipy.stats import norm

import calibrate as cal
from calibrate.importance.proposals import Kernels, effective_number, resampled, separate
from calibrate.importance.weights import normalised
from calibrate.posterior.diagnosis import diagnose
from calibrate.samplers import Density, ImportanceOptions, density_of, find_sampler
from calibrate.samplers.auto import AUTO, NOT_BY_IMPORTANCE, SAMPLED_BY, TARGET_ACCEPT, AutoOptions
from calibrate.samplers.chains import ChainSampler
from calibrate.samplers.importance import IMPORTANCE, ImportanceSampling, _Run
from calibrate.samplers.nuts import NUTSOptions
from calibrate.samplers.protocol import Context, Draws
from emulator.core.checkpoint import Checkpoint
from emulator.core.errors import InputError, SolverError
from emulator.surrogates.fem import fem_forward
from linear_support import bent_problem, linear_problem, share_and_evidence

SD = 4.0  # of the prior of ``density``


def density(log_likelihood, size, **more):
    """A normal prior of sd 4 in each coordinate, and a likelihood."""
    prior = lambda z: norm.logpdf(z, 0.0, SD).sum()
    likelihood = lambda z, data: log_likelihood(z)
    return Density(
        lambda z, data: prior(z) + log_likelihood(z), size, size > 1, 2, prior, likelihood,
        lambda key: SD * jax.random.normal(key, (size,)),
        lambda z: {f"z{i}": z[:, i] for i in range(size)},
        lambda draw: jnp.stack(list(draw.values())),
        tuple(f"z{i}" for i in range(size)), **more,
    )  # fmt: skip


def sampled(of, seed=0, **options):
    return IMPORTANCE.sample(of, {}, ImportanceOptions(**options), Context(seed))


def test_two_modes_that_nuts_gets_wrong_have_their_shares(two_modes):
    model, data = two_modes
    share, log_evidence = share_and_evidence()
    posterior = cal.sample(model, data, seed=1, predictions=False)
    attributes = posterior.tree.attrs
    assert attributes[SAMPLED_BY] == "importance"
    upper = (posterior.tree["posterior"]["mu"].values > 75).mean(axis=1)
    np.testing.assert_allclose(upper, share, atol=6 * np.sqrt(share * (1 - share) / 1000))
    assert posterior.summary()["mu"]["r_hat"] < 1.01
    assert attributes["log_evidence"] == pytest.approx(log_evidence, abs=0.05)
    assert 0.0 < attributes["log_evidence_error"] < 0.05
    assert posterior.warnings() == []


@pytest.mark.parametrize("sd", [4e-3, 4e-6])
def test_a_posterior_of_six_unknowns_far_narrower_than_the_prior(sd):
    """Correlated, sds of the prior 4: 1e-18 of its volume; 1e-36, where tempering stands still."""
    root = np.linalg.cholesky(sd**2 * (0.5 * np.eye(6) + 0.5))
    whiten, log_det = jnp.asarray(np.linalg.inv(root)), np.log(np.diag(root)).sum()
    centre = jnp.array([-3.0, 1.0, 0.0, 2.0, -1.0, 4.0])
    at_centre = norm.logpdf(centre, 0.0, SD).sum()

    def log_likelihood(z):
        return norm.logpdf((z - centre) @ whiten.T).sum() - log_det - at_centre

    draws = sampled(density(log_likelihood, 6))
    white = (draws.z.reshape(-1, 6) - np.asarray(centre)) @ np.linalg.inv(root).T
    np.testing.assert_allclose(white.mean(axis=0), 0.0, atol=0.1)
    np.testing.assert_allclose(np.cov(white, rowvar=False), np.eye(6), atol=0.12)
    assert draws.attributes["log_evidence"] == pytest.approx(0.0, abs=0.05)


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.slow
def test_narrow_modes_far_apart_in_five_dimensions(seed):
    """Shares 0.3 and 0.7, sds a hundredth of the prior's, in correlated coordinates."""
    root = np.linalg.cholesky(0.04**2 * (0.5 * np.eye(5) + 0.5))
    whiten = jnp.asarray(np.linalg.inv(root))
    centres = jnp.array([[-3.0, 1.0, 0.0, 2.0, -1.0], [2.0, -2.0, 1.0, 0.0, 3.0]])
    # The prior weights the modes, too.
    weights = jnp.log(jnp.array([0.3, 0.7])) - norm.logpdf(centres, 0.0, SD).sum(axis=1)
    log_det = np.log(np.diag(root)).sum()

    def log_likelihood(z):
        each = norm.logpdf((z - centres) @ whiten.T).sum(axis=1) - log_det
        return jax.nn.logsumexp(each + weights)

    draws = sampled(density(log_likelihood, 5), seed)
    first = draws.z[..., 0] < 0.0
    np.testing.assert_allclose(first.mean(axis=1), 0.3, atol=5 * np.sqrt(0.21 / 1000))
    # Of a normal prior the evidence of narrow Gaussians is about their prior's mean density.
    assert draws.attributes["log_evidence"] == pytest.approx(0.0, abs=0.05)
    white = (draws.z[first] - np.asarray(centres[0])) @ np.asarray(whiten).T
    np.testing.assert_allclose(white.std(axis=0), 1.0, atol=0.12)
    assert draws.attributes["weights_pareto_k"] < 0.7
    assert draws.attributes["effective_points"] >= 2.0 * draws.z[..., 0].size


def test_light_and_narrow_modes_keep_their_shares():
    """Five modes in three unknowns, shares 0.5 to 0.04, sds a two-hundredth of the prior's."""
    shares = np.array([0.5, 0.26, 0.12, 0.08, 0.04])
    centres = jnp.asarray(np.random.default_rng(4).normal(0.0, 3.0, size=(5, 3)))
    weights = jnp.log(jnp.asarray(shares)) - norm.logpdf(centres, 0.0, SD).sum(axis=1)

    def log_likelihood(z):
        return jax.nn.logsumexp(norm.logpdf(z, centres, 0.02).sum(axis=1) + weights)

    draws = sampled(density(log_likelihood, 3))
    nearest = np.argmin(((draws.z[..., None, :] - np.asarray(centres)) ** 2).sum(axis=-1), axis=-1)
    found = np.bincount(nearest.ravel(), minlength=5) / nearest.size
    np.testing.assert_allclose(found, shares, atol=5.0 * np.sqrt(0.25 / 2600))
    assert found[-1] == pytest.approx(0.04, abs=0.02)
    attributes = draws.attributes
    assert (attributes["modes"], attributes["modes_seen_once"]) == (5, 0)
    assert attributes["missed_mode_nats"] == np.inf
    error = attributes["log_evidence_error"]
    assert 0.0 < error < 0.05
    assert abs(attributes["log_evidence"]) < 4.0 * error


def test_modes_that_one_population_saw_are_told():
    draws = {"z": np.random.default_rng(0).normal(size=(4, 500))}
    row = {"z": {"r_hat": 1.0, "ess_bulk": 2000.0, "ess_tail": 2000.0}}
    assert list(diagnose(draws, {}, row, {"modes": 3, "modes_seen_once": 0})) == []
    (sentence,) = diagnose(draws, {}, row, {"modes": 3, "modes_seen_once": 1})
    assert sentence.startswith("1 of 3 modes were seen by one population only")


def test_draws_of_points_that_are_worth_twice_as_many_are_worth_two_thirds():
    """The spread of means over sets of weighted points: sigma^2 (1 / n + 1 / m) at most."""
    rng, count = np.random.default_rng(3), 100
    means, worth = [], []
    for _ in range(4000):
        z, log_weights = rng.normal(size=(2, 540))
        worth.append(effective_number(log_weights))
        means.append(z[resampled(normalised(log_weights), count, rng)].mean())
    n = np.mean(worth)
    assert n == pytest.approx(2.0 * count, rel=0.05)
    # Less than the bound: the choice is systematic, and takes no light point twice.
    assert 1.0 < count * np.var(means) < 1.0 + count / n


def test_a_sheet_that_is_bent_and_cut_by_the_box(beam):
    """mu known to a thousandth along a curve across the whole box of lam, by quadrature."""

    model, data = bent_problem(beam)
    posterior = cal.sample(model, data, predictions=False)
    assert posterior.tree.attrs[SAMPLED_BY] == "importance"
    mu, lam = np.meshgrid(np.linspace(67.0, 73.0, 12_001), np.linspace(50.0, 100.0, 401))
    value = mu * (3 * lam + 2 * mu) / (lam + mu) / 200.0
    weights = np.exp(-0.5 * 9 * ((value - data[0, 0]) / 1e-3) ** 2) / (mu * lam)
    weights /= weights.sum()
    for name, grid in (("mu", mu), ("lam", lam)):
        mean = (weights * grid).sum()
        sd = np.sqrt((weights * (grid - mean) ** 2).sum())
        draws = posterior.draws()[name]
        assert abs(draws.mean() - mean) < 4 * sd / np.sqrt(4000)
        assert draws.std() == pytest.approx(sd, rel=0.05)


@pytest.mark.parametrize("size", [1, pytest.param(8, marks=pytest.mark.slow)])
def test_a_gaussian_of_as_few_and_as_many_unknowns_as_it_is_taken_for(size):
    mean, sd = np.linspace(-2.0, 2.0, size), 0.3
    draws = sampled(density(lambda z: norm.logpdf(z, jnp.asarray(mean), sd).sum(), size))
    precision = sd**-2 + SD**-2
    z = draws.z.reshape(-1, size)
    np.testing.assert_allclose(z.mean(axis=0), mean / sd**2 / precision, atol=0.025)
    np.testing.assert_allclose(z.std(axis=0), precision**-0.5, rtol=0.06)


def test_the_same_seed_gives_the_same_draws_whatever_the_threads(beam):
    model, data = linear_problem(beam)
    model, checked = model.given(data)
    of = density_of(model)
    options = ImportanceOptions(draws=100)
    one, two = (
        IMPORTANCE.sample(replace(of, at_once=count), checked, options, Context(3)).z
        for count in (1, 4)
    )
    np.testing.assert_array_equal(one, two)
    other = IMPORTANCE.sample(of, checked, options, Context(4)).z
    assert not np.array_equal(one, other)


def test_nuts_is_taken_where_importance_sampling_does_not_work(
    beam, simulator, monkeypatch, capsys
):
    """Where its evaluations do not suffice, its weights are heavy, or the map is not fast."""
    model, data = linear_problem(beam)
    short = AutoOptions(200, 200, rounds=1)

    def attributes_of(model):
        return cal.sample(model, data, options=short, predictions=False).tree.attrs

    assert attributes_of(model)[SAMPLED_BY] == "importance"
    asked = []
    monkeypatch.setattr("calibrate.samplers.auto.IMPORTANCE", Refusing(asked))
    attributes = attributes_of(model)
    assert attributes[SAMPLED_BY] == "nuts"
    assert attributes[NOT_BY_IMPORTANCE] == "importance: refused"
    assert len(asked) == 1
    assert not density_of.__wrapped__(replace(model, forward=fem_forward(simulator))).batches
    of = replace(density_of(model.given(data)[0]), batches=False)
    draws = AUTO.sample(of, model.given(data)[1], short, Context(progress=True))
    assert draws.attributes[NOT_BY_IMPORTANCE] == "the forward map solves FEM"
    assert "sampled by nuts: the forward map solves FEM" in capsys.readouterr().err
    assert len(asked) == 1


@pytest.mark.parametrize(
    ("shares", "batches", "runs", "target"),
    [
        ((0.001, 0.0), True, [0.85], None),  # few diverge
        ((0.01, 0.0), True, [0.85, 0.97], 0.97),
        ((0.01, 0.02), True, [0.85, 0.97], None),  # smaller steps do not help
        ((0.01, 0.0), False, [0.85], None),  # each step solves FEM
    ],
)
def test_nuts_that_diverges_runs_again_in_smaller_steps(
    beam, monkeypatch, shares, batches, runs, target
):
    model, data = linear_problem(beam)
    model, checked = model.given(data)
    asked = []

    class Diverging(ChainSampler):
        def sample(self, density, data, options, context):
            share = shares[len(asked)]
            asked.append(options.target_accept)
            assert context.checkpoint.path is None or len(asked) == 1
            diverging = np.arange(4000).reshape(4, 1000) < 4000 * share
            return Draws(np.zeros((4, 1000, 2)), {"diverging": diverging})

    monkeypatch.setattr("calibrate.samplers.auto.IMPORTANCE", Refusing([]))
    monkeypatch.setattr("calibrate.samplers.auto.NUTS", Diverging("nuts", NUTSOptions, None))
    of = replace(density_of(model), batches=batches)
    context = Context(checkpoint=Checkpoint("draws.safetensors", {}))
    draws = AUTO.sample(of, checked, AutoOptions(), context)
    assert asked == runs
    assert draws.attributes.get(TARGET_ACCEPT) == target
    assert draws.statistics["diverging"].mean() == min(shares[: len(runs)])


def test_few_draws_are_taken_from_populations_that_agree(beam):
    """120 draws can neither reach 400 effective ones nor an R-hat of 1.008, right as they are."""
    model, data = linear_problem(beam)
    model, checked = model.given(data)
    few = AUTO.sample(density_of(model), checked, AutoOptions(draws=60, chains=2), Context())
    assert few.attributes[SAMPLED_BY] == "importance"
    assert few.z.shape == (2, 60, 2)
    assert few.statistics["lp"].shape == (2, 60)


def test_draws_of_further_rounds_are_all_kept(beam, monkeypatch):
    model, data = linear_problem(beam)
    model, checked = model.given(data)
    z = np.random.default_rng(0).normal(size=(2, 3000, 2))
    several = Draws(z, {"lp": z[..., 0]}, {"weights_pareto_k": 0.1})
    monkeypatch.setattr(ImportanceSampling, "sample", lambda *_: several)
    draws = AUTO.sample(density_of(model), checked, AutoOptions(chains=2, rounds=3), Context())
    assert draws.z.shape == z.shape


class Refusing:
    """Importance sampling that gives up."""

    name, options = "importance", ImportanceOptions

    def __init__(self, asked):
        self.asked = asked

    def sample(self, *arguments):
        self.asked.append(arguments)
        raise SolverError("importance: refused")


def test_what_cannot_work_is_named():
    with pytest.raises(SolverError, match="zero at every draw of the prior"):
        sampled(density(lambda z: -jnp.inf, 2))
    needle = density(lambda z: norm.logpdf(z, 1.0, 1e-3).sum(), 4)
    with pytest.raises(SolverError, match="3000 evaluations of a population are not enough"):
        sampled(needle, evaluations=3000)
    with pytest.raises(InputError, match="importance: r_hat is 1.0; it must be above 1"):
        ImportanceOptions(r_hat=1.0)
    draws = {"z": np.random.default_rng(0).normal(size=(4, 500))}
    row = {"z": {"r_hat": 1.0, "ess_bulk": 2000.0, "ess_tail": 2000.0}}
    assert list(diagnose(draws, {}, row, {"weights_pareto_k": 0.5})) == []
    (sentence,) = diagnose(draws, {}, row, {"weights_pareto_k": 0.9})
    assert sentence.startswith("the weights of importance sampling have a heavy tail")


def test_half_of_a_fit_is_where_the_fourth_root_of_the_density_is():
    """Of a Gaussian of variance s the fourth root has variance 4 s, so a fit sees 2.5 s."""
    run = _Run(density(lambda z: norm.logpdf(z, 1.0, 1.0).sum(), 2), {}, ImportanceOptions(), [0])
    run.search()
    points, taken = run.points.continued(60_000, np.random.default_rng(0)), []
    run._go_to = lambda z, weights, *_: taken.append((z, weights))
    run.fit(points.z, points.log_weights, points.log_posterior)
    ((z, weights),) = taken
    variance = 1.0 / (1.0 + SD**-2)
    np.testing.assert_allclose(weights @ z, variance, atol=0.05)
    np.testing.assert_allclose(weights @ (z - variance) ** 2, 2.5 * variance, rtol=0.05)


def _of_two_moduli(x, y):
    """Two curves whose data either of two moduli explains, and both together."""
    first = norm.logpdf(jnp.logaddexp(x + 2.0, y), 2.2, 0.1)
    return first + norm.logpdf(jnp.logaddexp(x + 2.0, 1.5 * y), 2.6, 0.1)


@pytest.mark.parametrize("seed", range(3))
def test_a_thin_tail_is_not_lost(seed):
    """3 % of the mass is a ridge along which one modulus vanishes; sds by quadrature."""
    axis = np.linspace(-20.0, 6.0, 2001)
    x, y = np.meshgrid(axis, axis, indexing="ij")
    weights = normalised(
        np.ravel(_of_two_moduli(x, y) + norm.logpdf(x, 0.0, SD) + norm.logpdf(y, 0.0, SD))
    )
    draws = sampled(density(lambda z: _of_two_moduli(z[0], z[1]) + norm.logpdf(z[2]), 3), seed)
    for k, values in enumerate((x.ravel(), y.ravel())):
        expected = np.sqrt(weights @ (values - weights @ values) ** 2)
        assert draws.z[..., k].std() == pytest.approx(expected, rel=0.08)


def test_points_where_the_map_has_no_answer_are_left_out():
    """A half-space of density zero, through the middle of the posterior."""
    of = density(lambda z: jnp.where(z[0] > 0.0, norm.logpdf(z, 0.0, 0.5).sum(), jnp.nan), 3)
    draws = sampled(of)
    assert (draws.z[..., 0] > 0.0).all()
    sd = (0.5**-2 + SD**-2) ** -0.5
    assert draws.z[..., 0].mean() == pytest.approx(sd * np.sqrt(2 / np.pi), rel=0.05)


def test_a_step_without_any_answer_is_named():
    """A density that is zero but in slits that no kernel can follow."""
    slits = density(lambda z: jnp.where(jnp.mod(1e9 * z[0], 1.0) < 0.002, 0.0, -jnp.inf), 2)
    with pytest.raises(SolverError, match="zero at every point of a step"):
        sampled(slits)


def test_the_sampler_is_that_of_the_options():
    assert find_sampler(None).name == "auto"
    assert find_sampler(None, cal.samplers.NUTSOptions()).name == "nuts"
    assert find_sampler(None, ImportanceOptions()).name == "importance"
    assert find_sampler("smc", cal.samplers.NUTSOptions()).name == "smc"


def test_points_in_separate_places_have_a_covariance_each():
    rng = np.random.default_rng(0)
    shift = np.where(rng.uniform(size=(900, 1)) < 0.3, -5.0, 5.0)
    z = shift + np.array([1.0, 0.1]) * rng.normal(size=(900, 2))
    parts = separate(z)
    assert sorted(len(rows) for rows in parts) == sorted([(shift < 0).sum(), (shift > 0).sum()])
    kernels = Kernels.around(z, (0.5, 1.0), 5.0, rng)
    assert len(kernels.groups) == 2
    axis = np.linspace(-12.0, 12.0, 401)
    grid = np.stack(np.meshgrid(axis, axis, indexing="ij"), -1).reshape(-1, 2)
    mass = np.exp(kernels.log_density(grid)) * 0.06**2
    assert mass.sum() == pytest.approx(1.0, abs=0.01)
    drawn = kernels.sample(rng, 4000)
    assert np.mean(drawn[:, 0] < 0) == pytest.approx(mass[grid[:, 0] < 0].sum(), abs=0.03)


@pytest.mark.parametrize("kind", ["gaussian", "uniform", "logistic"])
def test_points_of_one_place_are_not_parted(kind):
    rng = np.random.default_rng(0)
    draw = {"gaussian": rng.normal, "uniform": rng.uniform, "logistic": rng.logistic}[kind]
    assert len(separate(draw(size=(1000, 5)))) == 1
    if kind in (gain := {"gaussian": -np.log(1.0 - 2.0 / np.pi), "uniform": np.log(4.0)}):
        x = np.sort(draw(size=100_000))
        halves = 0.5 * sum(np.log(half.var()) for half in np.split(x, 2))
        assert np.log(x.var()) - halves == pytest.approx(gain[kind], abs=0.02)
