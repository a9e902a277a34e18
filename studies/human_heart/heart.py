"""The heart: its surfaces by frame, and the scene made of the frame between the waves."""

from pathlib import Path

import emulator as em
from emulator.core.errors import InputError
from emulator.geometry.io import write_mesh
from emulator.geometry.surfaces import Surface, read_surface
from emulator.scenes import Scene

SURFACES = ("lv_endocardium", "rv_endocardium", "epicardium")
_FILES = ("LV_ENDOCARDIAL", "RV_ENDOCARDIAL", "EPICARDIAL")
LENGTH = 25.0  # mm, over which what a fitted surface misses correlates
IMAGED = "f018"
FRAMES = ("f016", "f020", "f022", "f024")
_SIZE = 8.256  # mm, edges of the mesh, of which the thinnest wall decides

_SCENE = """
law = "holzapfel_ogden"
mesh = "heart.vtu"
loaded_by = {pressure = "imaged", right_pressure = "imaged_right"}

[fibres]
rule = "biventricle"
angles = [60.0, -60.0]
axis = AXIS

[[supports]]
kind = "elastic"
facet_set = "base"
parameter = "annulus"

[[supports]]
kind = "elastic"
facet_set = "epicardium"
direction = "normal"
parameter = "pericardium"

[[loads]]
kind = "valve_pressure"
facet_set = "lv_endocardium"

[[loads]]
kind = "valve_pressure"
facet_set = "rv_endocardium"
parameter = "right_pressure"

[parameters.a]
unit = "kPa"
range = [1.0, 5.0]
scale = "log"

[parameters.a_f]
unit = "kPa"
range = [6.0, 40.0]
scale = "log"

[parameters.pressure]
unit = "kPa"
range = [0.0, 1.6]

[parameters.right_pressure]
unit = "kPa"
range = [0.0, 0.45]

[parameters.imaged]
unit = "kPa"
range = [0.2, 0.7]

[parameters.imaged_right]
unit = "kPa"
range = [0.03, 0.25]

[parameters.pericardium]
unit = "kPa/mm"
range = [0.08, 0.5]
scale = "log"

[parameters.annulus]
unit = "kPa/mm"
range = [0.2, 2.0]
scale = "log"

[constants]
b = 4.0
b_f = 4.0
kappa = 25.0
"""


def surfaces_of(folder: Path, frame: str) -> dict[str, Surface]:
    """The three surfaces of a frame, by facet set."""
    found = {}
    for name, file in zip(SURFACES, _FILES, strict=True):
        path = folder / f"{file}_{frame[1:]}.obj"
        if not path.is_file():
            raise InputError(f"{path} does not exist; name the folder of the surfaces")
        found[name] = read_surface(path, name)
    return found


def scene_of(data: Path, folder: Path) -> Scene:
    """The scene of the imaged frame, written to ``folder``; a mesh that is there is kept."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "heart.toml"
    if not path.is_file():
        left, right, outside = surfaces_of(data, IMAGED).values()
        wall = em.mesh_heart(left, right, outside, size=_SIZE)
        write_mesh(folder / "heart.vtu", wall.mesh)
        path.write_text(_SCENE.replace("AXIS", str([float(x) for x in wall.axis])))
    return em.find_scene(str(path))
