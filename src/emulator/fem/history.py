r"""A body in time and the loads that it goes through, as one problem of its tissue.

A table has the time and the loads of every row; theta has the tissue's parameters alone. The answer
at theta is the displacement of every node at every row, one row after the other,

.. math:: u(\theta) = (u_1, \dots, u_m), \qquad u_i = u_i(\theta; \ell_1, t_1, \dots, \ell_i, t_i),

because a body with a past has no answer at one time alone. Tests, which a column ``protocol``
names, each begin at rest.
"""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.cells import PROTOCOL, Cells, read_cells
from emulator.core.engine import STAYS, Engine, engine_of
from emulator.core.errors import InputError, SolverError
from emulator.core.units import IN_KPA, factor, with_unit
from emulator.fem.after_time import slopes_through_time
from emulator.fem.newton import NewtonOptions
from emulator.fem.simulator import Simulator
from emulator.fem.solution import Solution, Status
from emulator.fem.through_time import system_of
from emulator.geometry.io import write_solution
from emulator.mechanics.laws import Law
from emulator.mechanics.laws.law import Quantity
from emulator.scenes.forward_problem import ForwardProblem, Owners
from emulator.scenes.identity import Identity, fingerprint
from emulator.scenes.parameter_space import Parameter
from emulator.scenes.scene import Scene
from emulator.scenes.tissue import Tissue
from emulator.viscosity.times import TIME, check_times, read_times

_OPTIONS = NewtonOptions.load_steps(1, most=100)  # a step that converges takes a few iterations
_SAME_TIME = 1e-9  # relative difference of times that are equal


@dataclass(frozen=True, eq=False, repr=False)
class BodyInTime(ForwardProblem):
    """A body in time, with the loads that it goes through.

    Parameters
    ----------
    name : used in messages and reports.
    scene : the body, whose theta has the time and the loads besides the tissue.
    parameters : the entries of theta, those of the scene that no column knows.
    known : the time in s and the loads of every row, (m,) each, by the scene's parameter.
    tests : the rows (k,) of each test, in the order of time, by its name.
    table : the table they are from, with data in further columns.
    origin : the file that the problem was read from.
    """

    name: str
    scene: Scene
    parameters: tuple[Parameter, ...]
    known: Mapping[str, np.ndarray]
    tests: Mapping[str, np.ndarray]
    table: Cells | None = None
    origin: Mapping[str, Any] = field(default_factory=dict)

    solved_by = "emulator.fem.history:HistorySolver"
    observed_by = "calibrate.measurements.in_time:kinds_in_time"
    refined_by = "calibrate.statistical_model.finer_history:finer_history"
    noun = "a body that goes through a history"
    components = 3

    def __post_init__(self) -> None:
        for name in ("known", "tests", "origin"):
            object.__setattr__(self, name, MappingProxyType(dict(getattr(self, name))))
        if not self.parameters:
            raise InputError("no parameter varies, nothing to calibrate")

    @property
    def constants(self) -> Mapping[str, float]:  # type: ignore[override]
        """The scene's constants."""
        return self.scene.constants

    @property
    def law(self) -> Law:  # type: ignore[override]
        """The scene's law."""
        return self.scene.law

    @property
    def times(self) -> np.ndarray:
        """The time of every row, (m,) s."""
        return self.known[TIME]

    @property
    def node_count(self) -> int:
        """The number of all nodes at all rows."""
        return len(self.times) * self.scene.node_count

    def rows_of(self, u: jax.Array) -> jax.Array:
        """Return the displacement (..., m, k, 3) of nodes, from that of all rows, (..., m k, 3)."""
        return u.reshape(*u.shape[:-2], len(self.times), -1, 3)

    @property
    def halved(self) -> BodyInTime:
        """The body with a row halfway to each of its rows, which are 1, 3, 5, ... then."""
        known = {name: np.repeat(values, 2) for name, values in self.known.items()}
        for rows in self.tests.values():
            for name, values in self.known.items():
                before = np.concatenate([[0.0], values[rows][:-1]])
                known[name][2 * rows] = 0.5 * (before + values[rows])
        tests = {n: np.column_stack([2 * t, 2 * t + 1]).ravel() for n, t in self.tests.items()}
        return replace(self, known=known, tests=tests, table=None)

    def thetas(self, theta: jax.Array) -> jax.Array:
        """Return the scene's theta at every row, (m, q), from the tissue's theta (p,)."""
        at = {name: theta[k] for k, name in enumerate(self.parameter_names)} | dict(self.known)
        columns = [jnp.broadcast_to(at[n], self.times.shape) for n in self.scene.parameter_names]
        return jnp.stack(columns, axis=-1)

    def gradients(self, u: jax.Array) -> jax.Array:
        """Return ``H = du/dX`` at every row and point, (m, e, q, 3, 3), from ``u`` (n, 3) in mm."""
        return jax.vmap(self.scene.gradients)(self.rows_of(u))

    def tissue_at(self, theta: jax.Array) -> Tissue:
        """Return material data at ``theta`` (p,), which is the same at every row."""
        return self.scene.tissue_at(self.thetas(theta)[0])

    def read_table(self, path: Path) -> Cells:
        """Return the rows of a data file; :class:`InputError` where they are not the history's."""
        cells = _cells(path)
        if len(cells.rows) != len(self.times):
            raise InputError(
                f"data file {path}: {len(cells.rows)} rows; the history of scene '{self.name}' has "
                f"{len(self.times)}, and the data a row each: leave cells empty where nothing was "
                "measured"
            )
        times = read_times(cells)
        scale = max(1.0, float(self.times.max()))
        if (other := np.flatnonzero(abs(times - self.times) > _SAME_TIME * scale)).size:
            raise InputError(
                f"data file {path}: row {other[0] + 1}: time is {times[other[0]]:g} s, and "
                f"{self.times[other[0]]:g} in the history of scene '{self.name}'"
            )
        return cells

    def _owners(self) -> Owners:
        owners = self.scene._owners()
        return {name: owners[name] for name in self.parameter_names}

    @cached_property
    def fingerprint(self) -> str:
        """Short hash of the scene, the history, and the order and box of theta."""
        description = {
            "scene": self.scene.fingerprint,
            "known": {name: values.tolist() for name, values in sorted(self.known.items())},
            "tests": [rows.tolist() for rows in self.tests.values()],
        }
        return fingerprint(self, Identity({}, {}, {}, description))

    def summary_rows(self) -> tuple[str, list[tuple[str, str]]]:
        """Return the title, and rows of the scene, its history and theta."""
        title, rows = self.scene.summary_rows()
        history = f"{len(self.times)} times to {self.times.max():g} s"
        if len(self.tests) > 1:
            history += f" in {len(self.tests)} tests"
        known = ", ".join(name for name in self.known if name != TIME) or "no loads"
        return title, [*rows[:-1], ("history", f"{history}, {known}"), self._summary_of_law()[1]]


@dataclass(frozen=True, eq=False)
class HistorySolver:
    """Solves a body at every row of its history.

    scene : the body in time.
    executor : the executor or the words of an engine that does many solves, as a simulator's.
    options : the controls of Newton's method.
    """

    scene: BodyInTime
    executor: Executor | str | None = field(default=None, metadata={STAYS: True})
    options: NewtonOptions = _OPTIONS

    sent_once = True

    @cached_property
    def engine(self) -> Engine | None:
        """The engine that does many solves; None for threads of this process."""
        return engine_of(self.executor)

    @property
    def stepwise(self) -> bool:
        """A factor is kept between solves on a large mesh."""
        return system_of(self.scene.scene).kept is not None

    @cached_property
    def steps(self) -> Simulator:
        """The simulator that goes through the times."""
        return Simulator(self.scene.scene, self.options)

    def solve(self, theta: jax.Array, start: jax.Array | None = None) -> Solution:  # noqa: ARG002
        """Return the displacements (n, 3) mm of all rows at ``theta`` (p,), from rest.

        The status is that of the first step that fails. Differentiable in ``theta``.
        """
        theta = jnp.asarray(theta, dtype=float)
        steps = _along(self.scene, self.steps, theta)
        failed = jnp.argmax(steps.status != Status.CONVERGED)
        return Solution(
            steps.displacement.reshape(-1, 3),
            steps.status[failed],
            steps.iterations.sum(),
            steps.factorisations.sum(),
            steps.residual.max(),
            steps.load_reached.min(),
        )

    def __call__(self, theta: jax.Array) -> jax.Array:
        """Return the displacements (n, 3) mm; :class:`SolverError` where a step fails."""
        solution = self.solve(theta)
        if isinstance(solution.status, jax.core.Tracer):
            return solution.displacement
        return solution.require_converged(f"a step of '{self.scene.name}'").displacement

    def sensitivities(self, u: jax.Array, theta: jax.Array) -> jax.Array:
        """Return the derivatives (p, n, 3) of the displacements ``u`` (n, 3) mm of all rows."""
        body, rows = self.scene, self.scene.rows_of(u)
        directions = jax.jacfwd(body.thetas)(theta)[0].T  # the same at every row
        slopes, thetas = jnp.zeros((len(directions), *rows.shape)), body.thetas(theta)
        for test in body.tests.values():
            of_test = slopes_through_time(body.scene, rows[test], thetas[test], directions)
            slopes = slopes.at[:, test].set(of_test)
        if not np.isfinite(slopes).all():
            raise SolverError(f"a step of '{body.name}' has no derivatives: singular tangent")
        return slopes.reshape(len(directions), *u.shape)

    def is_stable(self, u: jax.Array, theta: jax.Array) -> bool | None:  # noqa: ARG002
        """Return None: a step is a minimum given its past, which says nothing of another past."""
        return None


def _along(body: BodyInTime, simulator: Simulator, theta: jax.Array) -> Solution:
    """Return the solution of every row, (m, ...)."""
    thetas = body.thetas(theta)
    rows = np.concatenate(list(body.tests.values()))
    paths = [simulator.path(thetas[test]) for test in body.tests.values()]
    joined = jax.tree.map(lambda *parts: jnp.concatenate(parts), *paths)
    return cast(Solution, jax.tree.map(lambda values: values[np.argsort(rows)], joined))


def body_in_time(path: Path, parameters: tuple[Parameter, ...], **entries: Any) -> BodyInTime:
    """Return a body with the history in the table ``path``.

    Parameters
    ----------
    path : a CSV file or a spreadsheet with a column ``time``, one for each load that varies, and
        ``protocol`` where there are several tests; loads in kPa and mm or the unit they say.
    parameters : the parameters of the tissue, and loads that are the same in all rows.
    entries : further fields of the scene.

    Raises
    ------
    InputError
        No times, a time that falls, a cell that is no number, a parameter that is in the table too.
    """
    cells = read_cells(path, unloading=True)
    parts = (*entries.get("loads", ()), *entries.get("supports", ()))
    taken = {quantity.name: quantity for part in parts for quantity in part.quantities}
    known = {TIME: read_times(cells)} | {
        name: _column(cells, word, taken[name])
        for word, (name, _) in ((word, with_unit(word)) for word in cells.words)
        if name in taken
    }
    rates = any(support.resists_velocity for support in entries.get("supports", ()))
    if not rates and entries.get("viscosity") is None and entries.get("inertia") is None:
        raise InputError(
            f"nothing in it depends on time, and it has the history {path.name}; give [viscosity], "
            "[inertia] or dashpots, or leave the history out"
        )
    tests = _tests(cells)
    check_times(known[TIME], tests, len(known[TIME]))
    for parameter in parameters:
        if parameter.name in known:
            raise InputError(
                f"parameter '{parameter.name}' is a column of {path.name}, where it is known; "
                "leave one of them out"
            )
    of_history = [
        Parameter(name, "s" if name == TIME else taken[name].unit, *_range(values))
        for name, values in known.items()
    ]
    scene = Scene(parameters=(*parameters, *of_history), **entries)
    origin = entries.get("origin", {})
    return BodyInTime(scene.name, scene, parameters, known, tests, _cells(path), origin)


def half_steps_error(body: BodyInTime, u: jax.Array, theta: jax.Array) -> float:
    """Return by how much steps half as long move a node from ``u`` (n, 3) at most, in mm."""
    finer = body.halved
    other = finer.rows_of(HistorySolver(finer)(theta))[1::2]
    return float(jnp.linalg.norm(other - body.rows_of(u), axis=-1).max())


def write_history(path: str | Path, body: BodyInTime, u: jax.Array) -> Path:
    """Write the displacement (n, 3) mm as a VTU of each row, and a list of them with their times.

    Return the list, a .pvd beside ``path``, which programs such as ParaView play.
    """
    path, lines = Path(path), list[str]()
    for row, shape in enumerate(np.asarray(body.rows_of(u))):
        file = path.with_name(f"{path.stem}_{row + 1}.vtu")
        write_solution(file, body.scene.mesh, shape, {})
        lines.append(f'<DataSet timestep="{body.times[row]:g}" file="{file.name}"/>')
    listing = path.with_suffix(".pvd")
    whole = ['<VTKFile type="Collection" version="0.1"><Collection>', *lines]
    listing.write_text("\n".join([*whole, "</Collection></VTKFile>", ""]))
    return listing


def _cells(path: Path) -> Cells:
    """Return a table with ``NA`` in empty cells: a row each time, whether or not measured."""
    cells = read_cells(path, unloading=True)
    rows = {k: {word: cell or "NA" for word, cell in row.items()} for k, row in cells.rows.items()}
    return cells._replace(rows=rows)


def _column(cells: Cells, word: str, quantity: Quantity) -> np.ndarray:
    """Return the numbers (m,) of a load's column in the unit that the load takes."""
    known = IN_KPA if quantity.unit == "kPa" else {quantity.unit: 1.0}
    scale = factor(word, with_unit(word)[1], quantity.unit, known)
    return scale * np.array([cells.number(row, word) for row in cells.rows])


def _range(values: np.ndarray) -> tuple[float, float]:
    """Return a range that holds values (m,) and 0."""
    low, high = min(0.0, float(values.min())), max(0.0, float(values.max()))
    return (low, high) if low < high else (low, low + 1.0)


def _tests(cells: Cells) -> dict[str, np.ndarray]:
    """Return the rows (k,) of each test, from 0, by its name."""
    names = [row.get(PROTOCOL, "") for row in cells.rows.values()]
    if PROTOCOL in cells.words and "" in names:
        row = list(cells.rows)[names.index("")]
        raise InputError(f"row {row}, column '{PROTOCOL}' is empty; name the row's test")
    return {name: np.flatnonzero([n == name for n in names]) for name in dict.fromkeys(names)}
