r"""Specimens: pieces of tissue in a testing machine, in homogeneous states.

Uniaxial, biaxial and shear tests deform the middle of a piece evenly, and so does each point of an
inflated tube's wall. A specimen is a law and the states (:mod:`emulator.specimens.states`) whose
stresses follow from it. It has no mesh: where a forward map gives displacements, those of a
specimen are the columns of the gradient H of each state, :math:`u = H e_k`, the displacements of
the corners :math:`e_x, e_y, e_z` (mm) of a unit cube.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.cells import BRANCH, LOADING, PROTOCOL, UNLOADING, Cells, read_cells
from emulator.core.errors import InputError
from emulator.core.units import with_unit
from emulator.geometry.mesh import Mesh, frozen_array
from emulator.mechanics.laws import Law
from emulator.mechanics.laws.law import law_identity
from emulator.scenes.fibre_rules import FibreRule
from emulator.scenes.forward_problem import ForwardProblem
from emulator.scenes.identity import Identity, described_fields, fingerprint
from emulator.scenes.parameter_space import Parameter
from emulator.scenes.scene import with_mesh
from emulator.scenes.tissue import FibreAngles, Tissue, stiffness_of, turned
from emulator.specimens.grips import Grips
from emulator.specimens.states import States, motion_columns, pull_columns, states
from emulator.specimens.tube import Tube
from emulator.specimens.tube import motion_columns as tube_columns
from emulator.viscosity.overstress import Histories, histories
from emulator.viscosity.series import KELVIN_VOIGT, Viscosity
from emulator.viscosity.times import TIME, check_times, read_times

_CONVENTIONS = (
    (r"(?:lambda|λ|stretch)_?([xyz])\1?", r"stretch_\1"),
    (r"(?:e|green)_?([xyz])\1", r"green_\1"),
    (r"(?:eps|epsilon|ε|strain)_?([xyz])\1?", r"strain_\1"),
    (r"(?:gamma|γ|shear)_?([xyz][xyz])", r"shear_\1"),
    (r"(?:sigma|σ|cauchy)_?([xyz])\1?", r"cauchy_\1"),
    (r"(?:p|pk1|stress)_?([xyz])\1?", r"stress_\1"),
    (r"(?:s|pk2)_?([xyz])\1", r"second_\1"),
    (r"(stretch|strain|stress)", r"\1_x"),
    (r"(?:engineering|nominal)_(strain|stress)", r"\1_x"),
    (r"true_stress", r"cauchy_x"),
    (r"axial_(stretch|force)", r"\1_axial"),
    (r"((?:inner|outer)_(?:radius|diameter)|stretch_axial|pressure)", r"\1"),
)
"""Names of columns by other conventions, in small letters with _ for blanks, and ours for each."""
_OF_TUBES = (
    (r"(?:lambda|λ|stretch)_?z", r"stretch_axial"),
    (r"od", r"outer_diameter"),
    (r"id", r"inner_diameter"),
    (r"p", r"pressure"),
)
_ROUND_OFF = 1e-6  # s by which equal times may differ
_MANY, _MINUTES = 500, 1.0 / 180.0  # states worth a word, and what each takes on one core
_MACHINES = {
    r"(extension|displacement|elongation|crosshead).*": "over the length at rest is strain_x [-]",
    r"(load|force)(_.*)?": "is force_x, beside a column area_x [mm2]",
    r"(log|true|hencky)_?strain.*": "is the logarithm of stretch_x",
}
"""What columns of testing machines are."""


@dataclass(frozen=True, eq=False, repr=False)
class Specimen(ForwardProblem):
    """The states of a tested piece of tissue, and the law that its stresses follow from.

    Parameters
    ----------
    name : used in messages and reports.
    states : the states that are prescribed, m of them; of a tube, those of its wall's points.
    law : hyperelastic law.
    parameters : entries of theta, in order.
    constants : parameters of the law that do not vary.
    fibres, sheets : unit directions of each state (m, 3), or of all (3,), for laws that read them.
    origin : the file that the specimen was read from, as a scene's.
    fibre_rule : the rule by which the directions were made.
    angles : parameters that turn fibres and sheets, as a scene's.
    tube : the sector whose wall's points the states are (:mod:`emulator.specimens.tube`). With
        several layers, region k is layer k from the inside.
    grips : how the piece was held (:mod:`emulator.specimens.piece`).
    table : the table that the states were read from.
    homogeneous : whether somebody said that a piece without ``grips`` deforms evenly. It changes no
        solution: verdicts name the assumption, and by whom it is made.
    viscosity : how the law's stresses relax, as a :class:`Viscosity` or the table of a scene file
        (:mod:`emulator.viscosity`); None for an elastic specimen.
    times : the time of each measured state, s, (d,); without viscosity it is left out.
    """

    name: str
    states: States
    law: Law
    parameters: tuple[Parameter, ...]
    constants: Mapping[str, float] = field(default_factory=dict)
    fibres: np.ndarray | None = None
    sheets: np.ndarray | None = None
    origin: Mapping[str, Any] = field(default_factory=dict)
    fibre_rule: FibreRule | None = None
    angles: tuple[FibreAngles, ...] = ()
    tube: Tube | None = None
    grips: Grips | None = None
    table: Cells | None = None
    homogeneous: bool = False
    viscosity: Viscosity | None = None
    times: np.ndarray | None = None

    solved_by = "emulator.specimens.homogeneous:homogeneous"
    usual_map = "incompressible"
    in_time = False  # its map follows the tests through their times
    timed = False

    @property
    def learned_in_box(self) -> bool:
        """Say whether the stresses of grips were learned from FEM inside the box of theta."""
        return self.grips is not None and self.grips.learned is not None

    def __post_init__(self) -> None:
        H, free, pulls, tests = self.states
        count = len(free)
        rows = MappingProxyType({name: frozen_array(k, int) for name, k in tests.items()})
        states = States(frozen_array(H), frozen_array(free, bool), frozen_array(pulls), rows)
        object.__setattr__(self, "states", states)
        for name in ("constants", "origin"):
            object.__setattr__(self, name, MappingProxyType(dict(getattr(self, name))))
        for name in ("fibres", "sheets"):
            if np.shape(getattr(self, name)) == (3,):
                object.__setattr__(self, name, np.tile(getattr(self, name), (count, 1)))
        if self.tube is not None:
            object.__setattr__(self, "regions", self.tube.regions(count))
        try:
            self._check_time()
            self._check_directions(count, 1)
            self._check_parameters()
            if self.grips is not None and self.homogeneous:
                raise InputError("it has grips, and is said to deform evenly; say one of the two")
            if self.grips is not None and self.states.pulls.any():
                raise InputError(
                    "grips move a specimen; with applied stresses they are not supported: leave "
                    "out one of the two"
                )
            self._check_times()
        except InputError as error:
            raise InputError(f"scene '{self.name}': {error}") from error

    @cached_property
    def measured(self) -> States:
        """A state for each measured one: of a tube, that of the innermost point of the wall."""
        H, free, pulls, tests = self.states
        points = 1 if self.tube is None else self.tube.size
        rows = {name: of_test[::points] // points for name, of_test in tests.items()}
        return States(H[::points], free[::points], pulls[::points], rows)

    def _check_times(self) -> None:
        """Refuse viscosity without times, or with grips."""
        if self.viscosity is None:
            object.__setattr__(self, "times", None)
            return
        if self.times is None:
            raise InputError(f"viscosity needs the time of each state; give '{TIME}', in s")
        if self.viscosity.kind == KELVIN_VOIGT:
            raise InputError(f"viscosity {KELVIN_VOIGT} is for bodies; use prony or spectrum")
        if self.grips is not None:
            raise InputError("grips are solved without time; leave out viscosity or grips")
        object.__setattr__(self, "times", frozen_array(self.times))
        check_times(self.times, self.measured.protocols, len(self.measured.free))

    @cached_property
    def histories(self) -> Histories:
        """The points of the tests through time, of a specimen with viscosity."""
        assert self.times is not None
        size = 1 if self.tube is None else self.tube.size
        return histories(self.states.protocols, self.times, size)

    def read_table(self, path: Path) -> Path | Cells:
        """Return a table's rows, with viscosity those of unloading, too; refuse other times."""
        if self.viscosity is None:
            return super().read_table(path)
        cells = read_cells(path, unloading=True)
        times = read_times(cells)
        assert self.times is not None  # of a specimen with viscosity
        if times.shape != self.times.shape or np.abs(times - self.times).max() > _ROUND_OFF:
            raise InputError(f"data file {path}: times are not those of scene '{self.name}'")
        return cells

    @property
    def node_count(self) -> int:
        """The number of corners of the unit cubes, three for each state."""
        return 3 * len(self.states.free)

    @property
    def mesh(self) -> Mesh:
        """Raise :class:`InputError`: a specimen has no mesh, which places and pictures need."""
        return with_mesh(self).mesh

    def gradients(self, u: jax.Array) -> jax.Array:
        """Return the gradients H (m, 3, 3) from the displacements (3 m, 3) of the unit cubes."""
        return jnp.swapaxes(u.reshape(-1, 3, 3), 1, 2)

    def tissue_at(self, theta: jax.Array) -> Tissue:
        """Return material data at ``theta`` (p,), stacked over the states, (m, ...)."""
        values, directions = self.resolve(theta), self.fibres
        if directions is not None:
            if self.sheets is not None:
                directions = np.stack([directions, self.sheets], axis=1)
            directions = turned(directions[:, None], self.angles, values)[:, 0]
        return Tissue(directions, stiffness_of(self.regions, None, values))

    @cached_property
    def fingerprint(self) -> str:
        """Short hash of states, law, tissue, tube and grips, and of the order and box of theta."""
        description = {"law": law_identity(self.law)}
        description |= described_fields(self, ("law", "parameters"))
        return fingerprint(self, Identity({}, {}, {}, description))

    def summary_rows(self) -> tuple[str, list[tuple[str, str]]]:
        """Return the title, and rows of states, law and theta."""
        count = f"{len(self.measured.free)} in {len(self.states.protocols)} tests"
        return f"Specimen '{self.name}'", [("states", count), *self._summary_of_law()]


def specimen(
    given: States | Mapping[str, Any],
    *,
    ordered: bool = True,
    tube: Tube | None = None,
    **entries: Any,
) -> Specimen:
    """Return a specimen.

    Parameters
    ----------
    given : its states, or the columns (m,) of its tests, as
        :func:`~emulator.specimens.states.states` takes them, with ``protocol``, the test of each
        state, where there are several, and with viscosity ``time`` in s.
    ordered : see there.
    tube : the sector of a tube whose motion ``given`` is, see :mod:`emulator.specimens.tube`.
    entries : the other fields of a :class:`Specimen`.
    """
    if isinstance(given, States):
        return Specimen(states=given, tube=tube, **{"name": "specimen", **entries})
    columns = dict(given)
    tests, times = columns.pop(PROTOCOL, None), columns.pop(TIME, None)
    if times is not None:
        entries = {"times": np.asarray(times, float), **entries}
    timed = entries.get("viscosity") is not None
    names = None if tests is None else list(map(str, tests))
    states = states_in(columns, names, tube=tube, ordered=ordered, timed=timed)
    return Specimen(states=states, tube=tube, **{"name": "specimen", **entries})


def require_specimen(problem: ForwardProblem) -> Specimen:
    """Return ``problem`` if it is a specimen; :class:`InputError` for a scene."""
    if not isinstance(problem, Specimen):
        if problem.components:
            raise InputError(f"scene '{problem.name}' is {problem.noun}, and no specimen")
        raise InputError(f"scene '{problem.name}' is no specimen: give a table of its states")
    return problem


def states_in(
    columns: Mapping[str, Any],
    protocols: list[str] | None = None,
    *,
    tube: Tube | None = None,
    ordered: bool = True,
    timed: bool = False,
) -> States:
    """Return the states that columns (m,) of a table describe, of a piece or of a tube's wall."""
    if tube is not None:
        return tube.states(columns, protocols, ordered=ordered and not timed)
    return states(columns, protocols, ordered=ordered, timed=timed)


def read_states(table: Path | Cells, tube: Tube | None = None, *, timed: bool = False) -> States:
    """Return the states of a table's rows; the column ``protocol`` names their tests.

    timed : as of :func:`~emulator.specimens.states.states`.
    """
    cells = table if isinstance(table, Cells) else read_cells(table)
    path = cells.path
    moving = motion_columns if tube is None else tube_columns
    words, rows = moving(cells.words), list(cells.rows)
    if tube is not None and (pulls := pull_columns(cells.words)):
        raise InputError(
            f"data file {path}, column '{min(pulls.values())}': a tube is stretched and inflated, "
            "not pulled by a given stress; give stretch_axial, pressure and force_axial"
        )
    if tube is None and not words and (of_tube := tube_columns(cells.words)):
        raise InputError(
            f"data file {path} is of a tube ({', '.join(of_tube)}); give the sector that it opens "
            "to: calibrate init --tube, or [tube] in the scene file"
        )
    if not words:
        usual = "stretch_x, strain_x or shear_xy" if tube is None else "outer_radius, stretch_axial"
        raise InputError(
            f"data file {path}: no column says how the specimen moves: {usual}"
            f"{likely_names(cells.words, of_tube=tube is not None)}; it has "
            + ", ".join(filter(None, cells.words))
        )
    for row in rows if BRANCH in cells.words else ():
        if (branch := cells.rows[row][BRANCH]).lower() not in ("", LOADING, UNLOADING):
            raise InputError(
                f"data file {path}: row {row}, column '{BRANCH}' is '{branch}'; give '{LOADING}', "
                f"or '{UNLOADING}' for rows that are left out"
            )
    columns = {w: np.array([cells.number(k, w, gaps=True) for k in rows]) for w in words}
    names = [cells.rows[k][PROTOCOL] for k in rows] if PROTOCOL in cells.words else None
    try:
        if names is not None and "" in names:
            row = names.index("") + 1
            raise InputError(f"row {row}, column '{PROTOCOL}' is empty; name the row's test")
        return states_in(columns, names, tube=tube, timed=timed)
    except InputError as error:
        # States count their rows from 1; in the file others may be between them.
        text = re.sub(r"\brow (\d+)", lambda m: f"row {rows[int(m[1]) - 1]}", str(error))
        raise InputError(f"data file {path}: {text}") from error


def long_table(scene: ForwardProblem) -> list[str]:
    """Say how long an inference takes, where a specimen has many states."""
    count = len(scene.states.free) if isinstance(scene, Specimen) else 0
    if count <= _MANY:
        return []
    return [
        f"{count} states take some {1.0 + _MINUTES * count:.0f} minutes to sample and certify, in "
        f"proportion: a table of the means of {round(2 * count / _MANY)} neighbouring rows tells a "
        "smooth curve as well"
    ]


def likely_names(words: Sequence[str], *, of_tube: bool = False) -> str:
    """Suggest names for columns that follow other conventions."""
    renamed, described = [], []
    conventions = _OF_TUBES + _CONVENTIONS if of_tube else _CONVENTIONS
    for word in words:
        name, unit = with_unit(word)
        plain = name.lower().replace(" ", "_")
        matches = ((re.fullmatch(pattern, plain), ours) for pattern, ours in conventions)
        ours = next((match.expand(ours) for match, ours in matches if match is not None), name)
        if ours != name:
            renamed.append(f"{word} {ours}{f' [{unit}]' if unit else ''}")
        described += [f"{word} {of}" for form, of in _MACHINES.items() if re.fullmatch(form, plain)]
    calls = f"; call {', '.join(renamed)} if they are that" if renamed else ""
    return "; ".join([calls, *described])
