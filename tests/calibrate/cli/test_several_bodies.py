"""Two bodies of one material, from a scene file through ``train`` and ``infer``."""

import pytest

from cli_support import answer
from emulator.geometry.generators.box import box
from emulator.geometry.io import write_mesh

TWO = """
law = "neo_hookean"
[[bodies]]
name = "cube"
mesh = "cube.vtu"
[[bodies]]
name = "beam"
mesh = "beam.vtu"
shift = [30.0, 0.0, 0.0]
[[supports]]
node_set = "cube.bottom"
[[supports]]
node_set = "cube.top"
displacement = [2.0, 0.0, 0.0]
[[supports]]
node_set = "beam.left"
[[loads]]
kind = "force"
node_set = "beam.right"
resultant = [0.0, 0.0, -0.005]
[parameters.mu]
unit = "kPa"
range = [5, 20]
scale = "log"
[constants]
lam = 30.0
"""


@pytest.mark.slow
def test_a_plate_s_force_and_a_beam_s_tip_tell_one_modulus(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_mesh("cube.vtu", box((10.0, 10.0, 10.0), (2, 2, 2)))
    write_mesh("beam.vtu", box((20.0, 8.0, 8.0), (3, 1, 1)))
    (tmp_path / "two.toml").write_text(TWO)
    train = ("train", "two.toml", "--recipe", "mechanics", "--simulations", 12, "--out", "emulator")
    assert answer(capsys, *train)[0] == 0
    infer = ("infer", "two.toml", "--emulator", "emulator", "--truth", "mu=9")
    infer += ("--warmup", 200, "--draws", 250, "--chains", 2, "--no-certify")
    both = {"beam.right": "displacement=0.02", "reaction:cube.top:x": "reaction:cube.top:x=0.001"}
    found = {}
    for observe, noise in (*both.items(), ("+".join(both), " ".join(both.values()))):
        code, record = answer(
            capsys,
            *infer,
            "--out",
            f"run{len(found)}",
            "--observe",
            observe,
            "--noise",
            *noise.split(),
        )
        assert code == 0
        found[observe] = record["parameters"]["mu"]
        assert abs(found[observe]["mean"] - 9.0) < 4.0 * found[observe]["sd"]
    *one, together = found.values()
    assert together["sd"] < min(each["sd"] for each in one)
