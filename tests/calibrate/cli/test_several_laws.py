"""Files of several laws by one ``init``, and their posteriors by one ``infer``."""

import json

import numpy as np
import pytest

from calibrate.cli import main
from emulator.core.errors import InputError
from emulator.mechanics.laws import LAWS
from emulator.scenes.file import read_scene
from emulator.scenes.tissue_priors import LAWS_OF_TISSUES, OF_LAWS, laws_named

STRETCHES = 1.0 + 0.05 * np.arange(1, 9)


@pytest.fixture
def table(tmp_path, monkeypatch):
    """A pull of a Mooney-Rivlin solid, with errors of 1 %."""
    monkeypatch.chdir(tmp_path)
    x = STRETCHES
    cauchy = 2.0 * (x**2 - 1.0 / x) * (15.0 + 10.0 / x) * (1.0 + 0.01 * np.sin(9.0 * x))
    rows = [f"{a:.4f},{b:.4f}" for a, b in zip(x, cauchy, strict=True)]
    (tmp_path / "pull.csv").write_text("\n".join(["stretch_x [-],cauchy_x [kPa]", *rows]))
    return tmp_path


def test_every_tissue_has_laws_that_exist():
    for tissue, laws in LAWS_OF_TISSUES.items():
        assert set(laws) <= LAWS.keys(), tissue
        assert laws_named([tissue]) == laws
    assert laws_named(["yeoh", "rubber"]) == ("yeoh", "mooney_rivlin", "ogden_1")
    with pytest.raises(InputError, match="law or tissue 'rubbr' is unknown; .*'rubber'"):
        laws_named(["rubbr"])


def test_files_of_each_law_and_a_posterior_of_each(table, capsys):
    assert main(["init", "pull.csv", "--law", "mooney_rivlin", "yeoh", "--json"]) == 0
    written = json.loads(capsys.readouterr().out)
    files = [row["out"] for row in written["laws"].values()]
    assert files == ["pull_mooney_rivlin.toml", "pull_yeoh.toml"]
    assert written["left_out"] == {}
    words = ["infer", *files, "--out", "runs", "--sampler", "laplace", "--no-certify", "--json"]
    assert main(words) == 0
    result = json.loads(capsys.readouterr().out)
    assert set(result["runs"]) == {"pull_mooney_rivlin", "pull_yeoh"}
    models = {model["name"]: model for model in result["comparison"]["models"]}
    assert set(models) == {"runs/pull_mooney_rivlin", "runs/pull_yeoh"}
    assert sum(model["weight"] for model in models.values()) == pytest.approx(1.0)
    assert main(["compare", *models]) == 0
    assert result["comparison"]["verdict"] in capsys.readouterr().out


def test_a_tissue_brings_the_exponents_of_published_hearts(table):
    """Its moduli still follow from the table; a law that is named alone has guesses for both."""
    assert main(["init", "pull.csv", "--law", "myocardium"]) == 0
    assert main(["init", "pull.csv", "--law", "guccione", "--out", "alone.toml"]) == 0
    scenes = [read_scene(table / f"{name}_scene.toml") for name in ("pull_guccione", "alone")]
    for name, published in OF_LAWS["guccione"].items():
        prior, guess = ({p.name: p.prior for p in scene.parameters}[name] for scene in scenes)
        if name == "C":
            assert prior == guess
        else:
            assert prior == published
            assert prior.source == published.source
            assert guess.log_sd > 2.0 * published.log_sd


def test_a_law_that_does_not_suit_is_left_out_and_named(table, capsys):
    (table / "pull_yeoh.toml").write_text("")
    assert main(["init", "pull.csv", "--law", "rubber"]) == 0
    text = capsys.readouterr().out
    assert "law yeoh is left out: pull_yeoh.toml is there already" in text
    assert "calibrate infer pull_mooney_rivlin.toml pull_ogden_1.toml --out RUNS" in text
    assert main(["init", "pull.csv", "--law", "yeoh", "mooney_rivlin"]) == 2
    assert "is there already" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("a.toml", "b/a.toml"), "two scenes have one name"),
        (("once_clamped_beam", "twice_clamped_beam"), "need data that were measured"),
        (("a.toml", "b.toml"), "a and b were given different data of 'stress'"),
    ],
)
def test_scenes_that_cannot_be_compared(table, capsys, words, message):
    """They are refused before anything is sampled."""
    for name in "ab":
        assert main(["init", "pull.csv", "--law", "yeoh", "--out", f"{name}.toml"]) == 0
        head, *rows = (table / "pull.csv").read_text().splitlines()
        (table / "pull.csv").write_text("\n".join([head, *rows[:-1]]))
        text = (table / f"{name}.toml").read_text()
        (table / f"{name}.csv").write_text("\n".join([head, *rows]))
        (table / f"{name}.toml").write_text(text.replace("pull.csv", f"{name}.csv"))
        scene = table / f"{name}_scene.toml"
        scene.write_text(scene.read_text().replace("pull.csv", f"{name}.csv"))
    capsys.readouterr()
    assert main(["infer", *words, "--out", "runs"]) == 2
    assert message in capsys.readouterr().err
    assert not list(table.glob("runs/*"))
