r"""A table of a solver's runs in place of the solver: a Gaussian process of each output.

Each row has a run's parameters and outputs. With both standardised over the rows, an output is

.. math:: y(x) \sim \mathcal{GP}\big(0,\; a^2 [\kappa(\rho) + t\,(1 + x \cdot x') +
    \tau^2 \delta_{xx'}]\big), \qquad \rho^2 = \sum_k (x_k - x'_k)^2 / \ell_k^2,

with Matern's correlation of smoothness 5/2,
:math:`\kappa = (1 + \sqrt5 \rho + \tfrac53 \rho^2)\, e^{-\sqrt5 \rho}`, a linear trend, and a
nugget for what a solver's tolerances scatter. Lengths, trend and nugget are those of the largest
marginal likelihood times a log-normal prior of the lengths (median :math:`e^{3/2}\sqrt{p}`, log-sd
1: an input that does nothing has a long one), on 900 rows at most; :math:`a^2` is the most likely
one.

Outputs of one run are wrong together: errors of processes are drawn with the correlations of their
errors at rows that are left out.

The error at a row that is left out has a closed form, :math:`e_i = (K^{-1} y)_i / (K^{-1})_{ii}`
(Rasmussen and Williams 2006, Eq. 5.12). It is too small where lengths were fitted to that row, too.
So the process is first fitted without a fifth of the rows; by how much its standardised errors
there exceed a Gaussian's at 90 % widens the sd of every output.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.display import counting
from emulator.core.errors import InputError
from emulator.core.gaussian_process import Regression
from emulator.core.kept import kept
from emulator.core.machine import one_blas_thread
from emulator.core.minimise import minimise
from emulator.external.maps import OutputsMap, scores_and_modes
from emulator.external.problem import ExternalProblem, Output, RunAnswer
from emulator.external.tables import RunTable, content_of, read_runs
from emulator.scenes.forward_problem import ForwardProblem
from emulator.scenes.scene import all_nodes
from emulator.surrogates.protocol import Arrays, ForwardKind, ForwardMap, fingerprint_of

_FEWEST = 10  # rows
_MOST, _MOST_TRIED = 900, 400  # rows that lengths are fitted to, and without held-out rows
_HELD_OUT = 5  # one of so many rows is held out
_NORMAL_90 = 1.6449  # sds that a Gaussian has 90 % within
_LOG_LENGTH, _LOG_LENGTH_SD = 1.5, 1.0  # prior of a log length, less half the log of the inputs
_JITTER = 1e-8


@dataclass(frozen=True)
class Rows:
    """A table of runs that somebody made; nothing is run.

    Parameters
    ----------
    file : the table (CSV, spreadsheet, netCDF or Zarr), relative to this file; a row a run.
    columns : its columns whose name is not that of their parameter or output, by that name.
    """

    file: str
    columns: dict[str, str] = field(default_factory=dict)

    kind = "table"
    at_once = 1
    usual_map = "rows"

    def run(self, problem: ExternalProblem, theta: np.ndarray) -> RunAnswer:  # noqa: ARG002
        """Raise :class:`InputError`: there is no solver."""
        raise InputError(
            f"problem '{problem.name}' is a table of runs; there is no solver that could make more"
        )

    def identity(self, folder: Path) -> Any:
        """Return the content of the table, and its columns."""
        return [content_of(_existing(folder / self.file)), self.columns]


def _existing(path: Path) -> Path:
    if not path.exists():
        raise InputError(f"file: there is no table {path}")
    return path


class TableRuns(NamedTuple):
    """Runs of a table: theta (c, p), and outputs (c, n); and how many rows were left out.

    failed : rows without an output. repeated : rows that are there before.
    """

    theta: np.ndarray
    outputs: np.ndarray
    failed: int
    repeated: int


def samples_of(problem: ForwardProblem) -> TableRuns:
    """Return the runs in a problem's table.

    Raises
    ------
    InputError
        A problem of another solver, a missing column, a parameter that is no number or the same in
        all rows, rows of one theta that differ, or fewer rows than 10 or than parameters.
    """
    if not isinstance(problem, ExternalProblem) or not isinstance(problem.solver, Rows):
        raise InputError(f"problem '{problem.name}' is no table of runs")
    named, path = problem.solver.columns, _existing(problem.folder / problem.solver.file)
    table = read_runs(path)
    theta = np.hstack([table.column(named.get(n, n)) for n in problem.parameter_names])
    if theta.shape[1] != len(problem.parameters):
        raise InputError(f"{path}: a parameter has several numbers in a row; give one of each")
    for name, constant in zip(problem.parameter_names, np.ptp(theta, axis=0) == 0.0, strict=True):
        if constant:
            raise InputError(f"{path}: '{name}' is the same in all rows; leave it out")
    outputs = np.hstack([_numbers_of(output, table, named) for output in problem.outputs])
    known = np.isfinite(outputs).all(axis=1)
    _, first, where = np.unique(theta[known], axis=0, return_index=True, return_inverse=True)
    unlike = np.flatnonzero((outputs[known] != outputs[known][first[where]]).any(axis=1))
    if unlike.size:
        row = table.rows[known]
        raise InputError(
            f"{path}: rows {row[first[where[unlike[0]]]]} and {row[unlike[0]]} have the same "
            "parameters and other outputs; a solver that answers at random is not supported"
        )
    once = np.sort(first)
    least = max(_FEWEST, theta.shape[1] + 2)
    if len(once) < least:
        raise InputError(f"{path} has {len(once)} runs with outputs; give {least} or more")
    failed, repeated = int((~known).sum()), int(known.sum()) - len(once)
    return TableRuns(theta[known][once], outputs[known][once], failed, repeated)


def _numbers_of(output: Output, table: RunTable, named: Mapping[str, str]) -> np.ndarray:
    """Return the numbers (c, size) of an output: a field, or a column of each."""
    whole = named.get(output.name, output.name)
    if whole not in table.sizes:
        words = [named.get(column, column) for column in output.columns]
        return np.hstack([table.column(word, gaps=True) for word in words])
    if table.sizes[whole] != output.size:
        raise InputError(
            f"{table.path}: '{whole}' has {table.sizes[whole]} numbers in a row, and the problem's "
            f"file says size = {output.size}"
        )
    return table.column(whole, gaps=True)


class Process(NamedTuple):
    """A Gaussian process of each of m modes of the n outputs of c runs, all standardised.

    at : the runs' positions (c, p). centre, width : by which positions are standardised, (p,).
    mean, sd : those of the outputs over the runs, (n,).
    modes : the modes (m, n) of the standardised outputs. rest : the sd (n,) of what is not in them.
    logs : logarithms of lengths, trend and nugget, (m, p + 2).
    weights : the weights (m, c) of the runs.
    variance : the variance a^2 of each mode, (m,), widened.
    left_out : the error (c, n) at each run by all others, in the output's unit.
    """

    at: np.ndarray
    centre: np.ndarray
    width: np.ndarray
    mean: np.ndarray
    sd: np.ndarray
    modes: np.ndarray
    rest: np.ndarray
    logs: np.ndarray
    weights: np.ndarray
    variance: np.ndarray
    left_out: np.ndarray

    def numbers(self, x: jax.Array) -> jax.Array:
        """Return the outputs (n,) at a position ``x`` (p,)."""
        x, p = (x - self.centre) / self.width, self.at.shape[1]
        # All modes by one product of matrices: |x - at|^2 / l^2 of each mode m and run c.
        rates = np.exp(-2.0 * self.logs[:, :p])
        squared = (rates @ x**2)[:, None] + rates @ self.at.T**2 - 2.0 * (rates * x) @ self.at.T
        trend = np.exp(self.logs[:, -2:-1]) * (1.0 + self.at @ x)
        kernels = _bell(squared) + trend
        return self.mean + self.sd * (jnp.sum(kernels * self.weights, axis=1) @ self.modes)

    def correlations(self) -> np.ndarray:
        """Return the correlations (m, m) of the modes' errors at rows that are left out."""
        sizes = np.sum(self.modes**2, axis=1)
        return correlations(self.left_out / self.sd @ (self.modes / sizes[:, None]).T)


def _root(covariance: np.ndarray) -> np.ndarray:
    """Return the symmetric root of a covariance (n, n), in which signs of eigenvectors cancel."""
    values, vectors = np.linalg.eigh(covariance)
    return (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T


def correlations(errors: np.ndarray) -> np.ndarray:
    """Return the correlations (n, n) of errors (c, n) about zero; of one that is 0, with none."""
    unit = errors / np.where(errors.any(axis=0), np.linalg.norm(errors, axis=0), 1.0)
    return np.where(np.eye(errors.shape[1], dtype=bool), 1.0, unit.T @ unit)


def _kernel(logs: Any, x: Any, y: Any) -> jax.Array:
    """Return the covariances (a, b) of positions (a, p) and (b, p), up to a^2."""
    lengths = jnp.exp(logs[: x.shape[1]])
    a, b = x / lengths, y / lengths
    squared = jnp.sum(a**2, axis=1)[:, None] + jnp.sum(b**2, axis=1) - 2.0 * a @ b.T
    return _bell(squared) + jnp.exp(logs[-2]) * (1.0 + x @ y.T)


def _bell(squared: Any) -> jax.Array:
    """Return Matern's correlation at a squared distance over the lengths."""
    rho = jnp.sqrt(5.0 * jnp.maximum(squared, 0.0) + 1e-12)
    return (1.0 + rho + rho**2 / 3.0) * jnp.exp(-rho)


def _covariance(logs: Any, x: Any) -> jax.Array:
    return _kernel(logs, x, x) + (jnp.exp(logs[-1]) + _JITTER) * jnp.eye(len(x))


@jax.jit
@jax.value_and_grad
def _loss(logs: jax.Array, x: jax.Array, y: jax.Array) -> jax.Array:
    """Return minus the log marginal likelihood and log prior of y (c,), per number."""
    regression = Regression.of(_covariance(logs, x))
    white = regression.whitened(y)
    usual = _LOG_LENGTH + 0.5 * jnp.log(x.shape[1])
    prior = 0.5 * jnp.sum(((logs[: x.shape[1]] - usual) / _LOG_LENGTH_SD) ** 2)
    fit = 0.5 * jnp.log(jnp.mean(white**2)) + jnp.mean(jnp.log(jnp.diagonal(regression.factor)))
    return fit + prior / len(y)


def _fitted_logs(x: np.ndarray, y: np.ndarray, most: int) -> np.ndarray:
    """Return the logarithms (p + 2,) of the kernel of an output (c,) at positions (c, p).

    most : the largest number of rows to fit it to.
    """
    p = x.shape[1]
    # Evenly spaced rows: a table may be sorted.
    rows = np.unique(np.linspace(0, len(x) - 1, min(len(x), most)).round().astype(int))
    low, high = np.append(np.full(p, -1.0), [-12.0, -16.0]), np.append(np.full(p, 8.0), [6.0, 3.0])
    start = np.append(np.full(p, _LOG_LENGTH + 0.5 * np.log(p)), [-2.0, -6.0])
    bounds: dict[str, Any] = {"low": low, "high": high, "iterations": 60, "tolerance": 1e-5}
    at, values = jnp.asarray(x[rows]), jnp.asarray(y[rows])
    return minimise(lambda logs: _loss(jnp.asarray(logs), at, values), start, **bounds).x


class _Fit(NamedTuple):
    """One output's weights (c,), inverse covariance (c, c), and most likely variance."""

    weights: np.ndarray
    inverse: np.ndarray
    variance: float


def _fit(logs: np.ndarray, x: np.ndarray, y: np.ndarray) -> _Fit:
    regression = Regression.of(np.asarray(_covariance(jnp.asarray(logs), jnp.asarray(x))))
    weights, inverse = regression.weights(y), regression.inverse()
    return _Fit(weights, inverse, float(y @ weights / len(y)))


@one_blas_thread()
def process_of(
    positions: np.ndarray, outputs: np.ndarray, progress: Callable[[], Any] = lambda: None
) -> Process:
    """Return the process of outputs (c, n) at positions (c, p) in the box.

    progress : called after each of the fits, two for each mode.
    """
    centre, width = positions.mean(axis=0), positions.std(axis=0)
    mean, sd = outputs.mean(axis=0), outputs.std(axis=0)
    constant = np.ptp(outputs, axis=0) == 0.0
    sd = np.where(constant, 1.0, sd)
    x, whole = (positions - centre) / width, (outputs - mean) / sd
    y, modes = scores_and_modes(whole)
    missed = whole - y @ modes
    held_out = np.arange(len(x)) % _HELD_OUT == _HELD_OUT - 1
    ratio = _excess(x, y, held_out, progress)
    logs = _every(x, y, _MOST, progress)
    fits = [_fit(h, x, column) for h, column in zip(logs, y.T, strict=True)]
    left_out = np.stack([f.weights / np.diagonal(f.inverse) for f in fits], axis=1) @ modes
    left_out = (left_out + missed) * sd
    variance = np.array([f.variance for f in fits]) * ratio**2
    weights = np.stack([f.weights for f in fits])
    rest = missed.std(axis=0)
    return Process(x, centre, width, mean, sd, modes, rest, logs, weights, variance, left_out)


def _every(x: np.ndarray, y: np.ndarray, most: int, progress: Callable[[], Any]) -> np.ndarray:
    """Return the logarithms (n, p + 2) of the kernels of all outputs (c, n)."""
    logs = []
    for column in y.T:
        logs.append(_fitted_logs(x, column, most))
        progress()
    return np.stack(logs)


def _excess(
    x: np.ndarray, y: np.ndarray, held_out: np.ndarray, progress: Callable[[], Any]
) -> float:
    """Return by how much errors at held-out rows exceed what processes of the others foresee."""
    known, fresh = ~held_out, held_out
    ratios = []
    for logs, column in zip(_every(x[known], y[known], _MOST_TRIED, progress), y.T, strict=True):
        fit = _fit(logs, x[known], column[known])
        kernel = np.asarray(_kernel(jnp.asarray(logs), x[fresh], x[known]))
        error = column[fresh] - kernel @ fit.weights
        ratios.append(
            np.abs(error) / np.sqrt(fit.variance * _variances(fit, logs, kernel, x[fresh]))
        )
    return max(float(np.quantile(np.concatenate(ratios), 0.9)) / _NORMAL_90, 1.0)


def _variances(fit: _Fit, logs: np.ndarray, kernel: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return variances (a,) at positions (a, p) of covariances (a, c) with the runs, up to a^2."""
    of_prior = 1.0 + np.exp(logs[-2]) * (1.0 + (x**2).sum(axis=1)) + np.exp(logs[-1])
    explained = np.einsum("ij,jk,ik->i", kernel, fit.inverse, kernel)
    return np.maximum(of_prior - explained, np.exp(logs[-1]) + _JITTER)


@dataclass(frozen=True, eq=False)
class RowsMap(OutputsMap):
    """The outputs of a table of runs, by a Gaussian process of each.

    process : the processes of all outputs.
    """

    process: Process

    kind = "rows"
    label = "Gaussian process of a table of runs"

    @cached_property
    def fingerprint(self) -> str:
        """Short hash of the problem, the rows and the processes."""
        return fingerprint_of(self.kind, self.scene.fingerprint, self.nodes, *self.process)

    def numbers(self, x: jax.Array) -> jax.Array:
        """Return all outputs (n,) at a position (p,) in the box."""
        return self.process.numbers(x)

    def drawn_errors(
        self, theta: np.ndarray, outputs: np.ndarray, count: int, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return functions of what the rows leave open, and their sds, in the outputs' units.

        theta : the points (a, p). outputs : the numbers (k,) of the outputs.
        count : the number of functions, drawn jointly at all points.

        Returns
        -------
        Errors (count, a, k), and sds (a, k).
        """
        p = self.process
        x = (np.asarray(self.scene.to_unit(jnp.asarray(theta))) - p.centre) / p.width
        modes = p.modes[:, outputs]
        correlated = p.correlations()
        together = _root(correlated)
        errors = rng.normal(size=(count, len(x), len(outputs))) * p.rest[outputs]
        normals = rng.normal(size=(count, len(x), len(modes))) @ together.T
        roots = np.zeros((len(modes), len(x), len(x)))
        for k in np.flatnonzero(modes.any(axis=1)):
            logs = jnp.asarray(p.logs[k])
            regression = Regression.of(np.asarray(_covariance(logs, p.at)))
            whitened = regression.whitened(np.asarray(_kernel(logs, p.at, x)))
            remaining = np.asarray(_covariance(logs, x)) - whitened.T @ whitened
            remaining *= p.variance[k]
            roots[k] = _root(remaining)  # singular where two draws are one
            errors += (normals[..., k] @ roots[k])[..., None] * modes[k]
        between = correlated * np.einsum("kab,lab->akl", roots, roots, optimize=True)
        variances = p.rest[outputs] ** 2 + np.einsum("kj,akj->aj", modes, between @ modes)
        return errors * p.sd[outputs], np.sqrt(np.maximum(variances, 0.0)) * p.sd[outputs]

    def arrays(self) -> Arrays:
        """Return all that gives a value, by name."""
        return self.process._asdict()


@kept
def process_in(problem: ForwardProblem) -> Process:
    """Return the process of a problem's table, which the problem keeps; see :func:`samples_of`."""
    samples = samples_of(problem)
    positions = np.asarray(problem.to_unit(jnp.asarray(samples.theta)))
    with counting(desc="fits to the table", unit="fit") as bar:
        return process_of(positions, samples.outputs, bar.update)


def rows_map(problem: ForwardProblem) -> RowsMap:
    """Return the map of a problem's table of runs; errors as of :func:`samples_of`."""
    process = process_in(problem)
    assert isinstance(problem, ExternalProblem)
    return RowsMap(problem, all_nodes(problem), process)


def _restored(scene: ForwardProblem, arrays: Arrays) -> ForwardMap:
    assert isinstance(scene, ExternalProblem)
    process = Process(**{name: np.asarray(arrays[name]) for name in Process._fields})
    return RowsMap(scene, all_nodes(scene), process)


def _arrays(forward: ForwardMap) -> Mapping[str, np.ndarray]:
    assert isinstance(forward, RowsMap)
    return forward.arrays()


ROWS = ForwardKind(
    "rows",
    "Gaussian processes of a table of somebody else's runs",
    lambda ingredients, _: rows_map(ingredients.scene),
    (),
    _arrays,
    _restored,
    closer="more rows near the posterior",
)
