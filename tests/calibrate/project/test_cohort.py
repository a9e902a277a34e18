"""Many subjects from a table or a folder: each by itself, those that fail named, and all together."""

import json
import shutil

import numpy as np
import pytest

from calibrate.cli import main
from calibrate.project import read_posterior
from calibrate.project.cohort import read_cohort
from calibrate.project.members import read_members
from cli_support import answer, complaint
from emulator.catalogue import find_problem
from emulator.core.errors import InputError

STRETCHES = np.linspace(1.02, 1.3, 8)
FEW = ("--law", "neo_hookean", "--draws", 200, "--no-certify")


def write_tables(folder):
    """Tables of three subjects, one without data, and the cohort's table."""
    rng = np.random.default_rng(0)
    for name, mu in (("a", 4.0), ("b", 6.0), ("c", 5.0)):
        stress = mu * (STRETCHES - STRETCHES**-2) + 0.05 * rng.normal(size=8)
        rows = [f"{x:.4f},{y:.5f}" for x, y in zip(STRETCHES, stress, strict=True)]
        (folder / f"{name}.csv").write_text("\n".join(["stretch_x,stress_x", *rows]))
    (folder / "d.csv").write_text("stretch_x,stress_x\n1.1,\n1.2,\n")
    rows = ["subject,data,noise:stress,group,known:lam"]
    rows += [f"{name},{name}.csv,0.05,{'ab'[k % 2]},100" for k, name in enumerate("abcd")]
    (folder / "subjects.csv").write_text("\n".join(rows))
    return folder / "subjects.csv"


@pytest.fixture(scope="module")
def cohort(tmp_path_factory):
    """The folder of a cohort's results, beside its table."""
    folder = tmp_path_factory.mktemp("subjects")
    words = ["cohort", write_tables(folder), *FEW, "--engine", "processes:2"]
    assert main([*map(str, words), "--out", str(folder / "out"), "--json"]) == 1
    return folder / "out"


def test_each_subject_has_a_posterior_and_the_one_that_fails_is_named(cohort):
    plan, population = read_members(cohort)
    assert population.members == ("a", "b", "c")
    assert plan.groups == {"a": "a", "b": "b", "c": "a", "d": "b"}
    failed = json.loads((cohort / "run.json").read_text())["failed"]
    assert list(failed) == ["d"]
    assert "every value of stress is missing" in failed["d"]
    alone = {name: row.alone_mean for name, row in population.shrinkage()["mu"].items()}
    assert alone == pytest.approx({"a": 4.0, "b": 6.0, "c": 5.0}, rel=0.05)


def test_priors_that_follow_from_the_data_are_one_for_all(cohort):
    plan, _ = read_members(cohort)
    medians = [run.prior["median"] for run in plan.members.values()]
    assert medians[0] == medians[1] == medians[2]
    assert 1.0 < medians[0]["mu"] < 7.0  # of slopes at rest, of three subjects


def test_the_prior_of_all_has_the_moments_of_all_subjects_priors(cohort):
    plan, _ = read_members(cohort)
    common = next(iter(plan.members.values())).prior
    rng, logs = np.random.default_rng(0), []
    for name in "abc":
        scene = find_problem(str(cohort / "drafts" / f"{name}_scene.toml"))
        prior = next(p.prior for p in scene.parameters if p.name == "mu")
        logs.append(np.log(prior.median) + prior.log_sd * rng.normal(size=100_000))
    assert np.log(common["median"]["mu"]) == pytest.approx(np.mean(logs), abs=0.01)
    assert common["log_sd"]["mu"] == pytest.approx(np.std(logs), rel=0.01)


def test_the_same_command_goes_on_where_it_stopped(cohort, capsys):
    (cohort / "posterior.nc").unlink()
    by_process = read_posterior(cohort / "members" / "b")[1].draws()["mu"]
    shutil.rmtree(cohort / "members" / "b")
    before = (cohort / "members" / "a" / "posterior.nc").stat().st_mtime_ns
    code, told = answer(capsys, "cohort", cohort.parent / "subjects.csv", *FEW, "--out", cohort)
    assert code == 1  # of d
    assert list(told["failed"]) == ["d"]
    assert list(told["members"]) == ["a", "b", "c"]
    here = read_posterior(cohort / "members" / "b")[1].draws()["mu"]
    assert np.allclose(here, by_process, rtol=1e-12)
    assert (cohort / "members" / "a" / "posterior.nc").stat().st_mtime_ns == before


def test_a_cohort_has_a_page(cohort):
    assert main(["report", str(cohort)]) == 0
    page = (cohort / "report.html").read_text()
    assert "Population of 3 members" in page
    assert "every value of stress is missing" in page


def test_a_folder_has_a_folder_for_each_subject(tmp_path):
    write_tables(tmp_path)
    for name in "ab":
        (tmp_path / "cohort" / name).mkdir(parents=True)
        shutil.copy(tmp_path / f"{name}.csv", tmp_path / "cohort" / name / "test.csv")
    (tmp_path / "cohort" / "empty").mkdir()
    plan = read_cohort(tmp_path / "cohort", tmp_path / "out", "neo_hookean")
    assert list(plan.members) == ["a", "b"]
    assert "0 tables and no experiment.toml" in plan.unread["empty"]


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("name,data\na,a.csv", "there is no column 'subject'"),
        ("subject,data,age\na,a.csv,3", "column 'age' is unknown"),
        ("subject,data\na,a.csv\na,b.csv", "row 2, subject 'a' is there twice"),
        ("subject,data\n,a.csv", "row 1, subject '' is empty"),
        ("subject,data\na,a.csv\nb,none.csv", "1 subject can be read; b: "),
        ("subject,known:mu\na,1\nb,x", "0 subject can be read; a: give a scene, a mesh"),
    ],
)
def test_mistakes_of_a_table_are_named(tmp_path, capsys, text, what):
    write_tables(tmp_path)
    (tmp_path / "subjects.csv").write_text(text)
    line = complaint(capsys, "cohort", tmp_path / "subjects.csv", *FEW, "--out", tmp_path / "out")
    assert what in line


def test_fewer_than_two_subjects_are_no_population(tmp_path):
    write_tables(tmp_path)
    (tmp_path / "subjects.csv").write_text("subject,data\na,a.csv")
    with pytest.raises(InputError, match="one is no population"):
        read_cohort(tmp_path / "subjects.csv", tmp_path / "out", "neo_hookean")
