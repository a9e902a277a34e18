"""Equilibria over the whole box from residuals alone."""

import subprocess
import sys
import time
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import emulator as em
from emulator.core.checkpoint import Checkpoint
from emulator.core.errors import InputError, SolverError
from emulator.core.store import read_arrays
from emulator.fem import simulator as fem_simulator
from emulator.fem import sobol
from emulator.surrogates import load, save_emulator
from emulator.surrogates.network.pignn import Architecture
from emulator.training import recipe, train
from emulator.training import sweeps as module
from emulator.training.sweeps import runs_of, sweep_box
from emulator.training.targets import targets

SMALL = Architecture(
    steps=2, latent=8, hidden=(16, 16), decoder="separable", modes=6, trunk=(16, 40)
)

PHYSICS = replace(recipe("physics"), sweeps=20, simulations=12, steps=20, polish=50)


@pytest.fixture(scope="module")
def swept(beam):
    """Of a body whose simulator never solves: the counter proves that no FEM solution is used."""
    return sweep_box(em.Simulator(beam), 45, 0)


@pytest.fixture
def no_fem(monkeypatch):
    """Every FEM solution is an error."""

    def refuse(*_):
        raise AssertionError("a FEM solution was asked for")

    monkeypatch.setattr(fem_simulator, "differentiable", lambda *_: refuse)


@pytest.fixture
def equilibrium(beam, simulator):
    """Positions (8, 2) and the free displacements (8, f) there."""
    thetas = sobol(beam, 8, 1)
    fields = [simulator.system.restrict(simulator(theta)) for theta in thetas]
    return np.asarray(jax.vmap(beam.to_unit)(thetas)), np.stack(fields)


def test_they_end_where_fem_does(beam, simulator, swept):
    """Within what they say of themselves; the displacement is some millimetres."""
    thetas = sobol(beam, 6, 9)
    runs = runs_of(simulator, swept, thetas)
    exact = jnp.stack([simulator(theta) for theta in thetas])
    errors = jnp.sqrt(jnp.mean(jnp.sum((runs.displacement - exact) ** 2, axis=-1), axis=-1))
    size = jnp.sqrt(jnp.mean(jnp.sum(exact**2, axis=-1)))
    assert swept.level == 1.0
    assert swept.error < 1e-7 * size
    assert jnp.median(errors) < 2.0 * swept.error + 1e-9 * size
    slopes = jnp.moveaxis(jax.jacfwd(simulator)(thetas[0]), -1, 0)
    np.testing.assert_allclose(runs.sensitivities[0], slopes, atol=1e-5 * jnp.abs(slopes).max())
    energy = simulator.system.potential(exact[0], thetas[0])[0]
    np.testing.assert_allclose(runs.energy[0], energy, rtol=1e-10)


@pytest.mark.slow
def test_supports_that_move_are_followed(cube):
    simulator = em.Simulator(cube)
    swept = sweep_box(simulator, 30, 0)
    theta = sobol(cube, 1, 3)
    there, exact = runs_of(simulator, swept, theta).displacement[0], simulator(theta[0])
    np.testing.assert_allclose(there, exact, atol=1e-3 * jnp.abs(exact).max())
    np.testing.assert_array_equal(there[cube.held], exact[cube.held])


def test_a_target_at_equilibrium_is_where_it_was(simulator, equilibrium):
    position, fields = equilibrium
    found = targets(simulator, fields, position, 1.0)
    np.testing.assert_allclose(found.fields, fields, atol=1e-9)
    assert (found.step < 1e-9).all()


def test_a_target_near_equilibrium_is_nearer(simulator, equilibrium):
    """By the contraction that it says, in the norm that it says it in, about."""
    position, fields = equilibrium
    away = 1.02 * fields
    found = targets(simulator, away, position, 1.0)
    before, after = (np.linalg.norm(x - fields, axis=1) for x in (away, found.fields))
    np.testing.assert_array_equal(found.fraction, 1.0)
    assert (after < 0.2 * before).all()
    assert (found.contraction < 0.2).all()
    np.testing.assert_allclose(found.step, np.sqrt(before**2 / 45), rtol=0.2)
    assert (found.gap > 0.0).all()
    assert (found.error < found.step).all()


def test_contraction_and_gap_by_dense_algebra(simulator, equilibrium):
    """In the norm of the inverse of the group's tangent, in the middle; and by potentials."""
    position, fields = equilibrium
    away = 1.02 * fields
    found, system = targets(simulator, away, position, 1.0), simulator.system
    thetas = simulator.scene.from_unit(jnp.asarray(position))
    middle = np.argmin(np.sum((position - position.mean(axis=0)) ** 2, axis=1))
    values = system.tangent(system.extend(away[middle]), thetas[middle])
    K = np.asarray(system.pattern.product(values, jnp.eye(len(system.free))))

    def size(v, theta):
        r = np.asarray(system.residual(system.extend(v), theta))
        return np.sqrt(r @ np.linalg.solve(K, r))

    for k, theta in enumerate(thetas):
        ratio = size(found.fields[k], theta) / size(away[k], theta)
        assert found.contraction[k] == pytest.approx(ratio, rel=1e-5)
        high, scale = system.potential(system.extend(away[k]), theta)
        low, _ = system.potential(system.extend(fields[k]), theta)
        assert found.gap[k] == pytest.approx(float((high - low) / scale), rel=0.1)


def test_a_target_far_away_lowers_the_potential(simulator, equilibrium):
    """Three times the way to equilibrium: no whole step but what falls, and nothing is crushed."""
    position, fields = equilibrium
    far, system = 3.0 * fields, simulator.system
    found = targets(simulator, far, position, 1.0)
    thetas = simulator.scene.from_unit(jnp.asarray(position))
    moved = found.fraction > 0.0
    assert moved.any()
    for k in np.flatnonzero(moved):
        before, after = (
            float(system.potential(system.extend(v), thetas[k])[0])
            for v in (far[k], found.fields[k])
        )
        assert after < before
        assert system.least_volume_ratio(system.extend(found.fields[k])) > 0.05
    np.testing.assert_array_equal(found.fields[~moved], far[~moved])


@pytest.mark.parametrize("wrong", [np.nan, 1e3, 1e300])
def test_nonsense_gives_no_target(simulator, equilibrium, wrong):
    position, fields = equilibrium
    spoiled = fields.copy()
    spoiled[3] *= wrong
    found = targets(simulator, spoiled, position, 1.0)
    assert found.fraction[3] == 0.0
    assert found.error[3] == np.inf
    others = np.delete(np.arange(8), 3)
    assert np.isfinite(found.error[others]).all()


def test_killed_they_go_on_to_the_same_bits(beam, simulator, tmp_path, monkeypatch):
    whole = sweep_box(simulator, 24, 1)
    kept = Checkpoint(tmp_path / "sweeps.safetensors", every=0.0)
    sweep, done = module._sweep, []

    def kill(*arguments):
        done.append(0)
        if len(done) == 18:
            raise KeyboardInterrupt
        return sweep(*arguments)

    monkeypatch.setattr(module, "_sweep", kill)
    with pytest.raises(KeyboardInterrupt):
        sweep_box(simulator, 24, 1, checkpoint=kept)
    monkeypatch.setattr(module, "_sweep", sweep)
    resumed = sweep_box(simulator, 24, 1, checkpoint=kept)
    np.testing.assert_array_equal(whole.polynomial.coefficients, resumed.polynomial.coefficients)
    assert resumed.number == 24


@pytest.mark.slow
def test_from_fems_series_about_the_centre_they_need_no_ramp(beam, simulator, tmp_path):
    plan = replace(recipe("sweeps"), order=2, sweeps=12)
    emulator, theta = train(beam, plan, tmp_path), sobol(beam, 1, 5)[0]
    exact = simulator(theta)
    assert emulator.record["sweeps"]["number"] <= 12
    np.testing.assert_allclose(emulator(theta), exact, atol=1e-5 * jnp.abs(exact).max())


@pytest.mark.slow
def test_from_a_familys_network_to_a_body_it_has_not_seen(tmp_path):
    """Before the first FEM run: six sweeps leave less than half of the network's error."""
    scene, learned = em.scenes.left_ventricle(7, 20, 2), load("ventricle_family")
    simulator, thetas = em.Simulator(scene), sobol(scene, 3, 3)
    exact = jnp.stack([simulator(theta) for theta in thetas])

    def error(emulator):
        there = emulator.cache()(thetas)
        return float(jnp.median(jnp.mean(jnp.linalg.norm(there - exact, axis=-1), axis=-1)))

    swept = train(scene, replace(recipe("sweeps"), sweeps=6), tmp_path, start=learned)
    assert error(swept) < 0.5 * error(load("ventricle_family", scene))


def test_too_few_are_told(simulator):
    with pytest.raises(SolverError, match="16 sweeps followed the equilibria to [1-9]+ % of the"):
        sweep_box(replace_load(simulator), 16, 0)


def test_without_loads_nothing_moves(simulator):
    swept = sweep_box(replace_load(simulator, 0.0), 16, 0)
    assert swept.done
    np.testing.assert_array_equal(swept.polynomial.coefficients, 0.0)


def test_a_box_that_is_known_in_part_is_refused(simulator, monkeypatch):
    """A fifth of the theta without a step: the others' error bar says nothing of those."""

    def lame(*arguments, **options):
        found = targets(*arguments, **options)
        found.fraction[::5] = 0.0
        return found

    monkeypatch.setattr(module, "targets", lame)
    start = lambda x: simulator(simulator.scene.from_unit(x))
    with pytest.raises(SolverError, match="8 sweeps know no equilibrium at 2[0-9] % of the box"):
        sweep_box(simulator, 8, 0, starts=[lambda: start])


def replace_load(simulator, factor=1000.0):
    """The beam under a thousand times its weight, which sixteen sweeps do not reach."""
    scene = simulator.scene
    (load,) = scene.loads
    heavier = replace(load, density=factor * load.density)
    return em.Simulator(replace(scene, loads=(heavier,), origin={}))


def test_a_recipe_without_fem_and_without_a_network(beam, no_fem, tmp_path):
    emulator = train(beam, replace(recipe("sweeps"), sweeps=40), tmp_path / "train")
    assert list(emulator.parts) == ["polynomial"]
    assert emulator.record["sweeps"]["number"] <= 40
    save_emulator(emulator, tmp_path / "saved")
    theta = beam.from_unit(jnp.array([0.3, 0.8]))
    again = load(tmp_path / "saved", beam)
    np.testing.assert_array_equal(again.cache()(theta), emulator.cache()(theta))


@pytest.mark.slow
def test_a_network_that_never_saw_fem(beam, no_fem, tmp_path):
    """The centre's solution of sweeps and the network; it says how far from equilibrium it is."""
    emulator = train(beam, PHYSICS, tmp_path, architecture=SMALL)
    assert list(emulator.parts) == ["taylor", "network"]
    assert len(emulator.taylor.indices) == 0
    assert emulator.record["plan"]["sweeps"] == emulator.record["sweeps"]["number"] == 20
    assert emulator.record["equilibrium"]["known"] == 16


TRAINING = """
import sys
import emulator as em
from emulator.surrogates.network.pignn import Architecture
from emulator.training import job
from emulator.training.physics import PhysicsPlan

job._EVERY = 0.0  # a state after each sweep and each step
em.train(
    em.scenes.once_clamped_beam(cells=(4, 2, 2), order=1),
    PhysicsPlan(sweeps=20, simulations=12, steps=300, polish=50),
    sys.argv[1],
    architecture=Architecture(2, 8, (16, 16), "separable", 6, trunk=(16, 40)),
)
"""


@pytest.mark.slow
def test_a_process_killed_twice_goes_on_to_the_same_weights(tmp_path):
    """By SIGKILL, once among sweeps and once among steps of the network."""
    scene = em.scenes.once_clamped_beam(cells=(4, 2, 2), order=1)
    plan = replace(PHYSICS, steps=300)
    whole = train(scene, plan, tmp_path / "whole", architecture=SMALL)
    folder = tmp_path / "killed"

    def killed_at(script, stage, name, count):
        path, number = folder / "checkpoint" / f"{stage}.safetensors", 0
        with subprocess.Popen([sys.executable, "-c", script, str(folder)]) as process:
            while number < count:
                assert process.poll() is None, "it ended before it was killed"
                time.sleep(0.02)
                number = int(read_arrays(path)[0][name]) if path.is_file() else 0
            process.kill()

    killed_at(TRAINING, "sweeps", "number", 7)
    resumed = TRAINING.replace("sys.argv[1],", "sys.argv[1], resume=True,")
    killed_at(resumed, "steps", "done", 40)
    again = train(scene, recipe("physics"), folder, resume=True)
    leaves = [jax.tree.leaves(e.network.weights) for e in (whole, again)]
    for a, b in zip(*leaves, strict=True):
        np.testing.assert_array_equal(a, b)


def test_what_cannot_be_swept_is_refused(beam, tmp_path):
    with pytest.raises(InputError, match="15 sweeps; the loads rise over 15, give 16 or more"):
        train(beam, replace(recipe("sweeps"), sweeps=15), tmp_path)
    assert recipe("physics").runs == recipe("sweeps").runs == 0


@pytest.mark.parametrize("factor", [pytest.param(-3.0, marks=pytest.mark.slow), np.nan])
def test_from_a_start_that_is_nowhere_near_they_go_on_from_rest(simulator, swept, factor):
    """A beam pushed through itself: no tangent there is positive definite."""
    through = factor * jnp.asarray(simulator.scene.mesh.nodes)
    nowhere = lambda: lambda position: through
    found = sweep_box(simulator, 34, 0, starts=[nowhere])
    assert found.record["starts_left"] == 1
    assert "starts_left" not in swept.record
    middle = jnp.full((1, 2), 0.5)
    there, right = found.polynomial.at(middle), swept.polynomial.at(middle)
    np.testing.assert_allclose(there, right, atol=1e-5 * np.abs(right).max())
    with pytest.raises(SolverError, match="where the start says, and then 2 sweeps followed"):
        sweep_box(simulator, 2, 0, starts=[nowhere])


def test_a_start_that_is_nowhere_near_is_left_for_the_next(simulator, swept):
    """One pushed through itself, one that FEM finds no solution for, and one that is known."""

    def none():
        raise SolverError("no solution")

    def known():
        return lambda x: simulator.system.extend(swept.polynomial.at(x[None])[0])

    through = -3.0 * jnp.asarray(simulator.scene.mesh.nodes)
    starts = [lambda: lambda position: through, none, known]
    found = sweep_box(simulator, 3, 0, starts=starts)
    assert found.record["starts_left"] == 2
    assert found.level == 1.0
    assert found.error < 1e-2 * np.abs(np.asarray(simulator(simulator.scene.centre))).max()
