"""``calibrate check mesh``."""

import pytest

import emulator as em
from calibrate.cli import main
from emulator.geometry.io import write_mesh


@pytest.mark.slow
def test_from_the_command_line(capsys, tmp_path):
    (tmp_path / "beam.toml").write_text(BEAM)
    write_mesh(tmp_path / "beam.vtu", em.scenes.once_clamped_beam((4, 1, 1)).mesh)
    words = ["check", "mesh", str(tmp_path / "beam.toml"), "--out", str(tmp_path / "out")]
    assert main([*words, "--observe", "landmarks:4"]) == 0
    said = capsys.readouterr().out
    assert "81 nodes, beside 425 on a finer mesh of the same body" in said
    assert {p.name for p in (tmp_path / "out").iterdir()} == {"mesh_error.json", "mesh_error.png"}
    assert main(["check", "mesh", str(tmp_path / "beam.toml"), "--observe", "volume"]) == 2


BEAM = """
law = "neo_hookean"
mesh = "beam.vtu"
[[supports]]
node_set = "left"
[[loads]]
kind = "gravity"
density = 1.0
direction = [0.0, 0.0, -1.0]
[parameters.mu]
unit = "kPa"
range = [50.0, 100.0]
[constants]
lam = 80.0
"""
