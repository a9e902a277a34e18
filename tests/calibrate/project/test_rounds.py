"""Rounds of FEM runs find a posterior that nobody's range contains, and teach an emulator there."""

import json
from dataclasses import asdict, replace
from shutil import copytree

import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from scipy.stats import norm

import calibrate as cal
import emulator as em
from calibrate.cli import main
from calibrate.priors import Population, prior_of
from calibrate.priors.wide import completed, wide_prior, widened
from calibrate.project import (
    Run,
    by_rounds,
    infer,
    model_before_data,
    read_posterior,
    read_problem,
    simulator_of,
)
from calibrate.project.rounds import Round, _are_foreseen, _read
from calibrate.report.charts import traces
from calibrate.report.page import html_of
from calibrate.statistical_model.fem_likelihood import FEMLikelihood
from emulator.core.errors import InputError, SolverError
from emulator.core.store import read_arrays, save_arrays
from emulator.fem.campaign import workers
from emulator.fem.solution import Status
from emulator.scenes.built_in import BUILT_IN
from emulator.surrogates.correction import correction_at

PULLED = """
mesh = "own.vtu"
law = "neo_hookean"
loads = [{kind = "dead_pressure", facet_set = "right", parameter = "pull"}]
supports = [{node_set = "left"}]
parameters = {mu = {unit = "kPa", range = [50, 100]}, pull = {unit = "kPa", range = [0.5, 3]}}
constants = {lam = 60}
"""
BEAM = "once_clamped_beam"
# The beam's range is 50 to 100 kPa in both moduli; neither is in it.
TRUTH = {"mu": 190.0, "lam": 33.0}
RUN = Run(
    BEAM, forward="rounds", truth=TRUTH, observe="nodes:9", noise={"displacement": 0.2},
    draws=500, seed=3,
)  # fmt: skip


@pytest.fixture(scope="module", autouse=True)
def coarse():
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(
            BUILT_IN, BEAM, lambda **_: em.scenes.once_clamped_beam(cells=(4, 1, 1), order=1)
        )
        yield


@pytest.fixture(scope="module")
def folder(tmp_path_factory, coarse):
    path = tmp_path_factory.mktemp("rounds") / "r"
    infer(RUN, path, check_map=False)
    return path


def test_a_truth_outside_of_the_range_is_found_by_few_runs(folder):
    _, posterior = read_posterior(folder)
    table = posterior.summary()
    for name, value in TRUTH.items():
        assert abs(table[name]["mean"] - value) < 3.0 * table[name]["sd"], name
    assert table["mu"]["sd"] < 20.0  # it is learned, not the prior's
    record = json.loads(posterior.tree.attrs["rounds"])
    assert record[-1]["runs"] <= 40
    assert record[-1]["missed"] < 0.15


def test_the_emulator_is_fem_at_its_draws(folder):
    _, posterior = read_posterior(folder)
    fem = FEMLikelihood(posterior.model, simulator_of(posterior.model.forward.scene))
    draws = posterior.draws()
    some = [{n: float(v[k]) for n, v in draws.items()} for k in range(0, 2000, 250)]
    answers = [one for _, one in fem.many(some, posterior.data)]
    assert np.std([one.fem - one.cheap for one in answers]) < 0.1


def test_what_was_saved_is_read_again(folder):
    run, posterior = read_posterior(folder)
    assert run.forward == posterior.model.forward.kind == "rounds"
    assert set(run.prior["median"]) == {"mu", "lam"}
    space = {p.name: p for p in posterior.model.forward.scene.parameters}
    assert space["mu"].low < 10.0 < 500.0 < space["mu"].high


def test_what_is_sampled_is_the_process_that_fem_tested(folder):
    """Also after it was saved; the displacement of the body, and other data, are the emulator's."""
    _, posterior = read_posterior(folder)
    model, draws = posterior.model, posterior.draws()
    process = model.full.data
    assert model.question == process.question
    values = {name: jnp.asarray(v[7]) for name, v in draws.items()}
    x = model.on_scales(jnp.stack([values[name] for name in model.states.unknowns]))
    means, valid = model.predict(values)
    flat = process.constant + correction_at(process.correction, x)
    assert bool(valid)
    np.testing.assert_array_equal(ravel_pytree(means)[0], flat)
    thetas = model.states.thetas(values)
    by_body = model.observe(model.evaluate(thetas).displacement, thetas)["displacement"]
    assert 0.0 < np.abs(by_body - means["displacement"]).max() < 0.02  # mm, a tenth of the noise
    other = cal.model(
        model.full, cal.nodal_displacements(model.full.scene, [3]), cal.GaussianNoise(1)
    )
    u = other.predict(values)[0]["displacement"]
    np.testing.assert_allclose(u[0], model.full(thetas[0])[3], rtol=1e-12)
    outside = {name: jnp.asarray(1e6) for name in values}
    assert not bool(model.predict(outside)[1])


@pytest.mark.parametrize(
    ("missed", "worst", "ends"),
    [(0.05, 0.5, True), (0.05, 1.5, False), (0.2, 0.5, False), (np.inf, 0.0, False)],
)
def test_rounds_end_where_draws_and_every_likely_point_were_foreseen_twice(missed, worst, ends):
    last = Round(34, 0, missed, worst)
    assert _are_foreseen([Round(18, 0, 1.0, 9.0), Round(26, 0, 0.01, 0.1), last]) is ends
    assert not _are_foreseen([Round(18, 0, 1.0, 9.0), last])
    assert not _are_foreseen([last])


def test_a_budget_that_is_over_ends_the_search_and_says_so(monkeypatch):
    posterior = infer(RUN, check_map=False, deadline=0.0)
    assert json.loads(posterior.tree.attrs["rounds"]) == []
    assert len(posterior.taught_at()["mu"]) == 10
    assert any("FEM was not foreseen" in warning for warning in posterior.warnings())


def test_a_search_that_was_killed_goes_on_to_the_same_posterior(folder, tmp_path, monkeypatch):
    """What was solved before is not solved again."""
    solve, solved = workers.Solver.__call__, []

    def stopping(solver, task):
        if len(solved) == 20:
            raise KeyboardInterrupt
        solved.append(task.number)
        return solve(solver, task)

    monkeypatch.setattr(workers.Solver, "__call__", stopping)
    with pytest.raises(KeyboardInterrupt):
        infer(RUN, tmp_path / "r", check_map=False)
    solved.clear()
    monkeypatch.setattr(
        workers.Solver, "__call__", lambda solver, task: solved.append(1) or solve(solver, task)
    )
    again = infer(RUN, tmp_path / "r", check_map=False)
    _, before = read_posterior(folder)
    assert len(solved) == json.loads(before.tree.attrs["rounds"])[-1]["runs"] - 18
    np.testing.assert_allclose(again.draws()["mu"], before.draws()["mu"], rtol=1e-6)


def test_another_noise_begins_with_all_runs_of_the_folder(folder, tmp_path, monkeypatch):
    copytree(folder, tmp_path / "r")
    solve, solved = workers.Solver.__call__, []
    monkeypatch.setattr(
        workers.Solver, "__call__", lambda solver, task: solved.append(1) or solve(solver, task)
    )
    before = json.loads(read_posterior(folder)[1].tree.attrs["rounds"])[-1]["runs"]
    another = replace(RUN, noise={"displacement": 0.1})
    posterior = infer(another, tmp_path / "r", check_map=False, force=True)
    record = json.loads(posterior.tree.attrs["rounds"])
    assert record[0]["runs"] == before + 8
    assert len(solved) == record[-1]["runs"] - before
    assert record[-1]["missed"] < 0.1
    assert len(posterior.taught_at()["mu"]) == record[-1]["runs"]
    for name, value in TRUTH.items():
        row = posterior.summary()[name]
        assert abs(row["mean"] - value) < 3.0 * row["sd"], name


def test_a_further_load_state_is_all_that_is_solved_at_earlier_draws(tmp_path, monkeypatch):
    """And a file of solutions of an earlier version, which names no draws, begins nothing."""
    em.write_mesh(tmp_path / "own.vtu", em.generators.box((40.0, 10.0, 10.0), (4, 1, 2)))
    (tmp_path / "own.toml").write_text(PULLED)
    solve, solved = workers.Solver.__call__, []
    monkeypatch.setattr(
        workers.Solver, "__call__", lambda solver, task: solved.append(1) or solve(solver, task)
    )
    run = Run(
        str(tmp_path / "own.toml"), forward="rounds", truth={"mu": 60.0},
        known={"pull@a": 1.0}, observe="nodes:3", noise={"displacement": 0.2}, draws=200,
    )  # fmt: skip
    first = infer(run, tmp_path / "r", check_map=False)
    before = len(first.taught_at()["mu"])
    solved.clear()
    more = replace(run, known={"pull@a": 1.0, "pull@b": 2.0})
    again = infer(more, tmp_path / "r", check_map=False, force=True)
    fresh = len(again.taught_at()["mu"]) - before
    assert len(solved) == before + 2 * fresh
    arrays, metadata = read_arrays(tmp_path / "r" / "solutions.safetensors")
    del metadata["draws"]
    save_arrays(tmp_path / "old.safetensors", arrays, metadata)
    assert _read(tmp_path / "old.safetensors", metadata["of"])[1] == {}


def test_a_solve_at_a_draw_ends_sooner_than_one_for_its_own_sake(beam):
    """One far out in a prior takes as long as a hundred others; with load steps it may be longer."""
    most = [simulator_of(beam, steps).options.max_iterations for steps in (1, 4, 10)]
    assert most == [100, 100, 200]
    assert em.Simulator(beam).options.max_iterations == 330


def test_fem_that_fails_in_a_third_of_the_prior_costs_runs_and_nothing_else(monkeypatch):
    """Bodies softer than 50 kPa, 29 % of the prior of mu, have no equilibrium."""
    solve = workers.Solver.__call__

    def failing(solver, task):
        row = solve(solver, task)
        if float(task.theta[0]) < 50.0:
            failed = row.solution._replace(status=np.asarray(Status.LOAD_LIMIT))
            return row._replace(solution=failed)
        return row

    monkeypatch.setattr(workers.Solver, "__call__", failing)
    posterior = infer(RUN, check_map=False)
    rounds = json.loads(posterior.tree.attrs["rounds"])
    assert 1 <= rounds[-1]["failed"] < rounds[-1]["runs"] / 3
    assert rounds[-1]["missed"] < 0.1
    mu = posterior.summary()["mu"]
    assert abs(mu["mean"] - TRUTH["mu"]) < 3.0 * mu["sd"] < 60.0


def test_only_a_scene_without_an_emulator_gets_rounds():
    run = Run(BEAM, truth={"mu": 70.0, "lam": 70.0}, observe="nodes:9")
    problem = read_problem(run)
    assert by_rounds(problem) is problem
    # It has the name of a scene that has one.
    assert by_rounds(read_problem(replace(run, scene=f"finer:{BEAM}"))).run.forward == "rounds"
    with pytest.raises(InputError, match="calibrate infer makes it"):
        model_before_data(RUN)


def test_a_wide_prior_has_the_range_as_one_sd_and_keeps_what_is_stated():
    scene = em.scenes.once_clamped_beam(cells=(4, 1, 1), order=1)
    wide = wide_prior(scene, bounded=["lam"])
    assert wide.median == pytest.approx({"mu": np.sqrt(5000.0)})
    assert wide.log_sd["mu"] == pytest.approx(np.log(2.0))  # 50 to 100 kPa is half of that
    stated = Population({"mu": 20.0}, {"mu": 0.3})
    both = completed(stated, wide_prior(scene))
    assert both.median["mu"] == 20.0
    assert both.log_sd["mu"] == 0.3
    assert set(both.median) == {"mu", "lam"}
    space = {p.name: p for p in widened(scene, both).parameters}
    assert space["mu"].low == pytest.approx(20.0 * np.exp(-3.72 * 0.3))
    assert completed(None, None) is None


def test_a_range_stays_off_what_nature_does_not_allow():
    """Poisson's ratio ends at 1/2, wherever the median's multiples are."""
    scene = em.scenes.twisting_cube()
    space = {p.name: p for p in widened(scene, wide_prior(scene)).parameters}
    assert 0.0 < space["nu"].low < space["nu"].high < 0.5
    assert space["nu"].scale == "log"


def test_what_is_known_has_no_wide_prior():
    run = replace(RUN, truth={"mu": 190.0}, known={"lam": 400.0})  # four times the range's end
    problem = read_problem(run)
    assert set(problem.run.prior["median"]) == {"mu"}
    assert problem.scene.parameters[1].high > 400.0
    assert read_problem(problem.run).run.prior == problem.run.prior
    stated = replace(run, prior={"median": {"lam": 60.0}, "log_sd": {"lam": 0.5}})
    with pytest.raises(InputError, match="'lam' is known and has a prior"):
        read_problem(stated)


def test_a_prior_in_which_fem_fails_is_named(monkeypatch):
    monkeypatch.setattr(
        FEMLikelihood,
        "equilibria",
        lambda _, draws, **__: iter([(k, None) for k in range(len(draws))]),
    )
    with pytest.raises(SolverError, match="FEM fails at 10 of 10 points of the prior"):
        infer(RUN)


OWN = """
mesh = "own.vtu"
law = "neo_hookean"
order = 2
loads = [{kind = "gravity"}]
supports = [{node_set = "left"}]
parameters = {mu = {unit = "kPa", range = [50, 100]}, lam = {unit = "kPa", range = [50, 100]}}
"""


def test_one_command_from_a_scene_file_and_data_to_a_verdict(tmp_path, capsys):
    """Nobody trained anything, and the truth is at three times the end of a range."""
    em.write_mesh(tmp_path / "own.vtu", em.generators.box((100.0, 10.0, 10.0), (8, 2, 2)))
    (tmp_path / "liver.toml").write_text(OWN)  # called like a shipped emulator
    words = ["--truth", "mu=300", "lam=60", "--observe", "nodes:9", "--noise", "1"]
    run = ["infer", str(tmp_path / "liver.toml"), *words, "--draws", "500"]
    assert main([*run, "--out", str(tmp_path / "r"), "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["verdict"] == "accepted"
    assert result["rounds"][-1]["missed"] < 0.1
    mu = result["parameters"]["mu"]
    assert abs(mu["mean"] - 300.0) < 3.0 * mu["sd"] < 90.0
    assert mu["of_prior"] < 0.2


SHORT = OWN.replace("order = 2\n", "")
TIP = np.array([[35.0, 5.0, 5.0], [24.0, 5.0, 5.0]])


@pytest.mark.slow
def test_data_that_refuse_a_coarse_mesh_are_accepted_on_the_finer_one(tmp_path, capsys):
    """Linear elements lock; the remedy that the verdict names is one word more."""
    em.write_mesh(tmp_path / "own.vtu", em.generators.box((40.0, 10.0, 10.0), (4, 1, 2)))
    (tmp_path / "own.toml").write_text(SHORT)
    finer = em.find_scene(f"finer:{tmp_path / 'own.toml'}")
    observe = cal.landmarks(finer, TIP)
    truth = finer.theta(mu=75.0, lam=70.0)
    u = em.Simulator(finer)(truth)[observe.nodes]
    tip = np.asarray(observe(u, truth)) + 0.2 * np.random.default_rng(0).normal(size=(2, 3))
    rows = [",".join(f"{value:.6f}" for value in row) for row in np.hstack([TIP, tip])]
    (tmp_path / "tip.csv").write_text("\n".join(["x,y,z,ux,uy,uz", *rows]))
    words = ["--data", str(tmp_path / "tip.csv"), "--noise", "0.2", "--known", "lam=70"]

    def told(scene):
        folder = tmp_path / ("fine" if scene.startswith("finer:") else "coarse")
        main(["infer", scene, *words, "--draws", "500", "--out", str(folder), "--json"])
        return json.loads(capsys.readouterr().out)

    coarse = told(str(tmp_path / "own.toml"))
    assert coarse["verdict"] == "not certified"
    (said,) = [f for f in coarse["certificate"]["findings"] if "on a finer mesh" in f]
    assert "infer on the finer mesh (calibrate infer finer:SCENE)" in said
    fine = told(f"finer:{tmp_path / 'own.toml'}")
    assert fine["verdict"] == "accepted"
    assert fine["forward"] == coarse["forward"] == "rounds"
    mu, locked = (result["parameters"]["mu"] for result in (fine, coarse))
    assert abs(mu["mean"] - 75.0) < 3.0 * mu["sd"] < 45.0
    assert abs(locked["mean"] - 75.0) > 3.0 * locked["sd"]


def test_the_finer_mesh_of_a_built_in_body_is_inferred_on_and_read_again(tmp_path):
    run = replace(RUN, scene=f"finer:{BEAM}", forward="emulator", forward_options={})
    posterior = infer(run, tmp_path / "r", check_map=False)
    again, read = read_posterior(tmp_path / "r")
    assert again.forward == "rounds"
    assert read.model.forward.scene.mesh.order == 2
    for name, value in TRUTH.items():
        row = posterior.summary()[name]
        assert abs(row["mean"] - value) < 3.0 * row["sd"], name


STATED = OWN.replace(
    'mu = {unit = "kPa", range = [50, 100]}',
    'mu = {unit = "kPa", median = 200, log_sd = 0.5, source = "a book"}',
)


@pytest.fixture
def stated(tmp_path):
    """A scene file that states the prior of mu, and has a range of lam."""
    assert STATED != OWN
    em.write_mesh(tmp_path / "own.vtu", em.generators.box((100.0, 10.0, 10.0), (4, 1, 1)))
    (tmp_path / "own.toml").write_text(STATED)
    return replace(RUN, scene=str(tmp_path / "own.toml"), forward="emulator")


def test_rounds_have_the_prior_that_a_scene_states(stated):
    problem = by_rounds(read_problem(stated))
    assert problem.run.forward == "rounds"
    prior = problem.run.prior
    assert prior["median"] == pytest.approx({"mu": 200.0, "lam": 75.0})
    assert (prior["log_sd"]["mu"], prior["source"]["mu"]) == (0.5, "a book")
    assert "the scene's range" in prior["source"]["lam"]
    mu, lam = problem.scene.parameters
    sides = 3.72 * np.array([-0.5, 0.5])
    np.testing.assert_allclose([mu.low, mu.high], 200.0 * np.exp(sides))
    distribution = prior_of(prior, problem.scene)["mu"]
    x = np.array([80.0, 200.0, 500.0])
    exact = norm.logpdf(np.log(x), np.log(200.0), 0.5) - np.log(x)
    np.testing.assert_allclose(distribution.log_prob(x), exact, atol=3e-4)  # cut at 3.72 sd
    assert lam.high > 75.0 * np.exp(3.7 * np.log(2.0))
    again = read_problem(problem.run)  # as from run.json
    assert again.run.prior == prior
    assert again.scene.fingerprint == problem.scene.fingerprint


def test_a_run_overrules_a_scene_and_known_parameters_have_no_prior(stated):
    own = asdict(Population({"mu": 100.0}, {"mu": 0.2}, source="ours"))
    prior = by_rounds(read_problem(replace(stated, prior=own))).run.prior
    assert (prior["median"]["mu"], prior["source"]["mu"]) == (100.0, "ours")
    known = replace(stated, known={"mu": 190.0}, truth={"lam": 33.0})
    assert set(by_rounds(read_problem(known)).run.prior["median"]) == {"lam"}
    with pytest.raises(InputError, match="'mu' is known and has a prior"):
        by_rounds(read_problem(replace(known, prior=own)))
    with pytest.raises(InputError, match="bounded: scene 'own' has a prior of 'mu'"):
        read_problem(replace(stated, bounded=("mu",)))


def test_fem_has_the_prior_that_a_scene_states_and_an_emulator_a_part_of_it(stated):
    by_fem = read_problem(replace(stated, forward="fem"))
    assert set(by_fem.run.prior["median"]) == {"mu"}  # and lam its range
    assert by_fem.scene.parameters[0].high == pytest.approx(200.0 * np.exp(3.72 * 0.5))
    assert by_fem.scene.parameters[1] == em.find_scene(stated.scene).parameters[1]
    problem = read_problem(stated)
    assert problem.run.prior == "box"
    x = np.array([200.0 * np.exp(-0.51), 200.0, 250.0])
    exact = norm.logpdf(np.log(x), np.log(200.0), 0.5) - np.log(x) - np.log(norm.cdf([1]) * 2 - 1)
    exact[0] = -np.inf  # beyond the training
    np.testing.assert_allclose(cal.priors.box_prior(problem.scene)["mu"].log_prob(x), exact)


def test_the_table_of_results_says_where_priors_are_from(stated, tmp_path, capsys):
    words = ["--truth", "mu=190", "lam=60", "--observe", "nodes:9", "--noise", "0.2"]
    run = ["infer", stated.scene, *words, "--draws", "200", "--no-certify"]
    main([*run, "--out", str(tmp_path / "r")])
    printed = capsys.readouterr().out
    assert "prior median of mu 200 (log sd 0.5): a book" in printed
    assert "prior median of lam 75 (log sd 0.69): the scene's range" in printed
    kept = json.loads((tmp_path / "r" / "run.json").read_text())["prior"]
    assert kept["source"]["mu"] == "a book"
    run, posterior = read_posterior(tmp_path / "r")
    page = html_of(run, posterior, None, fem=False)
    assert "prior median of mu 200 (log sd 0.5): a book" in page
    assert "log-normal, median 200, log sd 0.5" in page
    draws = {n: np.asarray(posterior.tree["posterior"][n]) for n in ("mu", "lam")}
    figure = traces(dict.fromkeys(draws, "label"), draws, posterior.model.sampled_priors)
    line = next(trace for trace in figure.data if trace.name == "prior")
    exact = norm.pdf(np.log(line.x), np.log(200.0), 0.5) / line.x
    np.testing.assert_allclose(line.y, exact, rtol=1e-3)
