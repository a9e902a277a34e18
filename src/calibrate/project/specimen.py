"""First files for a table of a mechanical test: its scene, and its experiment."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from calibrate.measurements.data import read_measurements
from calibrate.measurements.specimens import SpecimenCurves
from calibrate.measurements.stress import is_stress
from calibrate.measurements.stretch import Stretch
from calibrate.measurements.tube import TubeForce, TubePressure
from calibrate.project.viscosity import ViscosityDraft, draft_viscosity
from emulator.core.cells import BRANCH, PROTOCOL, Cells, read_cells
from emulator.core.errors import InputError
from emulator.core.units import KPA_PER_MMHG, with_unit
from emulator.mechanics.laws import Law, find_law
from emulator.mechanics.laws.law import Quantity
from emulator.scenes.draft import prior_lines
from emulator.scenes.file import read_scene
from emulator.scenes.parameter_space import LogNormal, Parameter
from emulator.scenes.tissue_priors import published_exponents
from emulator.specimens.specimen import (
    Specimen,
    likely_names,
    long_table,
    read_states,
    require_specimen,
    specimen,
)
from emulator.specimens.states import AXES, States, motion_columns, pull_columns
from emulator.specimens.tube import Tube
from emulator.specimens.tube import motion_columns as tube_columns
from emulator.viscosity.times import TIME

_MODULI = (0.005, 3.0)  # range of a modulus, as a share of the largest stress over its strain
_EXPONENTS = (0.1, 50.0)
_GUESSED = 2.0  # sd of the logarithm to each side of a guess that reach the ends of its range
_KAPPA = 1e4  # bulk modulus, likewise: 1000 changes stresses of stretched fibres by 0.4 %
_NOISE = 0.03  # scale of both sds of the noise, as a share of the largest stress
_NO_GRIPS_PULLED = 'grips = "none"   # CHANGE: the verdict takes stresses to be even'
_NO_GRIPS = (
    'grips = "none"   # CHANGE: the verdict takes stresses to be even; or [grips], at the end'
)
_GRIPS = (
    "# [grips]   # how the piece was held, for the line above: the certificate says what it does",
    "# size = [10.0, 10.0, 1.0]   # mm between the grips along x, y and z",
    '# held = "clamped"   # or "hooks"',
    "# marks = 2.0   # mm, side of the square in which stretches were measured; not of the grips",
)
_Sizes = dict[str, tuple[SpecimenCurves, np.ndarray]]  # each measurement, and its data (m, c)
_HIGH = 40.0  # kPa, 300 mmHg: a pressure without a unit that is higher may be in mmHg
_NARROW, _WIDE = 0.7, 4.0  # stretches around a tube's inside, over the one without pressure
_DRIFT = 0.05  # share of the largest number by which it may change while the motion is held


class SpecimenDraft(NamedTuple):
    """The scene file and the experiment file that were written.

    path, scene_path : the experiment file, and the scene file that it names.
    scene : the specimen that the latter describes.
    notes : sentences, one for each guess.
    """

    path: Path
    scene_path: Path
    scene: Specimen
    notes: tuple[str, ...]


def draft_specimen(
    table: str | Path,
    out: str | Path,
    *,
    law: str | None = None,
    tissue: str | None = None,
    tube: Tube | None = None,
) -> SpecimenDraft:
    """Write a scene file and an experiment file for a table of a specimen's test.

    Parameters
    ----------
    table : a CSV file or spreadsheet, see :mod:`emulator.specimens.states` and
        :mod:`calibrate.measurements.stress` for its columns, and :mod:`emulator.specimens.tube` and
        :mod:`calibrate.measurements.tube` for those of a tube.
    out : the experiment file, ``NAME.toml``; the scene is ``NAME_scene.toml`` beside it.
    law : name of the law; by default two families of fibres for tests that pull along two axes,
        an isotropic exponential else.
    tissue : the tissue whose published exponents of the law are priors; moduli follow from data.
    tube : the sector of a tube.

    Raises
    ------
    InputError
        A table that cannot be read, an unknown law, or a file that exists already.
    """
    table, out = Path(table), Path(out)
    scene_path = out.with_name(f"{out.stem}_scene.toml")
    if out.suffix != ".toml":
        raise InputError(f"--out {out}: the file name must end in .toml")
    for path in (out, scene_path):
        if path.exists():
            raise InputError(f"{path} is there already; remove it or give --out another name")
    if not table.is_file():
        raise InputError(f"data file {table} does not exist")
    cells, viscosity = draft_viscosity(read_cells(table, unloading=True), tube)
    states = read_states(cells, tube, timed=not isinstance(viscosity, str))
    measured, slope = _size(cells, states, tube)
    motion = (np.diagonal(states.gradients, axis1=1, axis2=2) != 0.0) | (states.pulls != 0.0)
    axes = [axis for axis, column in zip(AXES, motion.T, strict=True) if column.any()]
    chosen = "holzapfel_gasser_ogden" if len(axes) > 1 else "holzapfel_ogden_isotropic"
    material = find_law(law or chosen)
    of_law = f"law {material.name}" + ("" if law else ": a guess, give --law NAME")
    notes = _notes(cells, of_law, measured, slope, tube, viscosity)
    name, folder = table.resolve(), scene_path.resolve().parent
    name = name.relative_to(folder) if name.is_relative_to(folder) else name
    scene_path.parent.mkdir(parents=True, exist_ok=True)
    grips = isinstance(viscosity, str) and tube is None and not states.pulls.any()
    published = published_exponents(material, tissue)
    text = _scene_text(material, name.as_posix(), axes, slope, published, tube, grips=grips)
    extra = ("", *_GRIPS) * grips if isinstance(viscosity, str) else viscosity.lines
    text += "".join(f"{line}\n" for line in extra)
    scene_path.write_text(text, encoding="utf-8")
    try:
        scene = require_specimen(read_scene(scene_path))
    except InputError:
        scene_path.unlink()
        raise
    out.write_text(_experiment_text(scene_path.name, name.as_posix(), measured, notes), "utf-8")
    return SpecimenDraft(out, scene_path, scene, tuple(notes))


def _notes(
    cells: Cells,
    of_law: str,
    measured: _Sizes,
    slope: float,
    tube: Tube | None,
    viscosity: ViscosityDraft | str,
) -> list[str]:
    """Return one sentence per value that was read or guessed; ``of_law`` is the one on the law."""
    part, _ = next(iter(measured.values()))
    axes = ["stretch_around", "stretch_axial"] if tube else [f"stretch_{a}" for a in AXES]
    motions = list(zip(axes, part.stretches.T, strict=False))
    notes = [
        f"{len(part.states.free)} states in {_tests(part.states)}",
        *(
            f"{n} from {np.nanmin(x):.4g} to {np.nanmax(x):.4g}"
            if np.nanmax(x) > np.nanmin(x)
            else f"{n} is {np.nanmin(x):.4g} wherever it is prescribed"
            for n, x in motions
            if not np.isnan(x).all()
        ),
        *(() if tube is None else _of_tube(part.stretches, measured, cells.words)),
        *(
            f"{name} reaches {_farthest(data, part.at_rest):.3g} {part.unit}".removesuffix(" 1")
            for name, (part, data) in measured.items()
        ),
        *(
            _of_viscosity(viscosity)
            if isinstance(viscosity, ViscosityDraft)
            else [*filter(None, [viscosity]), *_drifts(list(cells.rows), part.states, measured)]
        ),
        *long_table(part.scene),
        of_law,
        f"priors of moduli follow from a stiffness of {slope:.3g} kPa",
        *([] if tube else ['grips = "none": stresses are taken to be even']),
        "incompressible, --forward homogeneous takes the law's kappa; certificates take it, too",
        *(
            f"errors along a curve of {name} correlate over {part.usual_length[0]:g} "
            f"{part.usual_length[1]}, their sds are inferred"
            for name, (part, _) in measured.items()
        ),
    ]
    notes[1:1] = _of_columns(cells, tube, timed=isinstance(viscosity, ViscosityDraft))
    return notes


def _of_viscosity(draft: ViscosityDraft) -> Iterator[str]:
    """Say why viscosity is proposed, and what moduli are with it."""
    few = draft.reasons[:3]
    more = f", and {len(draft.reasons) - 3} more" if len(draft.reasons) > 3 else ""
    yield (
        f"[viscosity] with {draft.viscosity.count} terms, a guess: {'; '.join(few)}{more}; all "
        "rows are used, in the order of time"
    )
    yield "moduli are those of an instant change of shape, before anything relaxes"


def _of_columns(cells: Cells, tube: Tube | None, *, timed: bool) -> Iterator[str]:
    """Say which rows and columns are left out, and which have no unit."""
    if cells.unloading:
        yield f"{cells.unloading} rows of unloading are left out"
    names = {word: with_unit(word) for word in cells.words}
    moving = motion_columns(names) if tube is None else tube_columns(names)
    pulls, of_tube = pull_columns(names).values(), (TubePressure.column, TubeForce.column)
    stresses = [w for w, (n, _) in names.items() if is_stress(w) or w in pulls or n in of_tube]
    used = (*moving, *stresses, PROTOCOL, BRANCH, *(w for w in names if w.startswith("area_")))
    used += tuple(w for w, (n, _) in names.items() if timed and n == TIME)
    if ignored := [word for word in names if word and word not in used]:
        likely = likely_names(ignored, of_tube=tube is not None)
        yield f"columns left out: {', '.join(ignored)}{likely}"
    if bare := [w for w in stresses if not names[w][1]]:
        yield f"{', '.join(bare)} without a unit: kPa, forces mN; others in brackets"


def _of_tube(stretches: np.ndarray, measured: _Sizes, words: Sequence[str]) -> Iterator[str]:
    """Ask about what a tube under pressure is not, and say what its table cannot tell.

    stretches : around and along the tube, inside, (m, 3).
    words : the columns of the table.
    """
    around, along, _ = stretches.T
    if (around * np.sqrt(along)).min() < _NARROW or around.max() > _WIDE:
        yield (
            f"CHANGE: the inside is {around.min():.2g} to {around.max():.2g} times as long around "
            "as in the sector, which no artery under pressure is: is opening_angle of [tube], 0 as "
            "written, the sector's (an angle makes stretches larger), and the unit of the radii?"
        )
    if TubePressure.column in words and (most := np.nanmax(measured[TubePressure.name][1])) > _HIGH:
        yield (
            f"CHANGE: a pressure of {most:.3g} without a unit is taken for kPa, "
            f"{most / KPA_PER_MMHG:.0f} mmHg: call it 'pressure [mmHg]' if it is in mmHg"
        )
    if np.ptp(along) == 0.0 and TubeForce.name not in measured:
        yield (
            "CHANGE: one axial stretch and no force_axial: pressures alone hardly tell the "
            "stiffness along the tube from that around it"
        )


def _farthest(data: np.ndarray, at_rest: float) -> float:
    """Return the number that is farthest from the one at rest."""
    return float(np.ravel(data)[np.nanargmax(np.abs(data - at_rest))])


def _drifts(numbers: Sequence[int], states: States, measured: _Sizes) -> Iterator[str]:
    """Say where a test stays in one state while its data change, as in relaxation and creep.

    numbers : the number of each row in the file.
    """
    for rows in states.holds():
        for name, (part, data) in measured.items():
            column = int(np.argmax(np.nan_to_num(np.ptp(data[rows], axis=0))))
            values = data[rows, column]
            # A stress that grows in rows of one stretch grew between them, by less than is read.
            rounded = not states.pulls.any() and abs(values[-1]) > abs(values[0])
            if not rounded and np.ptp(values) > _DRIFT * np.nanmax(np.abs(data - part.at_rest)):
                unit = "" if part.unit == "1" else f" {part.unit}"
                yield (
                    f"CHANGE: rows {numbers[rows[0]]} to {numbers[rows[-1]]} hold one state, in "
                    f"which {name} goes from {values[0]:.3g} to {values[-1]:.3g}{unit}: an elastic "
                    "law has one number there, leave the hold out"
                )


def _tests(states: States) -> str:
    names = [name for name in states.protocols if name]
    return f"{len(names)} tests ({', '.join(names)})" if len(names) > 1 else "one test"


def _size(cells: Cells, states: States, tube: Tube | None) -> tuple[_Sizes, float]:
    """Return the size of each measurement, and the tissue's stiffness in kPa.

    A stress over the motion there, where it is largest, either measured or prescribed; of a tube,
    the stress of a thin wall, pressure times inner radius over thickness, or force over section.
    """
    neutral = specimen(
        states, law=find_law("neo_hookean_split"), tube=tube,
        parameters=(Parameter("mu", "kPa", 1.0, 10.0),), constants={
            "kappa": 10.0, **dict.fromkeys(_stiffnesses(tube), 1.0)},
    )  # fmt: skip
    observe, data, _ = read_measurements(neutral, cells.path, cells)
    parts = {n: part for n, part in observe.parts.items() if isinstance(part, SpecimenCurves)}
    if len(parts) < len(data):
        raise InputError(f"data file {cells.path} has {', '.join(observe.parts)} besides stresses")
    sizes = {name: (part, data[name].reshape(len(data[name]), -1)) for name, part in parts.items()}
    ways = {name: np.nan_to_num(np.abs(y - part.at_rest)) for name, (part, y) in sizes.items()}
    for name, part in parts.items():
        if not ways[name].max() > 0.0:
            raise InputError(f"data file {cells.path}: each {name} is {part.at_rest or 'zero'}")
    motion = np.abs(neutral.measured.gradients).max(axis=(1, 2))
    stress = np.abs(neutral.measured.pulls).max(axis=1)
    stretches = ways.pop(Stretch.name, None)
    if stretches is not None:
        motion = np.maximum(motion, stretches.max(axis=1))
    first = next(iter(ways), None)
    if first is not None:
        stress = np.maximum(stress, ways[first].max(axis=1))
    if tube is not None:
        area = np.pi * (tube.outer_radius**2 - tube.inner_radius**2)
        thin = tube.inner_radius / sum(tube.layers)
        stress = stress * (thin if first == TubePressure.name else 1.0 / area)
    rows = motion > 0.1 * motion.max()
    return sizes, float((stress[rows] / motion[rows]).max())


def _stiffnesses(tube: Tube | None) -> list[str]:
    """Return the names of the layers' factors."""
    layers = 0 if tube is None or len(tube.layers) == 1 else len(tube.layers)
    return [f"stiffness_{k + 1}" for k in range(layers)]


def _scene_text(
    law: Law,
    table: str,
    axes: list[str],
    slope: float,
    published: Mapping[str, LogNormal],
    tube: Tube | None,
    *,
    grips: bool,
) -> str:
    """Return the scene file. Fibres are along the first axis that moves, sheets across it.

    published : the priors of parameters that do not follow from the table.
    grips : whether there may be any; not of a tube, with prescribed forces or with times.
    """
    lines = [f'law = "{law.name}"   # see docs/laws.md for others', f'specimen = "{table}"']
    if tube is None:
        lines.append(_NO_GRIPS if grips else _NO_GRIPS_PULLED)
    if law.fibres:
        first = axes[0] if axes else "x"
        second = next(a for a in [*axes[1:], *AXES] if a != first)
        unit = {a: [float(a == b) for b in AXES] for a in AXES}
        lines += ["", "[fibres]", 'rule = "uniform"']
        lines.append(f"direction = {unit[first]}   # CHANGE: the fibres, or their mean direction")
        if law.sheets:
            lines.append(f"sheets = {unit[second]}   # CHANGE: the second axis of the tissue")
    for quantity in law.quantities:
        if quantity.name != "kappa":
            lines += ["", *_parameter(quantity, slope, published.get(quantity.name))]
    layers = _stiffnesses(tube)
    for name in layers[1:]:
        lines += [
            "",
            f"[parameters.{name}]",
            "range = [0.1, 2.0]   # CHANGE: over the inner layer's",
        ]
    constants = [f"{name} = 1.0" for name in layers[:1]]
    if any(quantity.name == "kappa" for quantity in law.quantities):
        kappa = _KAPPA * slope
        constants.append(f"kappa = {kappa:.2g}   # kPa")
    lines += ["", "[constants]", *constants] if constants else []
    if tube is None:
        return "\n".join(lines) + "\n"
    lines += ["", "[tube]   # the sector that it opens to when it is cut, without stress"]
    lines.append(f"inner_radius = {tube.inner_radius}   # mm")
    lines.append(f"layers = {list(tube.layers)}   # mm, from the inside out")
    lines.append(f"opening_angle = {tube.opening_angle}   # CHANGE: degrees of a turn it lacks")
    return "\n".join(lines) + "\n"


def _parameter(quantity: Quantity, slope: float, published: LogNormal | None) -> list[str]:
    low, high = (share * slope for share in _MODULI) if quantity.unit == "kPa" else _EXPONENTS
    head = [f"[parameters.{quantity.name}]", f'unit = "{quantity.unit}"']
    if published is not None:
        return [*head, *prior_lines(published.median, published.log_sd, published.source)]
    if quantity.low_admitted:
        low = quantity.low
    elif quantity.low == 0.0 and not np.isfinite(quantity.high):
        median, log_sd = np.sqrt(low * high), 0.5 * np.log(high / low) / _GUESSED
        source = f"a guess, {low:.2g} to {high:.3g} as {_GUESSED:g} log-sd to each side"
        return [*head, *prior_lines(median, round(log_sd, 2), source, "   # CHANGE: a guess")]
    else:
        low = quantity.low if np.isfinite(quantity.low) else -20.0
        high = quantity.high if np.isfinite(quantity.high) else 20.0
        margin = 0.01 * (high - low)
        low, high = low + margin, high - margin
    return [*head, f"range = [{low:.2g}, {high:.3g}]   # CHANGE: what you think possible"]


def _experiment_text(scene: str, table: str, sizes: _Sizes, notes: list[str]) -> str:
    head = ["# A first experiment file; what was guessed:", *(f"# - {note}" for note in notes)]
    head += ["", f'scene = "{scene}"', f'data = "{table}"', 'forward = "incompressible"']
    for name, (part, data) in sizes.items():
        largest = abs(_farthest(data, part.at_rest) - part.at_rest)
        sd, (length, of_what) = f"{_NOISE * largest:.2g}", part.usual_length
        unit = "" if part.unit == "1" else f"{part.unit}, "
        head += [
            "",
            f"[noise.{name}]",
            'kind = "correlated"',
            f"length = {length}   # {of_what}, along a curve",
            f"sd_scale = {sd}   # {unit}of the independent errors' sd",
            f"spatial_sd_scale = {sd}   # {unit}of those that correlate",
        ]
    return "\n".join([*head, ""])
