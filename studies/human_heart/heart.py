"""The heart: its surfaces by frame, and the scene made of the frame between the waves."""

from dataclasses import dataclass
from pathlib import Path

import emulator as em

SURFACES = ("lv_endocardium", "rv_endocardium", "epicardium")
_FILES = ("LV_ENDOCARDIAL", "RV_ENDOCARDIAL", "EPICARDIAL")
LENGTH = 25.0  # mm, over which what a fitted surface misses correlates
IMAGED = "f018"
FRAMES = ("f016", "f020", "f022", "f024")
_SIZE, _LEFT_SIZE = 8.256, 7.0  # mm, edges of the meshes of both ventricles, and of the left one

SYSTOLE = "f010"  # where both cavities are smallest


@dataclass(frozen=True)
class Assumed:
    """What a scene of the heart takes for granted.

    name : of the assumption, and of the folder of its scene.
    loaded : whether the imaged frame is under load; or it is taken as at rest.
    springs : whether the base is on springs; or it is held.
    both : whether both ventricles are there; or the left wall alone, cut below its valves.
    contracts : whether fibres develop a tension; pressures are then those at the end of systole.
    """

    name: str
    loaded: bool = True
    springs: bool = True
    both: bool = True
    contracts: bool = False

    @property
    def surfaces(self) -> dict[str, str]:
        """The imaged surface that is data of each facet set of the mesh."""
        return {name: name for name in SURFACES} if self.both else {"endocardium": SURFACES[0]}

    @property
    def cavities(self) -> tuple[str, ...]:
        """Facet sets of the cavities, the left one first."""
        return SURFACES[:2] if self.both else ("endocardium",)


AS_IMAGED = Assumed("as imaged")
OTHERS = (
    Assumed("stress-free", loaded=False),
    Assumed("base held", springs=False),
    Assumed("left alone", both=False),
)
CONTRACTING = Assumed("contraction", contracts=True)

_IMAGED = {"pressure": "imaged", "right_pressure": "imaged_right"}


def _scene_file(assumed: Assumed, axis: list[float]) -> str:
    """The scene's file, of the mesh heart.vtu beside it."""
    loads = tuple(_IMAGED)[: len(assumed.cavities)]
    lines = ['law = "holzapfel_ogden"', 'mesh = "heart.vtu"']
    if assumed.loaded:
        image = {name: _IMAGED[name] for name in loads}
        image |= {"tension": "at_rest"} if assumed.contracts else {}
        told = ", ".join(f'{name} = "{there}"' for name, there in image.items())
        lines += [f"loaded_by = {{{told}}}"]
    rule = "biventricle" if assumed.both else "helix"
    lines += ["[fibres]", f'rule = "{rule}"', "angles = [60.0, -60.0]", f"axis = {axis}"]
    lines += ["[[supports]]"]
    if assumed.springs:
        lines += ['kind = "elastic"', 'facet_set = "base"', 'parameter = "annulus"']
    else:
        lines += ['node_set = "base"']
    lines += [
        "[[supports]]", 'kind = "elastic"', 'facet_set = "epicardium"', 'direction = "normal"',
        'parameter = "pericardium"',
    ]  # fmt: skip
    for name, cavity in zip(loads, assumed.cavities, strict=True):
        lines += ["[[loads]]", 'kind = "valve_pressure"', f'facet_set = "{cavity}"']
        lines += [f'parameter = "{name}"']
    if assumed.contracts:
        lines += ["[[loads]]", 'kind = "active_tension"']
    constants = {"b": 4.0, "b_f": 4.0, "kappa": 25.0}
    constants |= {"at_rest": 0.0} if assumed.contracts else {}
    ranges: dict[str, tuple[str, float, float, str]] = {
        "a": ("kPa", 1.0, 5.0, "log"),
        "a_f": ("kPa", 6.0, 40.0, "log"),
        "pressure": ("kPa", *((13.0, 19.0) if assumed.contracts else (0.0, 1.6)), "uniform"),
        "right_pressure": ("kPa", *((2.0, 5.0) if assumed.contracts else (0.0, 0.45)), "uniform"),
        "tension": ("kPa", 80.0, 220.0, "uniform"),
        "imaged": ("kPa", 0.2, 0.7, "uniform"),
        "imaged_right": ("kPa", 0.03, 0.25, "uniform"),
        "pericardium": ("kPa/mm", 0.08, 0.5, "log"),
        "annulus": ("kPa/mm", 0.2, 2.0, "log"),
    }
    absent = set() if assumed.contracts else {"tension"}
    absent |= set() if assumed.springs else {"annulus"}
    absent |= set() if assumed.both else {"right_pressure", "imaged_right"}
    absent |= set() if assumed.loaded else {"imaged", "imaged_right"}
    for name, (unit, low, high, scale) in ranges.items():
        if name not in absent:
            lines += [f"[parameters.{name}]", f'unit = "{unit}"', f"range = [{low}, {high}]"]
            lines += [f'scale = "{scale}"']
    lines += ["[constants]", *(f"{name} = {value}" for name, value in constants.items())]
    return "\n".join(lines) + "\n"


def surfaces_of(folder: Path, frame: str) -> dict[str, em.hearts.Surface]:
    """The three surfaces of a frame, by facet set."""
    found = {}
    for name, file in zip(SURFACES, _FILES, strict=True):
        path = folder / f"{file}_{frame[1:]}.obj"
        if not path.is_file():
            raise em.InputError(f"{path} does not exist; name the folder of the surfaces")
        found[name] = em.hearts.read_surface(path, name)
    return found


def scene_of(data: Path, folder: Path, assumed: Assumed = AS_IMAGED) -> em.Scene:
    """The scene of the imaged frame, written to ``folder``; a mesh that is there is kept."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "heart.toml"
    if not path.is_file():
        left, right, outside = surfaces_of(data, IMAGED).values()
        if assumed.both:
            wall = em.hearts.mesh_wall(left, outside, right=right, size=_SIZE)
        else:
            wall = em.hearts.mesh_wall(
                left, outside, right=right, ventricles="left", size=_LEFT_SIZE
            )
        em.write_mesh(folder / "heart.vtu", wall.mesh)
        path.write_text(_scene_file(assumed, [float(x) for x in wall.axis]))
    return em.find_scene(str(path))
