"""``calibrate check`` and ``calibrate identify``, on the shipped beam."""

import json

import pytest

from calibrate.cli import main
from cli_support import answer

BEAM = ["once_clamped_beam", "--observe", "nodes:8", "--noise", "0.2"]


def test_what_the_prior_predicts(tmp_path, capsys):
    assert main(["check", "prior", *BEAM, "--out", str(tmp_path), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["displacement"]
    assert found["5 %"] < found["50 %"] < found["95 %"]
    assert (tmp_path / "prior_predictive.png").read_bytes()[:4] == b"\x89PNG"
    assert (tmp_path / "prior_predictive.safetensors").is_file()


@pytest.mark.slow
def test_what_data_would_determine(capsys):
    """The beam bends by mu and hardly by lam, which its prior knows as well as the data does."""
    assert main(["identify", "before", *BEAM, "--json"]) == 0
    sd = json.loads(capsys.readouterr().out)["sd"]
    assert sd["mu"] < 0.2 < 0.5 < sd["lam"] < 1.0
    assert main(["identify", "before", *BEAM]) == 0
    assert "known best: mu" in capsys.readouterr().out
    # Of noise that is inferred, as init writes it, the median of its prior is taken.
    code, scaled = answer(capsys, "identify", "before", *BEAM[:-2], "--noise-scale", 0.3)
    assert code == 0
    code, fixed = answer(capsys, "identify", "before", *BEAM[:-2], "--noise", 0.6745 * 0.3)
    assert scaled == fixed


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ["check", "sbc", *BEAM, "--replicates", "3"],
            "calibration: 3 replicates; give 20 or more",
        ),
        (["check", "prior", "nowhere"], "scene 'nowhere'"),
        (["check", "sbc", *BEAM, "--true-noise", "volume=1"], "'volume' is not observed"),
        (["identify", "after", "nowhere"], "nowhere"),
    ],
)
def test_bad_words(tmp_path, capsys, words, message):
    out = ["--out", str(tmp_path / "r")] if words[0] == "check" else []
    assert main([*words, *out]) == 2
    said = capsys.readouterr().err
    assert message in said
    assert said.count("\n") == 1


@pytest.mark.slow
def test_the_beam_is_calibrated_and_a_wrong_noise_is_not(tmp_path, capsys):
    # One of 20 seeds leaves a band of 95 % by chance; 0 does, by one data set of 60.
    short = ["--replicates", "60", "--warmup", "150", "--draws", "150", "--seed", "2", "--json"]
    assert main(["check", "sbc", *BEAM, *short, "--out", str(tmp_path / "right")]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["passed"]
    assert (tmp_path / "right" / "calibration.png").is_file()
    wrong = [*BEAM, "--true-noise", "0.4", *short, "--out", str(tmp_path / "wrong")]
    assert main(["check", "sbc", *wrong]) == 1


@pytest.mark.slow
def test_after_a_posterior_it_says_what_to_measure_next(tmp_path, capsys):
    run = ["infer", *BEAM, "--truth", "mu=73", "lam=61", "--draws", "300", "--warmup", "200"]
    assert main([*run, "--chains", "2", "--no-certify", "--out", str(tmp_path)]) == 0
    capsys.readouterr()
    words = ["identify", "after", str(tmp_path), "--next", "nodes:20", "nodes:2", "--json"]
    assert main([*words, "--profile", "mu"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert list(found["next"]) == ["nodes:20", "nodes:2"]
    assert found["profile mu"][0] < 73.0 < found["profile mu"][1]
