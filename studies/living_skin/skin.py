"""The sheet of skin between two pads, and what was measured of it."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np

import calibrate as cal
import emulator as em

THICKNESS = 1.5  # mm, which nobody measured: only stiffness times thickness is told
LENGTH, LOG_SD = 10.0, 0.8  # of the field of log stiffness
FORCE = "reaction:moving:x"
_PAD, _MARGIN, _SIZE = 8.0, 35.0, 2.5  # mm: width of a pad, skin around the pads, edges between
_OUTLINE = (-29.64, -20.0)  # mm, from the frame of the outline to that of the points
_PERIOD = 0.3  # mm, over which the keloid's measured force oscillates

LAWS = {
    "neo_hookean_split": {"mu": ("kPa", 0.5, 15.0)},
    "holzapfel_ogden_isotropic": {"a": ("kPa", 0.5, 15.0), "b": ("", 0.1, 10.0)},
    "ogden_1": {"mu_1": ("kPa", 0.02, 15.0), "alpha_1": ("", 2.0, 24.0)},
}
"""Parameters of each law: unit and range, log."""


@dataclass(frozen=True)
class Skin:
    """One of the two tests.

    name : of the files. gap : the way in mm between the pads' inner edges.
    amounts : the pads' motions in mm whose frames are data. later : those kept apart, of frames and
        of the force.
    inner : the x in mm between which points are taken; nearer to a pad they follow its glue.
    sideways : mm that the moving pad moves along y for each mm along -x.
    modes : the number of modes of log stiffness between the pads. The healthy skin is pulled twice
        as far, where skin with soft spots folds beside the pad and has no equilibrium.
    """

    name: str
    gap: float
    amounts: tuple[float, ...]
    later: tuple[float, ...]
    later_force: tuple[float, ...]
    inner: tuple[float, float]
    sideways: float
    modes: int

    @property
    def most(self) -> float:
        """The largest motion of the pad that is predicted, mm."""
        return 1.05 * max(*self.later, *self.later_force)


KELOID = Skin(
    "keloid", 40.727, (0.49, 0.985, 1.465, 1.93), (2.5, 3.0, 3.5, 4.0), (2.5, 3.0, 3.5, 4.0),
    (1.0, 38.0), -0.034, 23,
)  # fmt: skip
HEALTHY = Skin(
    "healthy", 36.495, (0.65, 1.28, 1.93, 2.495), (2.8, 3.2, 3.8), (4.0, 6.0, 8.0),
    (11.0, 28.7), 0.041, 0,
)  # fmt: skip


def rectangle(left: float, right: float, low: float, high: float) -> np.ndarray:
    """Corners (4, 2) mm."""
    return np.array([[left, low], [right, low], [right, high], [left, high]])


def scene_of(
    skin: Skin, data: Path, folder: Path, law: str = "neo_hookean_split", modes: int = 0,
    size: float = _SIZE, layers: int = 1,
) -> em.Scene:  # fmt: skip
    """The scene, written to ``folder``; a mesh that is there is kept."""
    path = folder / "skin.toml"
    if path.is_file():
        return em.find_scene(str(path))
    folder.mkdir(parents=True, exist_ok=True)
    end, half = skin.gap + _PAD, 0.5 * _PAD
    around = rectangle(-_PAD - _MARGIN, end + _MARGIN, -_MARGIN, _MARGIN)
    pads = {
        "moving": rectangle(-_PAD, 0.0, -half, half),
        "fixed": rectangle(skin.gap, end, -half, half),
    }
    mesh = em.hearts.mesh_sheet(around, THICKNESS, size=size, pads=pads, layers=layers)
    between = rectangle(-_PAD, end, -_PAD, _PAD)
    outline = data / f"{skin.name}_outline.csv"
    if outline.is_file():
        cells = np.genfromtxt(outline, delimiter=",", names=True)
        between = np.stack([cells["x"], cells["y"]], axis=1) + _OUTLINE
    regions = em.hearts.regions_within(mesh, {1: between})
    field = None
    if modes:  # the constant mode is the region's own factor
        field = LOG_SD * em.geometry.matern_modes(mesh, LENGTH, modes + 1, regions == 1)[:, 1:]
    em.write_mesh(folder / "skin.vtu", mesh, regions=regions, stiffness_modes=field)
    path.write_text(_scene_file(skin, law, modes, scar=outline.is_file()))
    return em.find_scene(str(path))


def _scene_file(skin: Skin, law: str, modes: int, scar: bool) -> str:
    lines = [f'law = "{law}"', 'mesh = "skin.vtu"', 'dilatation = "mean"', 'regions = "regions"']
    lines += ['stiffness_modes = "stiffness_modes"'] if modes else []
    for support in (
        'node_set = "edge"',
        'node_set = "fixed"',
        f'node_set = "moving"\ndisplacement = [-1.0, {skin.sideways}, 0.0]\namount = "pull"',
        'node_set = "bottom"\ncomponents = "z"',
        'kind = "elastic"\nfacet_set = "bottom"\nparameter = "foundation"',
    ):
        lines += ["[[supports]]", support]
    lines += ["[[loads]]", 'kind = "prestress"']
    ranges = {name: (*each, "log") for name, each in LAWS[law].items()}
    ranges["foundation"] = ("kPa/mm", 1e-4, 0.05 if modes else 0.01, "log")
    ranges["prestress"] = ("kPa", 0.1, 15.0, "uniform")
    if not modes:
        ranges["mu"] = ("kPa", 1.0, 15.0, "log")
    ranges["pull"] = ("", 0.0, skin.most, "uniform")
    if scar:
        ranges["stiffness_1"] = ("", 1.0, 40.0, "log")
    for k in range(modes):
        ranges[f"stiffness_mode_{k + 1}"] = ("", -2.5, 2.5, "uniform")
    for name, (unit, low, high, scale) in ranges.items():
        lines += [f"[parameters.{name}]"] + ([f'unit = "{unit}"'] if unit else [])
        lines += [f"range = [{low}, {high}]", f'scale = "{scale}"']
    lines += ["[constants]", "kappa = 2000.0", "stiffness_0 = 1.0"]
    lines += [] if scar else ["stiffness_1 = 1.0"]
    return "\n".join(lines) + "\n"


def force_of(scene: em.Scene, forward: em.ForwardMap) -> Callable[[jax.Array], jax.Array]:
    """The force in N on the moving pad along x that a map predicts, as a function of theta."""
    force = cal.Reaction(scene, "moving", "x").through(forward)
    assert force is not None  # the pad's motion is a parameter, and the skin rests as it lies
    return force


@dataclass(frozen=True)
class Measured:
    """What was measured of a test.

    field : all points and frames. amounts : the tracked motion of the pad in mm by frame.
    force : the force in N at a motion in mm, the mean over one oscillation of the device.
    chosen : the numbers of the points that are data.
    """

    field: cal.fields.FullField
    amounts: dict[str, float]
    force: Callable[[float], float]
    chosen: np.ndarray

    def frame_at(self, amount: float) -> str:
        """The frame whose motion is nearest."""
        return min(self.field.frames, key=lambda frame: abs(self.amounts[frame] - amount))


def measured_of(skin: Skin, data: Path, points: int) -> Measured:
    """Read a test from a folder."""
    field = cal.fields.read_full_field(
        data / f"{skin.name}_points.csv", data / f"{skin.name}_displacements.csv"
    )
    amounts = cal.fields.read_amounts(data / f"{skin.name}_pads.csv", "moving_ux")
    at, force = cal.fields.read_curve(
        data / f"{skin.name}_force.csv", "moving_ux_mm", "force_N", [1.0]
    )

    def mean_force(amount: float) -> float:
        low, high = amount - _PERIOD / 2, min(amount + _PERIOD / 2, float(at[-1]))
        near = (at >= low) & (at <= high)
        line = np.polyfit(at[near], force[near], 1)
        return float(np.polyval(line, amount))

    x = field.points[:, 0]
    inner = np.flatnonzero((x > skin.inner[0]) & (x < skin.inner[1]))
    chosen = inner[cal.fields.spread_points(field.points[inner], points)]
    motion = {frame: abs(value) for frame, value in amounts.items()}
    return Measured(field, motion, mean_force, chosen)


def data_of(
    scene: em.Scene, measured: Measured, frames: tuple[str, ...], *,
    field: bool = True, force: bool = True,
) -> tuple[cal.Observations, dict[str, Any], dict[str, float]]:  # fmt: skip
    """Observations, data and known motions of frames; of the field, the force or both."""
    seen = measured.field.only(frames, measured.chosen)
    parts, data = dict[str, Any](), dict[str, Any]()
    if field:
        observe, data = cal.fields.field_data(scene, seen, measured.amounts)
        parts |= observe.parts
    for frame in frames if force else ():
        parts[f"{FORCE}@{frame}"] = cal.Reaction(scene, "moving", "x")
        data[f"{FORCE}@{frame}"] = np.array(measured.force(measured.amounts[frame]))
    known = {f"pull@{frame}": measured.amounts[frame] for frame in frames}
    return cal.Observations(parts), data, known
