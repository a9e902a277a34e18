"""Members of a population from an experiment file: kept, resumed, certified one by one."""

import json

import numpy as np
import pytest

import calibrate as cal
import emulator as em
from calibrate.cli import main
from calibrate.data import write_data
from calibrate.posterior import read_tree
from cli_support import complaint
from emulator.scenes import registry

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
        patch.setitem(registry.BUILT_IN, BEAM, lambda **_: SCENE)
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

        patch.setattr("calibrate.workflow.cohort.sample_hierarchy", killed)
        with pytest.raises(Killed):
            infer(folder)
    members = {name: folder / "r" / "members" / name / "posterior.nc" for name in TRUTHS}
    before = {name: path.stat().st_mtime_ns for name, path in members.items()}
    assert not (folder / "r" / "posterior.nc").exists()
    assert infer(folder) == 0
    assert before == {name: path.stat().st_mtime_ns for name, path in members.items()}
    return folder / "r"


def test_the_population_and_its_members_are_kept(result):
    found = cal.read_hierarchy(result / "posterior.nc")
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
    assert main(["certify", member, "--draws", "25", "--no-mesh", "--json"]) in (0, 1)
    capsys.readouterr()
    for words in (["certify"], ["report"], ["identify", "after"]):
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
