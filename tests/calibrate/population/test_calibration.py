"""Simulation-based calibration of hierarchies: ranks of population and members are uniform."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpyro import handlers

import calibrate as cal
from calibrate.analysis.sbc import LOG_LIKELIHOOD, Replicate, calibration_of
from calibrate.population import population_model, sample_population
from calibrate.population.model import PopulationDraws
from calibrate.samplers import NUTSOptions
from linear_support import linear_forward

NODES, NOISE, RANKED = np.array([3, 11, 20]), 0.1, 99


def twin(model, forward, seed):
    """Unknowns by the names of Hierarchy.draws, and data by member, from the prior."""
    score_key = jax.random.fold_in(jax.random.key(seed), 1)
    seeded = handlers.seed(model, jax.random.key(seed))
    sites = {k: v["value"] for k, v in handlers.trace(seeded).get_trace().items()}
    names = list(model.shared)
    median, sd = (jnp.stack([sites[f"{r}[{n}]"] for n in names]) for r in ("median", "sd"))
    factor = sites.get("correlation_cholesky", jnp.eye(len(names)))
    scores = jax.random.normal(score_key, (len(model.members), len(names)))
    values = model.shared_values(PopulationDraws(median, sd, factor), scores)
    truth = {k: float(v) for k, v in sites.items() if k.startswith(("median", "sd"))}
    if len(names) > 1:
        truth["correlation[mu, lam]"] = float((factor @ factor.T)[0, 1])
    rng, data = np.random.default_rng(seed), {}
    for i, member in enumerate(model.members):
        truth |= {f"{name}[{member}]": float(values[name][i]) for name in names}
        theta = np.array([float(values[n][i]) if n in values else 75.0 for n in ("mu", "lam")])
        exact = np.asarray(forward(jnp.asarray(theta)))
        data[member] = {"displacement": jnp.asarray(exact + NOISE * rng.normal(size=(3, 3)))}
    return truth, data


def log_likelihood(model, forward, draws, data):
    """Of all data at draws (s,), up to a constant."""
    found = 0.0
    for member, y in data.items():
        given = [np.asarray(draws.get(f"{n}[{member}]", 75.0)) for n in ("mu", "lam")]
        theta = np.stack(np.broadcast_arrays(*given), axis=-1)
        means = np.einsum("ndp,...p->...nd", forward.matrix, theta) + forward.shift
        found -= 0.5 * np.sum((means - np.asarray(y["displacement"])) ** 2, axis=(-1, -2))
    return found / NOISE**2


def calibrated(beam, members, replicates, options, **more):
    whole = linear_forward(beam)
    observe = cal.nodal_displacements(beam, NODES)
    own = cal.model(whole, observe, cal.GaussianNoise(sd=NOISE), check_scale=False, **more)
    model = population_model({f"b{i}": own for i in range(members)})
    forward = whole.at(NODES)

    def one(seed):
        truth, data = twin(model, forward, seed)
        found = sample_population(model, data, options=options, seed=seed)
        rows = np.linspace(0, options.chains * options.draws - 1, RANKED).astype(int)
        draws = {name: values.reshape(-1)[rows] for name, values in found.draws().items()}
        assert set(draws) == set(truth)
        kept = [name for name in truth if "[b" not in name or name == "mu[b0]"]
        heights = [
            {LOG_LIKELIHOOD: log_likelihood(model, forward, x, data)} for x in (truth, draws)
        ]
        return Replicate(
            {k: truth[k] for k in kept} | heights[0], {k: draws[k] for k in kept} | heights[1]
        )

    return calibration_of(map(one, range(replicates)))


@pytest.mark.slow
def test_a_population_of_one_parameter_is_calibrated(beam):
    options = NUTSOptions(warmup=150, draws=150, chains=2, rounds=1)
    found = calibrated(beam, 2, 20, options, known={"lam": 75.0})
    assert found.passed, found.outside()


@pytest.mark.slow
def test_a_population_of_two_correlated_parameters_is_calibrated(beam):
    options = NUTSOptions(warmup=400, draws=500, chains=2, rounds=2)
    found = calibrated(beam, 5, 100, options)
    print(found.coverage())
    for name, u in found.ranks.items():
        print(name, "mean rank", u.mean().round(3), "sd", u.std().round(3))
    assert found.passed, found.outside()
