"""A scene in a file, and what the command line says of it."""

import json

import meshio

from calibrate.cli import main
from emulator.geometry.generators.box import box

SCENE = """
law = "neo_hookean"
mesh = "block.vtu"
[node_sets.left]
axis = "x"
at = 0.0
[[supports]]
node_set = "left"
[[loads]]
kind = "gravity"
[parameters.mu]
unit = "kPa"
range = [5, 20]
[constants]
lam = 30.0
"""


def write_block(folder):
    """A scene file in ``folder``, its mesh beside it."""
    mesh = box((20.0, 10.0, 10.0), (2, 1, 1))
    meshio.write(folder / "block.vtu", meshio.Mesh(mesh.nodes, [("tetra", mesh.elements)]))
    (folder / "scene.toml").write_text(SCENE)
    return folder / "scene.toml"


def answer(capsys, *words):
    """Exit code and JSON of a call."""
    code = main([*map(str, words), "--json"])
    return code, json.loads(capsys.readouterr().out)


def complaint(capsys, *words):
    """The one line a bad call prints."""
    assert main(list(map(str, words))) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    lines = captured.err.strip().splitlines()
    assert len(lines) == 1
    assert lines[0].startswith("calibrate: ")
    return lines[0]
