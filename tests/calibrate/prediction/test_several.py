"""Several laws of one tissue: their weights, their mixture, and bodies of another law."""

import json
from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

import calibrate as cal
import emulator as em
from calibrate.cli import main
from calibrate.prediction import Weights, made_of, mixture, weights_of
from calibrate.prediction.predict import Predicted
from emulator.core.errors import InputError


def predicted_of(law, value, count=100):
    """Draws of a number that is ``value``."""
    scene = em.scenes.once_clamped_beam(cells=(2, 1, 1), order=1)
    observe = cal.Observations({"volume": cal.length_between(scene, "0,0,0", "100,0,0")})
    numbers = {"volume": np.full(count, float(value))}
    theta = np.zeros((count, 1, 2))
    return Predicted(
        replace(scene, name=law), observe, {}, {}, numbers, 18, 1, 0.01 * value, None, theta,
        ["a warning"] if law == "a" else [],
    )  # fmt: skip


def test_a_mixture_has_each_law_as_often_as_its_weight_says():
    """And what is one body's is the heaviest law's; runs and warnings are of all."""
    laws = {"a": predicted_of("a", 1.0), "b": predicted_of("b", 2.0), "c": predicted_of("c", 3.0)}
    mixed = mixture(laws, {"a": 0.2, "b": 0.0, "c": 0.8})
    values, counts = np.unique(mixed.values["volume"], return_counts=True)
    assert dict(zip(values.tolist(), counts.tolist(), strict=True)) == {1.0: 20, 3.0: 80}
    assert np.bincount(mixed.draws["law"]).tolist() == [20, 0, 80]
    assert mixed.scene.name == "c"
    assert (mixed.runs, mixed.failed, mixed.missed) == (54, 3, 0.03)
    assert mixed.warnings == ["a: a warning"]
    assert len(mixed.thetas) == 100
    # Some draws of the heaviest law's are left where another law failed at some of its own.
    fewer = mixture(laws | {"a": predicted_of("a", 1.0, 60)}, {"a": 0.2, "b": 0.0, "c": 0.8})
    assert len(fewer.thetas) == len(fewer.values["volume"]) == 60
    row = mixed.summary()["volume"]
    assert float(row["mean"]) == pytest.approx(0.2 * 1.0 + 0.8 * 3.0)


def tree_of(log_likelihood, log_evidence):
    """A posterior whose data (m,) have these log likelihoods at every draw, with some scatter."""
    rng = np.random.default_rng(0)
    values = log_likelihood + 0.01 * rng.normal(size=(2, 200, len(log_likelihood)))
    tree = xr.DataTree.from_dict(
        {
            "log_likelihood": xr.Dataset({"y": (("chain", "draw", "datum"), values)}),
            "posterior": xr.Dataset({"mu": (("chain", "draw"), rng.normal(size=(2, 200)))}),
            "observed_data": xr.Dataset({"y": (("datum",), np.zeros(values.shape[-1]))}),
        }
    )
    tree.attrs["log_evidence"] = log_evidence
    return tree


def test_weights_by_evidence_and_by_what_was_left_out():
    """One law is likelier by a factor of e^2; each predicts half of the data far better."""
    first = np.where(np.arange(20) < 10, -1.0, -6.0)
    trees = {"one": tree_of(first, -10.0), "other": tree_of(first[::-1], -12.0)}
    weights = weights_of(trees)
    share = 1.0 / (1.0 + np.exp(-2.0))
    assert weights.by("evidence") == pytest.approx({"one": share, "other": 1.0 - share})
    assert weights.by("stacking") == pytest.approx({"one": 0.5, "other": 0.5}, abs=0.02)
    assert weights.by("equal") == {"one": 0.5, "other": 0.5}
    (line,) = weights.warnings
    assert line.startswith("stacking gives one 0.50, evidence 0.88: they differ where no law")
    assert Weights({"one": 0.8, "other": 0.2}, weights.evidence).warnings == []
    del trees["one"].attrs["log_evidence"]
    assert weights_of(trees).warnings == []
    with pytest.raises(InputError, match="not all posteriors have an evidence"):
        weights_of(trees).by("evidence")


def test_a_body_of_another_law_keeps_its_loads_and_bulk_modulus():
    heart = em.scenes.left_ventricle(3, 6, 1)
    piece = em.specimen(
        {"stretch_x": np.array([1.0, 1.1])}, law=em.find_law("guccione"),
        parameters=(em.Parameter("C", "kPa", 0.5, 2.0), em.Parameter("b_f", "", 5.0, 20.0)),
        constants={"b_t": 3.0, "b_fs": 4.0, "kappa": 1e6}, fibres=[1.0, 0.0, 0.0],
    )  # fmt: skip
    other = made_of(heart, piece)
    assert other.law.name == "guccione"
    assert other.parameter_names == ("C", "b_f", "pressure")
    assert dict(other.constants) == {
        "b_t": 3.0, "b_fs": 4.0, "kappa": heart.constants["kappa"],
    }  # fmt: skip
    rubber = em.specimen(
        {"stretch_x": np.array([1.0, 1.1])}, law=em.find_law("yeoh"),
        parameters=(em.Parameter("c_1", "kPa", 0.5, 2.0),),
        constants={"c_2": 0.0, "c_3": 0.0, "kappa": 1e6},
    )  # fmt: skip
    plain = made_of(heart, rubber)
    assert plain.fibres is None
    assert plain.angles == ()
    beam = em.scenes.once_clamped_beam(cells=(2, 1, 1), order=1)
    with pytest.raises(InputError, match="law 'guccione' needs fibres"):
        made_of(beam, piece)


TABLE = "stretch_x,stress_x [kPa]\n" + "".join(
    f"{x},{30.0 * (x - x**-2) + e:.4f}\n"
    for x, e in ((1.0, 0.0), (1.05, 0.3), (1.1, -0.2), (1.15, 0.4), (1.2, -0.3))
)
PIECES = {
    "a": 'law = "neo_hookean"\nparameters = {mu = {unit = "kPa", median = 20, log_sd = 0.7}}\n'
    "constants = {lam = 1e5}\n",
    "b": 'law = "yeoh"\nparameters = {c_1 = {unit = "kPa", median = 10, log_sd = 0.7}}\n'
    "constants = {c_2 = 0, c_3 = 0, kappa = 1e5}\n",
}


def test_two_laws_by_command_are_one_where_they_say_the_same(tmp_path, capsys, monkeypatch):
    """Yeoh's law of one term is the neo-Hookean one, with mu = 2 c_1."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "t.csv").write_text(TABLE)
    (tmp_path / "u.csv").write_text("stretch_x,stress_x [kPa]\n1.0,0\n1.5,1\n")
    words = ["--data", "t.csv", "--noise", "0.5", "--draws", "300", "--no-certify", "--json"]
    for name, text in PIECES.items():
        (tmp_path / f"{name}.toml").write_text(f'specimen = "t.csv"\ngrips = "none"\n{text}')
        assert main(["infer", f"{name}.toml", *words, "--out", name]) == 0
    (tmp_path / "further.toml").write_text(f'specimen = "u.csv"\ngrips = "none"\n{PIECES["a"]}')
    capsys.readouterr()
    ask = ["predict", "a", "b", "--scene", "further.toml", "--observe", "stress:stress_x"]
    assert main([*ask, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert [row["law"] for row in told["laws"]] == ["neo_hookean", "yeoh"]
    for way in ("stacking", "evidence"):
        assert sum(row[way] for row in told["laws"]) == pytest.approx(1.0)
    assert [row["evidence"] for row in told["laws"]] == pytest.approx([0.5, 0.5], abs=0.02)
    mixed, *each = (
        list(numbers.values())[1] for numbers in (told["numbers"], *told["by_law"].values())
    )
    for row in each:
        assert row["median"] == pytest.approx(mixed["median"], rel=0.02)
    assert main([*ask, "--weights", "equal", "--out", "p"]) == 0
    out = capsys.readouterr().out
    assert "neo_hookean " in out
    assert "not certified" in out
    assert (tmp_path / "p" / "prediction.nc").is_file()
    refused = (
        (["predict", "a", "b"], "several folders are of posteriors: name a scene, --scene"),
        (["predict", "a", "a", *ask[3:]], "a folder is given twice"),
        (["predict", "a", *ask[3:], "--weights", "equal"], "one has all the weight"),
        (["predict", "a", "none", *ask[3:]], "none"),
    )
    for line, words in refused:
        assert main(line) == 2
        complaint = capsys.readouterr().err
        assert words in complaint
        assert complaint.count("\n") == 1
