"""Samplers by command line: their options, and going on after a kill."""

import json

import numpy as np
import pytest

from calibrate.cli import main
from calibrate.cli.run_words import sampler_options
from calibrate.posterior import read_tree
from calibrate.project.results import SAMPLING
from emulator.core.checkpoint import Checkpoint


class Killed(Exception):
    pass


def words(folder, *more):
    return [
        "infer", "once_clamped_beam", "--truth", "mu=73", "lam=61", "--sampler", "nuts",
        "--sampler-options", "rounds=1", "--warmup", "50", "--draws", "60", "--chains", "2",
        "--no-certify", "--out", str(folder), "--json", *more,
    ]  # fmt: skip


@pytest.mark.slow
def test_a_killed_run_goes_on(capsys, monkeypatch, tmp_path):
    killed, whole = tmp_path / "killed", tmp_path / "whole"
    keep = Checkpoint.keep

    def kept(self, state):
        self.every = 0.0
        keep(self, state)
        if self.path is not None and state().draws.z.shape[1] == 50:
            raise Killed

    with monkeypatch.context() as patch:
        patch.setattr(Checkpoint, "keep", kept)
        with pytest.raises(Killed):
            main(words(killed))
    assert [path.name for path in killed.iterdir()] == [SAMPLING]
    capsys.readouterr()
    # Another run does not take it for its own, nor overwrite it.
    assert main(words(killed, "--seed", "4")) == 2
    assert "belongs to another run: its seed is 0, not 4" in capsys.readouterr().err
    assert main(words(killed)) == main(words(whole)) == 0
    lines = capsys.readouterr().out
    result = json.loads(lines[lines.index("}\n{") + 2 :])
    assert result["verdict"] == "not certified"
    assert any("effective draws" in sentence for sentence in result["warnings"])
    assert not (killed / SAMPLING).exists()
    first, second = (read_tree(folder / "posterior.nc")["posterior"] for folder in (killed, whole))
    for name in ("mu", "lam"):
        np.testing.assert_array_equal(first[name], second[name])


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["leapfrogs=3"], "sampler 'auto': unknown key 'leapfrogs'; known: chains, draws"),
        (["rounds=2.5"], "sampler 'auto': rounds = 2.5; expected a whole number"),
        (["target_accept"], "--sampler-options: 'target_accept' is not NAME=VALUE"),
        (["target_accept=2"], "auto: target_accept is 2; give one in (0, 1)"),
    ],
)
def test_options_that_cannot_be(words, message, capsys, tmp_path):
    call = ["infer", "once_clamped_beam", "--truth", "mu=73", "lam=61", "--out", str(tmp_path)]
    assert main([*call, "--sampler-options", *words]) == 2
    assert message in capsys.readouterr().err


def test_options_reach_the_sampler():
    words = ["target_accept=0.95", "rounds=2"]
    assert sampler_options(words) == {"target_accept": 0.95, "rounds": 2}
