"""Members of a population from an experiment file: kept, resumed, certified one by one."""

import json
import re
import shutil

import numpy as np
import pytest

import calibrate as cal
import emulator as em
from calibrate.cli import main
from calibrate.figures.shrinkage import figure_of
from calibrate.measurements.data import write_data
from calibrate.posterior import read_tree
from calibrate.project import holds_population
from calibrate.project.members import read_members
from cli_support import answer, complaint
from emulator.scenes.built_in import BUILT_IN

BEAM = "once_clamped_beam"
SCENE = em.scenes.once_clamped_beam(cells=(4, 1, 1), order=1)
TRUTHS = {"soft": 62.0, "stiff": 81.0}
FILE = """scene = "once_clamped_beam"
forward = "reduced"
forward_options = {fem_runs = 8}
sampler = "laplace"
draws = 50
warmup = 100
chains = 2
noise = {displacement = 0.3}
known = {lam = 70.0}
"""


@pytest.fixture(scope="module", autouse=True)
def coarse():
    """A coarse beam under the built-in one's name."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(BUILT_IN, BEAM, lambda **_: SCENE)
        yield


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """An experiment file of two beams, and their data."""
    made, simulator = tmp_path_factory.mktemp("cohort"), em.Simulator(SCENE)
    observe = cal.nodal_displacements(SCENE, [3, 7, 11, 19])
    text = FILE
    for k, (name, mu) in enumerate(TRUTHS.items()):
        noise = 0.3 * np.random.default_rng(k).normal(size=(4, 3))
        theta = SCENE.theta(mu=mu, lam=70.0)
        write_data(made / f"{name}.csv", observe, simulator(theta)[observe.nodes] + noise)
        text += f'[members.{name}]\ndata = "{name}.csv"\n'
    (made / "beams.toml").write_text(text + "[population]\nspread = {mu = 0.2}\n")
    return made


SHORT = """
mesh = "short.vtu"
law = "neo_hookean"
loads = [{kind = "gravity"}]
supports = [{node_set = "left"}]
parameters = {mu = {unit = "kPa", range = [20, 200]}}
constants = {lam = 70}
"""


class Killed(Exception):
    """Stands for the end of a process."""


def infer(folder, *more):
    words = [str(folder / "beams.toml"), "--out", str(folder / "r"), "--no-certify", "--json"]
    return main(["infer", *words, *more])


@pytest.fixture(scope="module")
def result(folder, tmp_path_factory):
    """The folder of a cohort that was killed between its members and all of them together."""
    with pytest.MonkeyPatch.context() as patch:

        def killed(*_, **__):
            raise Killed

        patch.setattr("calibrate.project.members.sample_population", killed)
        with pytest.raises(Killed):
            infer(folder)
    members = {name: folder / "r" / "members" / name / "posterior.nc" for name in TRUTHS}
    before = {name: path.stat().st_mtime_ns for name, path in members.items()}
    assert not (folder / "r" / "posterior.nc").exists()
    assert infer(folder) == 0
    assert before == {name: path.stat().st_mtime_ns for name, path in members.items()}
    return folder / "r"


def test_the_population_and_its_members_are_kept(result):
    found = cal.population.read_hierarchy(result / "posterior.nc")
    assert found.shared == ("mu",)
    assert found.members == tuple(TRUTHS)
    for name, mu in TRUTHS.items():
        alone = found.shrinkage()["mu"][name]
        assert abs(alone.alone_mean - mu) < 4.0 * alone.alone_sd
    assert (result / "shrinkage.png").stat().st_size > 0
    # Members that differ in their data alone share one program.
    trees = [read_tree(result / "members" / name / "posterior.nc") for name in TRUTHS]
    assert trees[0].attrs["forward_fingerprint"] == trees[1].attrs["forward_fingerprint"]
    kept = json.loads((result / "run.json").read_text())
    assert list(kept["members"]) == list(TRUTHS)
    assert kept["population"]["spread"] == {"mu": 0.2}


def test_a_member_is_a_run_like_any_other_and_the_population_is_none(result, capsys):
    member = str(result / "members" / "soft")
    (result / "report.html").write_text("tells an earlier verdict")
    assert main(["certify", member, "--draws", "25", "--no-mesh", "--json"]) in (0, 1)
    assert not (result / "report.html").exists()
    capsys.readouterr()
    for words in (["certify"], ["identify", "after"]):
        said = complaint(capsys, *words, str(result))
        assert "holds a population; name one of its members, " in said
        assert said.endswith("members/NAME")


def test_results_are_not_replaced_and_members_not_mixed(result, folder, capsys):
    words = ["infer", str(folder / "beams.toml"), "--out", str(result), "--no-certify"]
    assert "has results of an earlier run (posterior.nc); replace them" in complaint(capsys, *words)
    hidden = (result / "posterior.nc").rename(result / "hidden.nc")
    try:
        said = complaint(capsys, *words, "--seed", "5")
        assert "members/soft is of another run or other data than" in said
        text = (folder / "soft.csv").read_text()
        (folder / "soft.csv").write_text(text.replace("\n3,", "\n2,"))
        assert "members/soft is of another run or other data" in complaint(capsys, *words)
        (folder / "soft.csv").write_text(text)
    finally:
        hidden.rename(result / "posterior.nc")


def test_a_cohort_is_restored(result):
    assert holds_population(result)
    assert not holds_population(result / "members" / "soft")
    cohort, found = read_members(result)
    kept = json.loads((result / "run.json").read_text())
    assert {name: run.data for name, run in cohort.members.items()} == {
        name: kept["members"][name]["data"] for name in TRUTHS
    }
    assert cohort.population.spread == {"mu": 0.2}
    assert found.tree["posterior"]["mu"].attrs["scale"] == "log"


@pytest.fixture
def copy(result, tmp_path):
    """A copy of the cohort's folder, without certificates."""
    made = tmp_path / "cohort"
    shutil.copytree(result, made)
    for path in made.glob("members/*/certificate.json"):
        path.unlink()
    return made


def test_the_page_of_a_population(copy, capsys):
    """Numbers by hand from the draws; links only to pages that are there."""
    (copy / "members" / "soft" / "report.html").write_text("a page")
    certificate = copy / "members" / "soft" / "certificate.json"
    certificate.write_text('{"verdict": "accepted"}')
    code, told = answer(capsys, "report", copy)
    assert code == 0
    assert told == {"out": str(copy / "report.html")}
    page = (copy / "report.html").read_text(encoding="utf-8")
    body = page[page.index("</head>") :]
    order = [
        "1 of 2 members accepted",
        "not certified: stiff",
        "The population",
        "Members beside the population",
        "A member not seen",
        "How sampling went",
        "how to repeat it",
    ]
    places = [body.index(word) for word in order]
    assert places == sorted(places)
    _, found = read_members(copy)
    for warning in found.warnings():
        assert warning in body
    for name, label in (("median", "median of mu (kPa)"), ("sd", "spread of ln mu")):
        low, high = np.quantile(found.tree["posterior"][name], [0.05, 0.95])
        numbers = body[body.index(f"<td>{label}</td>") :].split("</tr>")[0]
        assert f"<td>{low:.4g}</td><td>{high:.4g}</td>" in numbers
    low, middle, high = np.quantile(found.new_member()["mu"], [0.05, 0.5, 0.95])
    assert f"<td>mu (kPa)</td><td>{middle:.4g} ({low:.4g} to {high:.4g})</td>" in body
    tree = read_tree(copy / "members" / "stiff" / "posterior.nc")
    replicates = np.asarray(tree["posterior_predictive"]["displacement"]).reshape(-1, 4, 3)
    ends = np.quantile(replicates, [0.05, 0.95], axis=0)
    measured = np.asarray(tree["observed_data"]["displacement"])
    share = 100.0 * np.mean((measured >= ends[0]) & (measured <= ends[1]))
    assert f"<td>stiff</td><td>not certified</td><td>{share:.0f} % of 12</td><td></td>" in body
    assert re.findall('<a href="([^"]*)"', body) == ["members/soft/report.html"]
    assert "infer_members(members, " in body
    assert str(copy) not in body


def test_the_page_elsewhere_links_back(copy, tmp_path):
    (copy / "members" / "stiff" / "report.html").write_text("a page")
    (tmp_path / "pages").mkdir()
    for name in TRUTHS:
        (copy / "members" / name / "certificate.json").write_text('{"verdict": "accepted"}')
    assert main(["report", str(copy), "--out", str(tmp_path / "pages" / "all.html")]) == 0
    body = (tmp_path / "pages" / "all.html").read_text(encoding="utf-8")
    assert 'href="../cohort/members/stiff/report.html"' in body
    assert "all members: accepted" in body
    assert not (copy / "report.html").exists()


def test_the_chart_shows_members_and_one_not_seen(result):
    _, found = read_members(result)
    axes = figure_of(found).axes[0]
    low, median, high = np.quantile(found.new_member()["mu"], [0.05, 0.5, 0.95])
    (band,), (middle, *dots) = axes.patches, axes.lines
    np.testing.assert_allclose([band.get_x(), band.get_x() + band.get_width()], [low, high])
    np.testing.assert_allclose(middle.get_xdata(), median)
    draws = np.stack([found.member(name)["mu"] for name in TRUTHS])
    low, median, high = np.quantile(draws, [0.05, 0.5, 0.95], axis=1)
    alone, together = (lines.get_segments() for lines in axes.collections)
    np.testing.assert_allclose([ends[:, 0] for ends in together], np.stack([low, high], axis=1))
    np.testing.assert_allclose(dots[1].get_xdata(), median)
    assert all(a[0, 1] < b[0, 1] for a, b in zip(alone, together, strict=True))


def test_a_member_not_seen_predicts_another_body(result, tmp_path, capsys):
    """A shorter beam of the population's tissue, under its own weight."""
    em.write_mesh(tmp_path / "short.vtu", em.generators.box((40.0, 10.0, 10.0), (4, 1, 1)))
    (tmp_path / "short.toml").write_text(SHORT)
    words = ["--scene", str(tmp_path / "short.toml"), "--observe", "nodes:4", "--draws", "60"]
    assert main(["predict", str(result), *words, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["sources"] == {"mu": "the posterior"}
    assert told["missed_sd"] < 0.05
    new = cal.population.read_hierarchy(result / "posterior.nc").new_member()["mu"]
    tip = max(told["numbers"].values(), key=lambda row: abs(row["mean"]))
    # A tip's deflection goes as one over the stiffness.
    assert tip["sd"] / abs(tip["mean"]) == pytest.approx(np.std(1.0 / new) * new.mean(), rel=0.4)


def test_members_are_not_one_run(folder):
    with pytest.raises(em.InputError, match="infer: Members is not one run; calibrate infer FILE"):
        cal.infer(cal.read_experiment(folder / "beams.toml"))


def test_folders_without_results_get_one_line(copy, tmp_path, capsys):
    said = complaint(capsys, "report", tmp_path / "none")
    assert "none/run.json does not exist: there is no such folder; give a folder that" in said
    assert "is a file; give a folder" in complaint(capsys, "report", copy / "posterior.nc")
    said = complaint(capsys, "report", copy / "members")
    assert "the folder holds soft, stiff; give a folder" in said
    (tmp_path / "empty").mkdir()
    assert "the folder holds nothing; give" in complaint(capsys, "report", tmp_path / "empty")
    run = copy / "run.json"
    kept = json.loads(run.read_text())
    renamed = {"first": kept["members"]["soft"], "stiff": kept["members"]["stiff"]}
    run.write_text(json.dumps(kept | {"members": renamed}))
    said = complaint(capsys, "report", copy)
    assert "is of members soft, stiff, but run.json names first, stiff; infer again" in said
    run.write_text(json.dumps(kept))
    shutil.copy(copy / "members" / "soft" / "posterior.nc", copy / "posterior.nc")
    assert "holds no hierarchy" in complaint(capsys, "report", copy)
    (copy / "posterior.nc").unlink()
    (copy / "members" / "stiff" / "posterior.nc").unlink()
    said = complaint(capsys, "report", copy)
    assert "without posterior.nc: 1 of its 2 members are sampled; repeat calibrate infer" in said
    run.write_text("3")
    assert "run.json" in complaint(capsys, "report", copy)
    assert not (copy / "report.html").exists()
