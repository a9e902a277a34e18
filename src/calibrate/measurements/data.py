"""Reading and writing measurements.

A CSV file has the columns ``node,ux,uy,uz`` (nodes of the mesh) or ``x,y,z,ux,uy,uz`` (material
points of the reference body), all lengths in mm. The volume of a cavity is one more column,
``volume`` (mL; ``volume:<facet set>`` where the scene has several cavities), filled in one row
only, which may be a row of its own. There may be a volume and no displacement. A missing value is
an empty cell, ``NA`` or ``nan``; it is read as NaN.

A netCDF file has a variable ``displacement`` with one row a point, and beside it either ``node`` or
``position`` (rows of x, y, z); and a number ``volume``, or ``volume:<facet set>``.

For a body in several load states, a CSV file has a column ``state`` with the state's name in every
row, and a netCDF file variables such as ``volume@diastole``.

A parameter that is known exactly in a load state, such as the amount of a motion, is a column
``known:NAME``, or ``NAME`` where it is a load's, the same number in every row of the state or given
once. A CSV file with such columns and neither ``state`` nor places is a loading curve: each row is
a load state, named by its number.

Each kind of observation (``calibrate.measurements.OBSERVATIONS``) names its own columns and
variables.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from calibrate.measurements.collection import Observations, check_some, observations
from calibrate.measurements.observation import (
    Block,
    DataField,
    Layout,
    Observation,
    check_values,
)
from calibrate.measurements.points import PointObservation
from calibrate.measurements.tables import (
    KNOWN,
    DataTable,
    read_csv,
    read_netcdf,
    write_csv,
    write_netcdf,
)
from calibrate.measurements.words import kinds_of, names_of, parse
from calibrate.state_names import in_state, split
from emulator.core.cells import OTHER_SPREADSHEETS, SPREADSHEETS, TEXT, Cells
from emulator.core.errors import InputError
from emulator.core.rooms import offered
from emulator.scenes.forward_problem import ForwardProblem

Files = str | Path | Mapping[str, str]
"""A data file, or the file of each load state by the state's name."""


def read_measurements(
    scene: ForwardProblem, files: Files, table: Cells | None = None
) -> tuple[Observations, dict[str, np.ndarray], dict[str, float]]:
    """Return the observations of a file, their data by the same names, and known parameters.

    Of several files, by load state, each has the data of its state. A file with states of its own,
    such as a loading curve ``pull``, has those of ``pull.1``, ``pull.2`` and so on. Parameters are
    known from columns ``known:NAME``, and returned by ``parameter@state``.

    table : the content of one of the files, where it has just been read.

    :class:`InputError` for a missing or malformed file, a place that is not finite, an infinite
    value, an unknown node, a point outside, an unknown cavity, a known value that differs within
    one load state.
    """
    parts: dict[str, Observation] = {}
    data: dict[str, np.ndarray] = {}
    known: dict[str, float] = {}
    paths: Mapping[str, str | Path] = files if isinstance(files, Mapping) else {"": files}
    for prefix, path in paths.items():
        if paths is files and (not prefix or set("@/+") & set(prefix)):
            raise InputError(f"data: load state '{prefix}'; give it a name without @, / and +")
        file = Path(path)
        if not file.is_file():
            raise InputError(f"data file {path} does not exist")
        of_cells = file.suffix.lower() in (*TEXT, *SPREADSHEETS, *OTHER_SPREADSHEETS)
        by_state: Mapping[str, DataTable]
        if table is not None and table.path.samefile(file):
            by_state = read_csv(table._replace(path=file), scene.load_parameters)
        else:
            rows = scene.read_table(file) if of_cells else None
            by_state = read_csv(rows, scene.load_parameters) if rows else read_netcdf(file)
        for inner, content in by_state.items():
            state = ".".join(filter(None, (prefix, inner)))
            known |= {in_state(name, state): value for name, value in content.known.items()}
            for name, (part, values) in _observed(scene, content, state).items():
                parts[name], data[name] = part, values
    return Observations(parts), data, known


def _observed(
    scene: ForwardProblem, file: DataTable, state: str
) -> dict[str, tuple[Observation, np.ndarray]]:
    """Return the observations of one load state and their data, by name."""
    layouts, observed = _layouts(file, kinds_of(scene)), {}
    for base, (kind, layout) in layouts.items():
        name, places = in_state(base, state), _words(layout, where=True)
        sharing = [other for _, other in layouts.values() if places & _words(other, where=True)]
        others = {w for o in sharing if o is not layout for w in _words(o, where=False)}
        arrays = file.arrays(layout.fields, others)
        try:
            part, values = observed[name] = _read(kind, scene, base, layout, arrays)
            check_values(part, name, values)
            check_some(base, values)
        except InputError as error:
            where = f", state '{state}'" if state else ""
            raise InputError(f"data file {file.path}{where}: {error}") from error
    try:
        for check_tests in offered("calibrate.measurements.specimens", "check_tests"):
            check_tests(observed)
    except InputError as error:
        raise InputError(f"data file {file.path}: {error}") from error
    return observed


def _read(
    kind: type[Observation],
    scene: ForwardProblem,
    name: str,
    layout: Layout,
    arrays: Mapping[str, np.ndarray],
) -> tuple[Observation, np.ndarray]:
    """Return the observation called ``name`` and its data, from the arrays of its layout."""
    if issubclass(kind, PointObservation):
        return kind.read(scene, layout, arrays)
    part, number = parse(kind, scene, name)[1], arrays[name]
    if number.size != np.prod(part.shape):
        curve = "; rows of a loading curve have" if scene.load_parameters else ""
        curve += " or".join(f" a column '{load}'" for load in scene.load_parameters)
        raise InputError(f"{name} has {number.size} values; give one, in {part.unit}{curve}")
    return part, number.reshape(part.shape)


def _words(layout: Layout, *, where: bool) -> set[str]:
    return {word for field in layout.fields if field.where is where for word in field.columns}


def _layouts(
    file: DataTable, kinds: Mapping[str, type[Observation]]
) -> dict[str, tuple[type[Observation], Layout]]:
    """Return kind and layout of each observation that the file has all columns of, by name.

    kinds : the kinds of observation that there are, by name.
    """
    complete: dict[str, tuple[type[Observation], Layout]] = {}
    partial: list[list[str]] = []
    used: set[str] = set()
    for kind in kinds.values():
        for name, layout in kind.layouts(file.words).items():
            words = file.words_of(layout)
            if not set(words) <= set(file.words):
                partial.append(words)
            elif name not in complete:
                complete[name] = kind, layout
                used.update(words)
    # An incomplete observation is refused; otherwise its columns would be silently ignored.
    partial = [words for words in partial if set(words) & set(file.words) - used]
    if complete and not partial:
        return complete
    lacking = [[w for w in words if w not in file.words] for words in partial]
    fault = f"{file.what} '{min(lacking, key=len)[0]}' is missing" if partial else "no data"
    of_table = file.what == "column"
    present = ", ".join(filter(None, file.words)) if of_table or not partial else ""
    fault += f" in {file.what}s {present}" if present else ""
    if partial:
        every = " or ".join(dict.fromkeys(",".join(words) for words in partial))
        for likely in offered("emulator.specimens.specimen", "likely_names") if of_table else ():
            every += likely(file.words)
    else:
        every = " or ".join(
            ",".join(file.words_of(layout))
            for name, kind in kinds.items()
            for layout in kind.layouts((name,)).values()
        )
    raise InputError(f"data file {file.path}: {fault}; expected {file.what}s {every}")


def _by_value(name: str) -> list[str | float]:
    """Return the words of a name, numbers by value: ``klotz:1.30`` is ``klotz:1.3``."""
    return [float(w) if w.replace(".", "", 1).isdecimal() else w for w in name.split(":")]


def write_data(
    path: str | Path,
    observe: Observation | Observations,
    values: np.ndarray | Mapping[str, np.ndarray],
    known: Mapping[str, float] = {},
) -> None:
    """Write data by name: netCDF where ``path`` ends in ``.nc``, CSV otherwise.

    known : values of parameters that are known exactly, by ``parameter@state``.

    :class:`InputError` for an observation under a name that its kind cannot have in a file.
    """
    observe = observations(observe)
    data = observe.name(values, "data")
    states: dict[str, list[Block]] = {state: [] for state in observe.states}
    for name, part in observe.parts.items():
        base, state = split(name)
        if _by_value(base) not in map(_by_value, names_of(part)):
            raise InputError(
                f"observation '{name}' does not fit in a data file; "
                f"there it would be called {' or '.join(names_of(part))}"
            )
        states[state].append(_block(part, base, observe.filled(name, np.asarray(data[name]))))
    for name, value in known.items():
        base, state = split(name)
        states[state].append([(DataField(KNOWN + base, (KNOWN + base,)), np.asarray(value))])
    write = write_netcdf if Path(path).suffix.lower() == ".nc" else write_csv
    write(path, states)


def _block(part: Observation, name: str, values: np.ndarray) -> Block:
    """Return the arrays that hold ``values`` in a data file, NaN where they are missing.

    A column of a free stretch says where in the states in which it is prescribed.
    """
    if not isinstance(part, PointObservation):
        return [(DataField(name, (name,)), values)]
    block = {field.variable: (field, array) for field, array in part.place_block}
    columns = iter(values.reshape(len(values), -1).T)
    for field in part.values_in(*part.selection):
        array = np.stack([next(columns) for _ in field.columns], axis=-1)
        array = array[:, 0] if len(field.columns) == 1 else array
        if field.variable in block:
            place = block[field.variable][1]
            array = np.where(np.isnan(place), array, place)
        block[field.variable] = field, array
    return list(block.values())
