"""The study of sheep myocardium: its laws in one program, and moves between modes."""

from types import SimpleNamespace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
import pytest
from numpyro import handlers
from studies.sheep_myocardium import chains, inference, moves, population, twins
from studies.sheep_myocardium.experiment import Curve, Heart

pytestmark = pytest.mark.slow


class SeenLogs(NamedTuple):
    """A heart of which logarithms of its parameters are seen."""

    data: jax.Array
    used: jax.Array


def test_a_law_leaves_out_moduli_and_their_exponents():
    assert inference.parameters("fibres") == ("a", "b", "a_f", "b_f")
    assert len(inference.parameters(inference.ORTHOTROPIC)) == 8


@pytest.mark.parametrize("angles", [True, False])
def test_what_a_law_leaves_out_is_drawn_and_not_looked_at(monkeypatch, angles):
    heart = SimpleNamespace(curves={m: SimpleNamespace(force=np.ones(4)) for m in inference.MODES})
    monkeypatch.setattr(inference, "means", lambda of, x, turned: jnp.ones((9, 4)) * x.sum())
    monkeypatch.setattr(inference, "log_likelihoods", lambda of, mean, omega: mean.sum(axis=1))
    of = inference.seen(heart, None, "fibres", angles=angles)
    sites = handlers.trace(handlers.seed(inference.program, 0)).get_trace(of)
    x = dict(zip(inference.MATERIAL, np.asarray(sites["x"]["value"]), strict=True))
    acts = {name for name, value in x.items() if value != -1.0}
    assert acts == set(inference.parameters("fibres"))
    assert bool(np.any(sites["turned"]["value"] != 0.0)) is angles
    assert {"a_s", "x_b_s", "angles"} <= set(sites)


def test_a_likelihood_is_taken_to_a_power():
    heart = SimpleNamespace(curves={m: SimpleNamespace(force=np.ones(4)) for m in inference.MODES})
    of = inference.seen(heart, None, power=0.5, left_out=("SS",))
    own = np.where(np.array(inference.MODES) == "SS", 0.0, 0.5)
    np.testing.assert_array_equal(of.used, own)


def test_a_twin_is_seen_beside_its_heart(monkeypatch):
    """One prior and two experiments: their log densities add."""
    rng = np.random.default_rng(4)
    heart, twin = (
        SimpleNamespace(
            curves={m: SimpleNamespace(force=rng.normal(size=4)) for m in inference.MODES}
        )
        for _ in range(2)
    )
    cubes = SimpleNamespace(amounts=jnp.tile(jnp.linspace(-0.3, 0.3, 4), (3, 3, 1)))
    monkeypatch.setattr(inference, "means", lambda *_: jnp.ones((9, 4)))

    def told(seen):
        program = handlers.seed(inference.program, 0)
        sites = handlers.trace(program).get_trace(seen)
        return sum(sites[n]["fn"].log_factor for n in ("data", "twin") if n in sites)

    both = told(inference.seen(heart, cubes, twin=twin))
    alone = [told(inference.seen(each, cubes)) for each in (heart, twin)]
    assert float(both) == pytest.approx(float(sum(alone)))


def test_twins_of_two_hearts_have_errors_of_their_own(monkeypatch):
    """And those of one are made again as they were; a test that FEM failed at makes none."""
    made = []

    def posterior(heart, *_, twin, **__):
        made.append(np.stack([twin.curves[mode].force for mode in inference.MODES]))
        return SimpleNamespace(theta=lambda _: np.arange(4.0), draws={"omega": np.arange(4.0)})

    monkeypatch.setattr(twins, "sample", posterior)
    amounts = np.linspace(-0.3, 0.3, 4)
    curve = Curve("FS", amounts, np.ones(4), np.ones(4))
    explored = SimpleNamespace(
        modes=None, draws={"omega": np.array([0.1, 0.5, 2.5])},
        theta=lambda _: np.array([0.0, 0.5, 1.5]),
    )  # fmt: skip
    by_fem = np.ones((2, 9, 4))
    by_fem[0, 3, 1] = np.nan
    for name in ("TSL1", "TSL2", "TSL1"):
        heart = Heart(name, np.ones((3, 3)), dict.fromkeys(inference.MODES, curve))
        found = SimpleNamespace(
            heart=heart, by_fem=by_fem, tested=np.array([0, 2]), explored=explored,
            cubes=SimpleNamespace(finer=np.full((3, 12), 0.9)),
        )  # fmt: skip
        (told,) = twins.ranks(found, 0, 10)
        assert told["a"] == 0.5
        assert told["omega"] == 0.75
    np.testing.assert_array_equal(made[0], made[2])
    assert abs(np.corrcoef(made[0].ravel(), made[1].ravel())[0, 1]) < 0.5
    assert np.median(np.concatenate(made)) == pytest.approx(0.9, abs=0.5)


@pytest.mark.slow  # a minute
def test_a_population_is_found_from_hearts_that_tell_their_parameters(monkeypatch):
    """Each heart's logarithms are seen with a known error: means and spread have closed forms."""
    rng = np.random.default_rng(6)
    count, error = 6, 0.3
    truth = population._CENTRE + 0.4 + 0.3 * rng.normal(size=(count, len(population.NAMES)))
    data = truth + error * rng.normal(size=truth.shape)
    hearts = [SimpleNamespace(heart=jnp.asarray(row), cubes=None) for row in data]
    monkeypatch.setattr(population, "seen", lambda row, _: SeenLogs(row, jnp.ones(9)))
    monkeypatch.setattr(population, "positions", lambda logs: logs)
    monkeypatch.setattr(population, "means", lambda of, logs, angles: logs)

    def told(of, logs, omega):
        logs = jnp.append(logs, jnp.log(omega))
        return -0.5 * ((logs - of.data) / error) ** 2

    monkeypatch.setattr(population, "log_likelihoods", told)
    found = population.sampled(hearts, 0, draws=300, warmup=200)
    assert found.worst_rhat < 1.05
    assert found.divergences < 8
    mean = found.draws["mean"].mean(axis=0)
    sd = found.draws["mean"].std(axis=0)
    # Given its spread s, a mean is that of the data, pulled to the prior's centre.
    s2 = (found.draws["spread"] ** 2 + error**2) / count
    expected = (data.mean(axis=0) + s2.mean(axis=0) * population._CENTRE) / (1 + s2.mean(axis=0))
    np.testing.assert_allclose(mean, expected, atol=0.06)
    assert (np.abs(mean - data.mean(axis=0)) < sd).all()
    spread = found.draws["spread"].mean(axis=0)
    assert ((spread > 0.5 * data.std(axis=0)) & (spread < 2.0 * data.std(axis=0))).all()


def test_a_transport_between_modes_is_undone_and_keeps_its_balance():
    rng = np.random.default_rng(3)
    z = rng.normal(size=(4, 200, 3)) * np.array([1.0, 0.3, 2.0]) + 4.0 * np.arange(4)[:, None, None]
    found = moves.modes(z, rng.normal(size=(4, 200)))
    at, i, j = jnp.asarray(z[1, 0]), jnp.asarray(1), jnp.asarray(3)
    there, more = moves.transported(found, at, i, j)
    back, less = moves.transported(found, there, j, i)
    np.testing.assert_allclose(back, at, atol=1e-10)
    assert float(more) == pytest.approx(-float(less))
    jacobian = jax.jacfwd(lambda z: moves.transported(found, z, i, j)[0])(at)
    shares = [moves._log_shares(found, z) for z in (at, there)]
    given = shares[1][3] + found.log_weight[1] - shares[0][1] - found.log_weight[3]
    expected = float(given) + np.log(np.linalg.det(np.asarray(jacobian)))
    assert float(more) == pytest.approx(expected)


def some_modes(at):
    return moves.modes(np.random.default_rng(5).normal(at, 1.0, (4, 50, 2)), np.zeros((4, 50)))


def test_modes_of_the_last_two_searches_are_kept():
    searches = [some_modes(at) for at in (0.0, 10.0, 20.0)]
    once = moves.joined(None, searches[0])
    assert len(once.mean) == moves.MODES
    np.testing.assert_array_equal(once.mean[:4], once.mean[4:])
    every = moves.joined(moves.joined(once, searches[1]), searches[2])
    np.testing.assert_array_equal(every.mean[:4], searches[1].mean)
    np.testing.assert_array_equal(every.mean[4:], searches[2].mean)
    assert float(jnp.exp(every.log_weight).sum()) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("known", "rhats", "asked"),
    [
        (False, [1.0], [(False, 1)]),
        (False, [1.5, 1.0], [(False, 1), (True, 4)]),
        (True, [1.0], [(True, 4)]),
        # Others are sought, and what was known is not forgotten.
        (True, [1.5, 1.0, 1.0], [(True, 4), (False, 1), (True, 4)]),
    ],
)
def test_chains_that_disagree_are_drawn_between_more_modes(monkeypatch, known, rhats, asked):
    told, seen = iter(rhats), []

    def sample(*_, known=None, times=1):
        seen.append((known is not None, times))
        kept = moves.joined(None, some_modes(7.0)) if known is None else known
        return SimpleNamespace(worst_rhat=next(told), modes=kept)

    monkeypatch.setattr(inference, "sample", sample)
    given = moves.joined(None, some_modes(0.0)) if known else None
    found = inference.settled(None, None, 0, known=given, times=4)
    assert seen == asked
    if known:
        np.testing.assert_array_equal(found.modes.mean[:4], given.mean[:4])


@pytest.mark.parametrize("known", [True, False])
def test_moves_join_modes_that_nuts_does_not(known):
    """Two Gaussians of one and three quarters of the mass, 20 sd apart."""

    apart = dist.MixtureSameFamily(
        dist.Categorical(jnp.array([0.25, 0.75])),
        dist.Normal(jnp.array([-10.0, 10.0]), jnp.array([1.0, 0.5])),
    )
    z = np.stack([np.linspace(-11.5, -8.5, 100), np.linspace(9.3, 10.7, 100)])[:, :, None]
    given = moves.modes(np.concatenate([z, z]), np.zeros((4, 100))) if known else moves.unknown(1)
    found = chains.chain(
        lambda z: -apart.log_prob(z[0]), given, np.array([False]), jax.random.key(0),
        warmup=100, draws=600, room=600,
    )  # fmt: skip
    right = float((found.z > 0.0).mean())
    assert (0.65 < right < 0.85) if known else right in (0.0, 1.0)
    np.testing.assert_allclose(found.log_density, apart.log_prob(found.z[:, 0]))


def test_mirrored_entries_change_sign_where_that_is_as_likely():
    def potential(z):
        return 0.5 * (jnp.abs(z[0]) - 8.0) ** 2 + 0.5 * (z[1] - 8.0) ** 2

    mirrored = np.array([True, True])
    found = chains.chain(
        potential, moves.unknown(2), mirrored, jax.random.key(1), warmup=100, draws=400, room=400
    )
    assert 0.35 < float((found.z[:, 0] > 0.0).mean()) < 0.65
    assert float(found.z[:, 1].min()) > 0.0
