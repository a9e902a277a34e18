import json
import re
import time
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import emulator as em
from emulator.accuracy.comparison import evaluate
from emulator.core.checkpoint import Checkpoint
from emulator.core.errors import InputError
from emulator.fem import run_campaign, sobol, uniform
from emulator.fem.campaign import StoredRuns
from emulator.geometry.refinement import to_quadratic
from emulator.surrogates import Architecture
from emulator.training import RECIPES, recipe, train
from emulator.training.job import DESCRIPTION, Job
from emulator.training.mechanics import Mechanics
from emulator.training.optimiser import WARMUP, State, cosine
from emulator.training.paper import Paper, prepare
from emulator.training.physics import PhysicsPlan

SMALL = Architecture(steps=2, latent=8, hidden=(16, 16))
SEPARABLE = replace(SMALL, decoder="separable", modes=6, trunk=(16, 40))


@pytest.fixture(scope="module")
def tests(beam, simulator):
    return run_campaign(simulator, sobol(beam, 6, seed=5), sensitivities=True)


def test_a_killed_run_resumes_to_the_same_weights(beam, tmp_path, monkeypatch):
    plan = Paper(steps=30, batch=4)
    whole = train(beam, plan, tmp_path / "whole", architecture=SMALL)

    def kill_after_ten(self, state):
        self.write(state)
        if state().done == 10:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(Checkpoint, "keep", kill_after_ten)
        with pytest.raises(KeyboardInterrupt):
            train(beam, plan, tmp_path / "killed", architecture=SMALL)
    # The plan comes from the checkpoint, not from the call.
    resumed = train(beam, Paper(), tmp_path / "killed", architecture=SMALL, resume=True)
    leaves = [jax.tree.leaves(e.network.weights) for e in (whole, resumed)]
    for a, b in zip(*leaves, strict=True):
        np.testing.assert_array_equal(a, b)
    assert resumed.record["plan"] == whole.record["plan"]


@pytest.mark.slow
def test_resuming_needs_a_checkpoint_of_this_scene(beam, cube, tmp_path):
    with pytest.raises(InputError, match="nothing to resume"):
        train(beam, Paper(), tmp_path, resume=True)
    plan = Paper(steps=3, batch=2)
    train(beam, plan, tmp_path, architecture=SMALL)
    folder = tmp_path / "checkpoint"
    assert json.loads((folder / DESCRIPTION).read_text())["plan"]["recipe"] == "paper"
    with pytest.raises(InputError, match="belongs to another scene than 'twisting_cube'"):
        train(cube, plan, tmp_path, architecture=SMALL, resume=True)
    path = folder / "steps.safetensors"
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(InputError, match="is truncated or not a safetensors file"):
        train(beam, plan, tmp_path, architecture=SMALL, resume=True)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format": "0"}, "has format 0, not 1; train afresh"),
        ({"scene": "another"}, "belongs to another scene than"),
        ({"more": 1}, "has not the entries architecture, budget, format, plan, scene, seconds, st"),
        ({"plan": {"recipe": "objectives"}}, "recipe 'objectives' is unknown; known: mechanics"),
        ({"plan": {"recipe": "paper", "rate": 1}}, "unknown key 'rate'"),
    ],
)
def test_a_description_of_another_version_is_refused(beam, tmp_path, change, message, monkeypatch):
    """In one line, before anything is computed."""
    monkeypatch.setattr("emulator.training.trainer.RECIPES", {
        **RECIPES, "paper": RECIPES["paper"]._replace(train=lambda plan, job: em.Emulator(beam))
    })  # fmt: skip
    train(beam, Paper(), tmp_path)
    path = tmp_path / "checkpoint" / DESCRIPTION
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(InputError, match=message) as error:
        train(beam, Paper(), tmp_path, resume=True)
    assert len(str(error.value).splitlines()) == 1


def test_a_resumed_budget_is_what_was_left_of_it(beam, tmp_path, monkeypatch):
    """Or the new one, from now on."""
    jobs = []
    monkeypatch.setattr("emulator.training.trainer.RECIPES", {
        **RECIPES, "paper": RECIPES["paper"]._replace(
            train=lambda plan, job: jobs.append(job) or em.Emulator(beam))
    })  # fmt: skip
    train(beam, Paper(), tmp_path, budget=600.0)
    path = tmp_path / "checkpoint" / DESCRIPTION
    path.write_text(json.dumps(json.loads(path.read_text()) | {"seconds": 450.0}))
    train(beam, Paper(), tmp_path, resume=True)
    left = jobs[-1].deadline(1.0) - time.perf_counter()
    assert 140.0 < left <= 150.0
    train(beam, Paper(), tmp_path, resume=True, budget=60.0)
    left = jobs[-1].deadline(1.0) - time.perf_counter()
    assert 50.0 < left <= 60.0
    assert jobs[-1].seconds >= 450.0


@pytest.mark.slow
def test_a_step_without_a_finite_gradient_is_not_taken(beam):
    plan = Paper(steps=10, batch=2)
    problem = prepare(plan, Job(beam, SMALL))
    leaves, structure = jax.tree.flatten(problem.emulator.network.weights)
    leaves[3] = jnp.full_like(leaves[3], jnp.nan)
    weights = jax.tree.unflatten(structure, leaves)
    state = problem.training.optimiser.init(weights)
    before = [np.array(leaf) for leaf in leaves]
    weights, state, _ = problem.training.step(weights, state, jnp.asarray(5), jnp.asarray(10))
    for old, new in zip(before, jax.tree.leaves(weights), strict=True):
        np.testing.assert_array_equal(old, new)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(state))


@pytest.mark.slow
def test_a_budget_sets_the_number_of_steps(beam, tmp_path):
    emulator = train(beam, Paper(), tmp_path, architecture=SMALL, budget=25.0)
    assert emulator.record["plan"]["steps"] > WARMUP
    assert emulator.record["seconds"] < 50.0  # whatever else the machine is doing


@pytest.mark.slow
def test_a_budget_too_small_says_how_much_more(beam, tmp_path):
    """What 5 s are enough for is the machine's business, and what it has compiled before."""
    with pytest.raises(InputError, match="a budget of 1 s: one FEM solution and its compilation"):
        train(beam, Paper(), tmp_path, architecture=SMALL, budget=1.0)
    over = "the budget of 5 s is over after"
    try:
        emulator = train(beam, Paper(), tmp_path, architecture=SMALL, budget=5.0)
    except InputError as error:
        assert re.search(over, str(error))  # noqa: PT017 - it may also be enough
    else:
        assert emulator.record["plan"]["steps"] >= WARMUP


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"steps": 0}, "steps is 0; it must be 1 or more"),
        ({"learning_rate": float("nan")}, "learning_rate is nan; it must be positive and finite"),
        ({"learning_rate": -1e-3}, "learning_rate is -0.001; it must be positive and finite"),
        ({"simulations": 0}, "0 simulations; modes need 1 or more"),
        ({"sweeps": -1}, "sweeps is -1; it must be 0 or more"),
    ],
)
def test_plans_that_cannot_work(options, message):
    with pytest.raises(InputError, match=message):
        PhysicsPlan(**options)


def test_learning_rate_rises_then_falls():
    rate = cosine(1e-3)
    rates = np.array([rate(jnp.asarray(k), jnp.asarray(1000)) for k in range(1000)])
    assert rates[0] == pytest.approx(1e-3 / WARMUP)
    assert 90 < rates.argmax() < 110
    assert rates.max() < 1e-3
    assert rates[-1] < 1e-8


def test_samples_fill_the_box(beam):
    for thetas in (sobol(beam, 64, 0), uniform(beam, 64, jax.random.key(0))):
        position = np.asarray(beam.to_unit(thetas))
        assert position.min() >= 0.0
        assert position.max() <= 1.0
        counts = np.histogram2d(*position.T, bins=2, range=[[0, 1], [0, 1]])[0]
        assert counts.min() >= 8
    np.testing.assert_array_equal(sobol(beam, 5, 3), sobol(beam, 8, 3)[:5])


def test_a_recipe_that_is_unknown():
    known = "mechanics, two_meshes, physics, sweeps, paper"
    with pytest.raises(InputError, match=f"recipe 'quick' is unknown; known: {known}"):
        recipe("quick")


def test_what_a_recipe_has_no_use_for(beam, tmp_path):
    for name in ("mechanics", "two_meshes", "sweeps"):
        with pytest.raises(InputError, match=f"recipe '{name}' trains no network, so no archit"):
            train(beam, recipe(name), tmp_path, architecture=SMALL)
    start = em.load("once_clamped_beam")
    for name in ("physics", "paper"):
        with pytest.raises(InputError, match="trains its network from nothing, so it has no start"):
            train(beam, recipe(name), tmp_path, start=start)
    with pytest.raises(InputError, match="recipe 'mechanics' begins from .* has none"):
        train(beam, recipe("mechanics"), tmp_path, start=start)
    assert not (tmp_path / "checkpoint" / "steps.safetensors").exists()


def test_orders_of_a_series():
    with pytest.raises(InputError, match="series of order 5; give 0 to 4"):
        Mechanics(order=5)


@pytest.mark.slow
def test_mechanics_builds_no_network(beam, tests, tmp_path, monkeypatch):
    """No graph, no clustering, no array of a network; resumed, it is the same emulator."""

    def never(*_):
        raise AssertionError("a graph was built")

    monkeypatch.setattr("emulator.surrogates.network.graph.hierarchy", never)
    plan = replace(recipe("mechanics"), simulations=5, order=2)
    emulator = train(beam, plan, tmp_path)
    assert list(emulator.parts) == ["taylor", "discrepancy"]
    report = evaluate(emulator.cache(), tests.theta, tests.displacement)
    assert report["err_u"]["median"] < 1e-2
    assert emulator.record["final_loss"] is None
    assert train(beam, Paper(), tmp_path, resume=True).fingerprint == emulator.fingerprint


@pytest.mark.slow
def test_mechanics_on_a_quadratic_ventricle(tmp_path):
    """Mid-side nodes, mean dilatation, nearly incompressible: held-out FEM within micrometres."""
    linear = em.scenes.left_ventricle(rings=2, around=6, layers=1, order=1)
    scene = replace(linear, mesh=to_quadratic(linear.mesh), dilatation="mean", origin={})
    plan = replace(recipe("mechanics"), simulations=8, order=2)
    emulator = train(scene, plan, tmp_path)
    known = run_campaign(em.Simulator(scene), sobol(scene, 3, seed=5))
    report = evaluate(emulator.cache(), known.theta, known.displacement)
    assert report["err_u"]["median"] < 0.02 * report["max_u"]["median"]


def test_an_aim_follows_the_clock(monkeypatch):
    """Steps of 1 s against a deadline in 1000 s, then of 2 s."""
    from emulator.training import optimiser as module

    now = [0.0]
    monkeypatch.setattr(module.time, "perf_counter", lambda: now[0])
    aim = module.StepLimit(1000.0)
    assert aim(State({}, (), 5000, 1, 0.0)) == 5000  # compiled
    now[0] = 200.0
    assert aim(State({}, (), 5000, 201, 0.0)) == 1001
    now[0] = 600.0
    assert aim(State({}, (), 1001, 401, 0.0)) == 401 + int(400.0 / 1.5)
    assert aim(State({}, (), 667, 402, 0.0)) == 667
    now[0] = 0.0
    late = module.StepLimit(100.0)
    late(State({}, (), 3000, 501, 0.0))  # resumed: it begins at step 500
    now[0] = 20.0
    assert late(State({}, (), 3000, 511, 0.0)) == 511 + 40
    now[0] = 200.0  # past the deadline: no step more
    assert late(State({}, (), 551, 701, 0.0)) == 701
    short = module.StepLimit(260.0)
    short(State({}, (), 3000, 1, 0.0))
    now[0] = 210.0
    assert short(State({}, (), 3000, 11, 0.0)) == WARMUP


@pytest.mark.slow
def test_a_campaign_s_runs_are_asked_for_again(beam, tests, tmp_path):
    """Resumed on other FEM runs, a training would not be the one that was begun."""
    stored = StoredRuns(tests, "0123456789abcdef")
    plan = PhysicsPlan(sweeps=0, simulations=6, steps=30, polish=0)
    whole = train(beam, plan, tmp_path, architecture=SEPARABLE, campaign=stored)
    assert whole.record["plan"]["campaign"] == stored.digest
    with pytest.raises(InputError, match="begun on FEM runs of a campaign; resume it with"):
        train(beam, PhysicsPlan(), tmp_path, resume=True)
    resumed = train(beam, PhysicsPlan(), tmp_path, resume=True, campaign=stored)
    leaves = [jax.tree.leaves(e.network.weights) for e in (whole, resumed)]
    for a, b in zip(*leaves, strict=True):
        np.testing.assert_array_equal(a, b)
    with pytest.raises(InputError, match="7 simulations of a campaign with 6"):
        train(beam, replace(plan, simulations=7), tmp_path, campaign=stored)
    with pytest.raises(InputError, match="recipe 'sweeps' takes no FEM runs, so no campaign"):
        train(beam, recipe("sweeps"), tmp_path, campaign=stored)
