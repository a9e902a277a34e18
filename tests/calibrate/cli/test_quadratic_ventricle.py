"""A quadratic ventricle with mean dilatation, from a mesh file to a certificate."""

import json

import pytest

import emulator as em
from calibrate.cli import main
from emulator.geometry.io import write_mesh

SCENE = """
law = "holzapfel_ogden"
mesh = "ventricle.vtu"
order = 2
dilatation = "mean"
[fibres]
rule = "helix"
angles = [60.0, -60.0]
[[supports]]
node_set = "base"
[[loads]]
kind = "cavity_pressure"
facet_set = "endocardium"
[parameters.a_f]
unit = "kPa"
range = [3.0, 10.36]
scale = "log"
[parameters.pressure]
unit = "kPa"
range = [0.533, 1.333]
[constants]
a = 0.36
b = 1.8
b_f = 2.4
kappa = 100.0
"""


def answer(capsys, *words):
    code = main([*map(str, words), "--json"])
    return code, json.loads(capsys.readouterr().out)


@pytest.mark.slow
def test_train_evaluate_infer_certify(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_mesh("ventricle.vtu", em.scenes.left_ventricle(rings=4, around=8, layers=1, order=1).mesh)
    (tmp_path / "p2.toml").write_text(SCENE)
    train = ("train", "p2.toml", "--recipe", "mechanics", "--simulations", 12, "--out", "emulator")
    assert answer(capsys, *train)[0] == 0
    _, table = answer(capsys, "evaluate", "emulator", "--against", "fem", "--cases", 4)
    assert table["err_u"]["median"] < 1e-3 * table["max_u"]["median"]
    code, report = answer(
        capsys, "infer", "p2.toml", "--emulator", "emulator", "--truth", "a_f=4.6", "pressure=1.0",
        "--observe", "landmarks:12+volume", "--noise", "displacement=0.2", "volume=1.0",
        "--warmup", 200, "--draws", 200, "--out", "posterior",
    )  # fmt: skip
    # Of 8 elements around it is coarse, and the certificate says so; on its own mesh all is well.
    assert (code, report["verdict"]) == (1, "not certified")
    finer, own = report["certificate"]["findings"]
    assert finer.startswith("on a finer mesh (2165 nodes) the mean of pressure would move by -")
    assert own.startswith("no mean moves by more than 0.1")
    assert report["certificate"]["failed"] == 0
    for name, truth in (("a_f", 4.6), ("pressure", 1.0)):
        row = report["parameters"][name]
        assert abs(row["mean"] - truth) < 4.0 * row["sd"]
