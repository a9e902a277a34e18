"""What a finer mesh changes of a posterior, where that is known in closed form, and by FEM."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

import calibrate as cal
import emulator as em
from calibrate.certificate import examine
from calibrate.certificate.evidence import Figure, MeshChange
from calibrate.certificate.mesh import DifferenceOfFEM, _at_draws, change_by, points_for
from calibrate.certificate.verdict import judge
from calibrate.statistical_model.finer_fem import finer_fem
from certificate_support import exact_data, exact_posterior, grid_of, linear_model, quadrature
from emulator.core.engine import Engine
from emulator.surrogates.correction import corrections, fit_correction
from emulator.surrogates.taylor import expand
from linear_support import LinearSimulator, linear_forward


@pytest.fixture(scope="module")
def fem(beam):
    return linear_forward(beam, size=0.02)


@pytest.fixture(scope="module")
def check(beam, fem):
    data = exact_data(linear_model(beam, forward=fem))
    posterior = exact_posterior(linear_model(beam, forward=fem), data)
    return data, examine(posterior, LinearSimulator(fem), draws=100)


def finer_than(fem, model, stretch, shift):
    """FEM on a finer mesh, whose answer to theta differs by a factor and by ``shift`` mm."""
    fine = replace(fem, matrix=(1.0 + stretch) * fem.matrix, shift=fem.shift + shift)
    nodes = model.forward.nodes

    def differences(z, predictive):
        draws = predictive.constrain(z)
        for theta in np.stack([draws[name] for name in model.names], axis=1):
            yield np.asarray((fine(theta) - fem(theta))[nodes]).ravel()

    return fine, differences


@pytest.mark.parametrize(("stretch", "shift"), [(0.0, 0.01), (0.02, 0.0), (0.0, 0.1)])
def test_shifts_are_those_of_the_quadrature(fem, check, stretch, shift):
    data, found = check
    model = found.posterior.model
    fine, differences = finer_than(fem, model, stretch, shift)
    by_fem = lambda z: differences(z, found.pool.predictive)
    told = change_by(by_fem, found.pool, found.tests.runs, (8, 8), np.random.default_rng(0))
    points, weights, moved = grid_of(), quadrature(fem, data), quadrature(fine, data)
    mean, after = weights @ points, moved @ points
    sd, sd_after = (np.sqrt(w @ (points - m) ** 2) for w, m in ((weights, mean), (moved, after)))
    for k, name in enumerate(model.names):
        exact, figure = (after - mean)[k] / sd[k], told.shift[name]
        assert abs(figure.value - exact) < 4.0 * figure.error + 0.02
        assert figure.error < 0.1 + 0.1 * np.max(np.abs(after - mean) / sd)
        assert abs(told.log_sd[name].value - np.log(sd_after / sd)[k]) < (
            4.0 * told.log_sd[name].error + 0.02
        )


def test_a_posterior_far_away_is_followed(fem, check):
    """By 3.7 sd: the pool's points tell the sd, and so the shift, to a tenth; the limit is 0.25."""
    data, found = check
    model = found.posterior.model
    fine, differences = finer_than(fem, model, 0.0, 0.3)
    by_fem = lambda z: differences(z, found.pool.predictive)
    told = change_by(by_fem, found.pool, found.tests.runs, (8, 8), np.random.default_rng(0))
    points, weights, moved = grid_of(), quadrature(fem, data), quadrature(fine, data)
    mean, after = weights @ points, moved @ points
    exact = (after - mean) / np.sqrt(weights @ (points - mean) ** 2)
    assert np.abs(exact).max() > 3.0
    for k, name in enumerate(model.names):
        assert abs(told.shift[name].value - exact[k]) < 0.1 * np.abs(exact).max()
        assert abs(told.log_sd[name].value) < 0.2


def test_a_mesh_counts_where_few_runs_converged(fem, check):
    """Nothing corrects the map then, which is right here; the mesh's shift is what it was."""
    _, found = check
    _, differences = finer_than(fem, found.posterior.model, 0.0, 0.01)
    by_fem = lambda z: differences(z, found.pool.predictive)
    runs, failed = found.tests.runs, np.full_like(found.tests.runs.means, np.nan)
    shifts = [
        change_by(by_fem, found.pool, of, (8, 8), np.random.default_rng(0)).shift["mu"].value
        for of in (runs, runs._replace(means=failed))
    ]
    assert abs(shifts[0]) > 0.1
    assert abs(shifts[1] - shifts[0]) < 0.01


def test_points_are_added_until_every_figure_is_decided(fem, check):
    """A mesh that moves a mean by just the limit is never decided; one that moves none, at once."""
    _, found = check
    model, rng, counts = found.posterior.model, np.random.default_rng(1), []

    def moved(shift):
        _, differences = finer_than(fem, model, 0.0, shift)

        def counted(z):
            counts.append(len(z))
            return differences(z, found.pool.predictive)

        counts.clear()
        return change_by(counted, found.pool, found.tests.runs, (6, 40), rng)

    slope = max(abs(figure.value) for figure in moved(0.01).shift.values()) / 0.01
    assert counts == [4]
    assert moved(0.5 / slope).runs == sum(counts) == 40
    assert counts == [4, 2, 3, 4, 6, 9, 12]


def test_a_fit_like_another_has_its_kernel():
    """Wavy errors want a short kernel, a constant one a long; the second is fitted with the first's."""
    x = np.linspace(-1.0, 1.0, 12)[:, None]
    wavy = fit_correction(x, np.sin(6.0 * x), np.ones(1), 12)
    alone = fit_correction(x, x**2, np.ones(1), 12)
    like = fit_correction(x, x**2, np.ones(1), 12, like=wavy)
    assert (alone.length, alone.nugget) != (wavy.length, wavy.nugget)
    assert (like.length, like.nugget) == (wavy.length, wavy.nugget)


@pytest.mark.parametrize("unknowns", [2, 4, 6, 12])
def test_four_points_continue_a_difference_that_hardly_varies(unknowns):
    """Of as many points as unknowns, those left out would be met better by no difference at all."""
    rng, fitted = np.random.default_rng(unknowns), []
    for _ in range(20):
        x = rng.normal(size=(4, unknowns))
        D = np.array([1.6, 2.2]) + 0.1 * x @ rng.normal(size=(unknowns, 2)) / unknowns**0.5
        correction = fit_correction(x, D, np.full(2, 3.0), 4, exact=True)
        fitted.append(np.asarray(corrections(correction, x.mean(axis=0)[None]))[0] - D.mean(axis=0))
    assert np.abs(fitted).max() < 0.1


def test_points_are_far_from_each_other(fem, check):
    """The least distance between two of them, beside draws at random."""
    _, found = check
    pool, rng = found.pool, np.random.default_rng(0)
    every = lambda z: list(np.zeros((len(z), len(pool.predictive.scales))))
    z, _ = _at_draws(every, pool, 8, rng, pool.z[:0])
    more, _ = _at_draws(every, pool, 8, rng, z)
    x = pool.predictive.features(np.concatenate([z, more]))
    random = pool.predictive.features(pool.z[rng.choice(len(pool.z), 16, p=pool.corrected)])
    gaps = [
        np.sort(np.linalg.norm(p[:, None] - p, axis=-1), axis=1)[:, 1].min() for p in (x, random)
    ]
    assert gaps[0] > 3.0 * gaps[1]


def test_failures_on_the_finer_mesh_leave_it_open(check):
    _, found = check
    failures = lambda z: [None] * len(z)
    rng = np.random.default_rng(0)
    told = change_by(failures, found.pool, found.tests.runs, (8, 30), rng)
    assert told.failed == 9
    assert not told.shift
    certificate = judge(replace(found.certificate.evidence, mesh=told))
    assert certificate.verdict == "undecided"
    assert "FEM failed at 9 of 9 points on a finer mesh" in certificate.reason


def test_the_verdict_follows_the_mesh(check):
    _, found = check
    evidence = found.certificate.evidence
    assert found.certificate.verdict == "accepted"
    assert found.certificate.reason.endswith("on this mesh")

    def verdict(shift, error=0.01, log_sd=0.0):
        row = MeshChange(
            {"mu": Figure(shift, error)}, {"mu": Figure(log_sd, 0.01)}, nodes=900, runs=8
        )
        return judge(replace(evidence, mesh=row))

    assert verdict(0.1).verdict == "accepted"
    assert "mesh: on a finer mesh (900 nodes) no mean would move by more than 0.10" in str(
        verdict(0.1)
    )
    assert verdict(-3.0).verdict == "not certified"
    assert "the mean of mu would move by -3.00 sd: infer on the finer mesh" in str(verdict(-3.0))
    assert verdict(0.1, log_sd=0.5).verdict == "not certified"
    for open_ in (verdict(0.45, 0.1), verdict(float("nan")), verdict(0.1, float("nan"))):
        assert open_.verdict == "undecided"
    linear = replace(verdict(2.0).evidence.mesh, linear=True)
    remedy = "make the elements quadratic (order = 2), or infer on the finer mesh (calibrate infer"
    assert remedy in str(judge(replace(evidence, mesh=linear)))
    assert verdict(0.1).to_json()["mesh"]["shift"] == {"mu": 0.1}


def test_a_worker_solves_on_the_finer_mesh_as_this_process_does():
    scene = em.scenes.once_clamped_beam(cells=(2, 1, 1), order=1)
    simulator, observe = em.Simulator(scene), cal.nodal_displacements(scene, "right")
    emulator = em.Emulator(scene, taylor=expand(simulator)).cache()
    model = cal.model(emulator, observe, cal.GaussianNoise(sd=0.5), check_scale=False)
    difference = DifferenceOfFEM(finer_fem(model, simulator))
    tasks = [({"mu": np.array(75.0), "lam": np.array(lam)}, []) for lam in (60.0, 70.0)]
    engine = Engine(ThreadPoolExecutor(2), 2)
    here, there = map(difference, tasks), engine.in_order(difference, iter(tasks))
    for one, other in zip(here, there, strict=True):
        assert np.array_equal(one.fine, other.fine)
        assert np.array_equal(one.coarse, other.coarse)
        assert np.abs(one.fine - one.coarse).max() > 0.1


def test_solves_are_counted_in_every_load_state():
    assert points_for(2, 1, None) == (6, 30)
    assert points_for(18, 1, None) == (22, 30)
    assert points_for(4, 3, None) == (8, 10)
    assert points_for(2, 1, 5) == (5, 5)
    assert points_for(2, 10, None) == (4, 4)  # fewer say nothing of the error


@pytest.mark.slow
def test_locked_elements_are_not_certified():
    """Data of a fine mesh, inferred with linear elements that lock."""
    scene = em.scenes.once_clamped_beam(cells=(6, 1, 2), order=1)
    truth, body = jnp.array([75.0, 70.0]), em.scenes.once_clamped_beam(cells=(12, 2, 2))
    tip = np.array([[95.0, 5.0, 5.0], [60.0, 5.0, 5.0]])
    observe = cal.landmarks(body, tip)
    data = observe(em.Simulator(body)(truth)[observe.nodes], truth)
    simulator = em.Simulator(scene)
    emulator = em.Emulator(scene, taylor=expand(simulator))
    model = cal.model(
        emulator.cache(), cal.landmarks(scene, tip), cal.GaussianNoise(sd=0.5), check_scale=False
    )
    posterior = cal.sample(
        model, np.asarray(data), options=cal.samplers.NUTSOptions(200, 300, 2, rounds=1)
    )
    alone = cal.certify(posterior, simulator, draws=60, mesh=0)
    whole = cal.certify(posterior, simulator, draws=60)
    assert "no finer mesh was asked" in str(alone)
    assert whole.verdict == "not certified"
    assert any("on a finer mesh" in finding for finding in whole.findings)
