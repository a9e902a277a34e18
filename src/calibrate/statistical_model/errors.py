r"""Models whose data have errors besides noise: declared, described in a run, or learned from FEM.

The errors themselves, and how they are integrated out, are in :mod:`calibrate.model_error`. They
need Gaussian noise of known standard deviation, whose information they are marginalised beside.

**Learned.** The forward map's data :math:`g(x)` differ from FEM's by :math:`e(x) = g_\text{FEM}(x)
- g(x)`. The error is treated as noise whose covariance depends on the unknowns x, so that a poor
map widens the posterior,

.. math:: y = g(x) + e(x) + \varepsilon, \qquad
          e(x) \sim N\left(0,\ \alpha(x)^2\, A^T A\right)

(the approximation error of Kaipio and Somersalo 2007, with a size that varies). It is learned from
n FEM runs at draws of the prior: :math:`\alpha(x_j) \propto |W^{1/2} e_j|`, with W the information
of the noise about its mean, is interpolated between the runs by a Gaussian kernel on
:math:`\log \alpha`, its width chosen by leaving runs out; and :math:`A^T A` is the mean of
:math:`e_j e_j^T / \hat\alpha_{-j}(x_j)^2`, with each run's size predicted from the others, so that
sizes that are hard to predict make the error larger.

The error has no mean: it does not correct the map, it says how far to believe it. Where the runs
were on a finer mesh, the error is the mesh's as well, and FEM on the mesh is allowed the same.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from calibrate.model_error.algebra import check_algebra, marginalised
from calibrate.model_error.kinds import Measurement, read_systematic
from calibrate.model_error.marginal import LEARNED, Amplitude, ModelError, Term, times
from calibrate.model_error.systematic import Systematic
from calibrate.noise import information_about_means
from calibrate.statistical_model.fem_likelihood import FEMLikelihood
from calibrate.statistical_model.finer_fem import finer_fem
from calibrate.statistical_model.model import Model
from calibrate.statistical_model.moves import FEMAnswer, largest_move
from calibrate.statistical_model.predictive import Predictive, noise_sds
from emulator.accuracy.estimate import newton_distance
from emulator.accuracy.mesh_error import MeshErrorEstimate
from emulator.core.display import counting
from emulator.core.errors import InputError, SolverError
from emulator.core.gaussian_process import kernel_mean
from emulator.fem import Simulator
from emulator.fem.compiled import compiled
from emulator.fem.solution import EquilibriumSolver

FEWEST = 8  # FEM runs from which an error is learned
_MODES = 12
_STEPS = 12  # Newton steps of a round that tell the map's error, over all load states
_FEWEST_ANSWERS = 4  # points of a round, and FEM runs where Newton steps are refused
_CLOUD = 1024  # draws that points are put around
_WIDTHS = np.geomspace(0.05, 2.0, 12)  # kernel widths in standardised unknowns


def with_systematic(model: Model, *errors: Systematic) -> Model:
    """Return ``model`` whose data have these errors besides their noise.

    Raises
    ------
    InputError
        No errors are given, one does not fit the model's observations, or the errors or the noise
        lack what is needed to integrate them out.
    """
    if not errors:
        raise InputError("systematic errors: give one or more")
    terms = [error.term(model.observe.shapes) for error in errors]
    return replace(model, error=_joined(model, "systematic errors", terms))


def with_described_errors(
    model: Model, data: Mapping[str, Any], descriptions: Mapping[str, Mapping[str, Any]]
) -> tuple[Model, Mapping[str, jax.Array]]:
    """Return ``model`` of the present values with the described errors, and these values.

    data : the data by the observation's name, NaN where missing.
    descriptions : the description of each error as in an experiment file, by the error's name.

    Errors as of :func:`errors_of_data`.
    """
    # The scale of data is checked against the model with its errors, not against this one.
    reduced, present = replace(model, check_scale=False).given(data)
    error = errors_of_data(reduced, descriptions)(present)
    return replace(reduced, check_scale=model.check_scale, error=error), present


def errors_of_data(
    model: Model, descriptions: Mapping[str, Mapping[str, Any]]
) -> Callable[[Mapping[str, Any]], ModelError]:
    """Return the function from data without missing values to the errors that ``model`` then has.

    It may be called for many data sets: all that does not depend on the data is computed once.

    :class:`InputError` where an error does not fit, by its name; and as :func:`with_systematic`.
    """
    kinds = {name: read_systematic(name, description) for name, description in descriptions.items()}
    check_algebra("systematic errors", model.noise)
    parameters = model.forward.scene.parameter_names
    states = zip(model.states.states, model.states.entries, strict=True)
    theta = {state: dict(zip(parameters, row, strict=True)) for state, row in states}

    def error_of(data: Mapping[str, Any]) -> ModelError:
        arrays = {name: np.asarray(values) for name, values in data.items()}
        measurement = Measurement(model.observe, arrays, theta)
        terms = []
        for name, kind in kinds.items():
            try:
                error = measurement.present(kind.systematic(name, measurement))
                terms.append(error.term(model.observe.shapes))
            except InputError as wrong:
                raise InputError(f"systematic '{name}': {wrong}") from wrong
        return _joined(model, "systematic errors", terms)

    return error_of


def _joined(model: Model, what: str, terms: Sequence[Term]) -> ModelError:
    """Return the errors of ``model``'s data and these terms together, integrated out.

    :class:`InputError`, which begins with ``what``, where they lack a property that this needs.
    """
    every = (*model.error.declarations, *terms)
    check_algebra(what, model.noise, {term.unknown_size for term in every} - {""})
    error = marginalised(every, _information(model))
    if taken := error.priors.keys() & replace(model, error=ModelError()).names:
        raise InputError(f"{what}: a size is called '{taken.pop()}', as an unknown of the model")
    return error


def _information(model: Model) -> np.ndarray:
    """Return the information (d, d) of the noise about the data's means, or its diagonal (d,)."""
    means = {name: jnp.zeros(shape) for name, shape in model.observe.shapes.items()}
    return np.asarray(information_about_means(model.noise, means))


def with_error(
    model: Model,
    simulator: EquilibriumSolver,
    runs: int = 24,
    *,
    of_mesh: bool = False,
    seed: int = 0,
    progress: bool = False,
) -> Model:
    """Return ``model`` whose likelihood allows for the forward map's own error.

    FEM is solved at ``runs`` draws of the prior, from the map's predictions.

    Parameters
    ----------
    of_mesh : whether to solve on the next finer mesh of the body, or a specimen between its grips,
        so that this error is allowed for, too.
    seed : the seed from which the draws of the prior are drawn.

    Raises
    ------
    InputError
        Fewer than 8 runs, the simulator of another scene, noise that is not Gaussian or of unknown
        sd, no finer mesh (:func:`~emulator.accuracy.mesh_error.mesh_error`), or fewer than 8 draws
        at which both FEM and the map have an answer.
    """
    if runs < FEWEST:
        raise InputError(f"error of the forward map: {runs} FEM runs; give {FEWEST} or more")
    if simulator.scene.fingerprint != model.forward.scene.fingerprint:
        raise InputError("error of the forward map: the simulator is for another scene")
    systematic = model.error.systematic.declarations
    sizes = {LEARNED, *(term.unknown_size for term in systematic)} - {""}
    check_algebra("error of the forward map", model.noise, sizes)
    predict = jax.jit(model.predict)
    fem = FEMLikelihood(model, simulator)
    finer = finer_fem(model, simulator) if of_mesh else None
    known: list[MeshErrorEstimate] = []

    def solve(draw: Mapping[str, Any]) -> np.ndarray | None:
        """Return FEM's data, flat (m,); None where it does not converge."""
        if finer is not None:
            try:
                pair = finer(draw, known)
            except SolverError:
                return None
            known.extend(pair.estimates)
            return pair.fine
        if (solved := next(fem.equilibria([draw]))[1]) is None:
            return None
        seen = jnp.stack([field.displacement[model.observe.nodes] for field in solved])
        return np.asarray(ravel_pytree(model.observe(seen, model.states.thetas(draw)))[0])

    draws = model.prior_draws(jax.random.key(seed), runs)
    unknowns, errors = [], []
    what = "error of map and mesh" if of_mesh else "error of the map"
    for k in counting(range(runs), what, disable=not progress, unit="run"):
        values = {name: draw[k] for name, draw in draws.items()}
        means, valid = predict(values)
        if bool(valid) and (exact := solve(values)) is not None:
            errors.append(exact - np.asarray(ravel_pytree(means)[0]))
            unknowns.append([float(values[name]) for name in model.states.unknowns])
    if len(errors) < FEWEST:
        raise InputError(
            f"error of the forward map: FEM and the map answered at {len(errors)} of {runs} draws "
            f"of the prior; {FEWEST} are needed"
        )
    information = _information(model)
    term = fit(np.array(unknowns), np.array(errors), information, of_mesh=of_mesh)
    return replace(model, error=marginalised([*systematic, term], information))


class MapErrors(NamedTuple):
    """Sizes of a forward map's error, and the moves of posterior means that follow.

    sizes : the error of the data at draws in noise sd, as of :func:`in_noise_sd`, by the
        observation's name.
    moves : the largest move of a mean of an unknown, in posterior sd, that FEM in place of the map
        is expected to make (:mod:`calibrate.statistical_model.moves`); NaN where too few draws
        were answered, infinite where FEM failed at one or finds a part that the posterior lacks.
    """

    sizes: Mapping[str, float]
    moves: float


NOT_ASKED = MapErrors({}, np.nan)
"""The errors of a map that was not compared with FEM."""


def map_errors(
    model: Model,
    simulator: Simulator,
    draws: Mapping[str, np.ndarray],
    data: Mapping[str, Any],
) -> MapErrors:
    """Return the sizes of the map's errors, and the moves of posterior means that follow.

    A Newton step at a few draws and at points around them tells FEM's answer, where the step's own
    check accepts it. Where it accepts fewer than four at draws, FEM runs make it four, and there
    may be as many elsewhere; the errors are infinite where FEM fails at a draw.

    draws : draws (s,) by the unknown's name, or by an inferred noise sd's.
    data : the data by the observation's name.
    """
    # Equations of a body that is loaded at rest are of two displacements: at rest, and from there.
    if simulator.scene.loaded_by or model.error.is_learned:
        return NOT_ASKED
    distance = compiled(partial(newton_distance, simulator.system))
    observe, predict, means = model.observe, jax.jit(model.full), jax.jit(model.means)
    predictive, rng = Predictive(model, dict(data), draws), np.random.default_rng(0)
    count = max(_STEPS // len(model.states.states), _FEWEST_ANSWERS)

    def by_newton(u: jax.Array, theta: jax.Array) -> jax.Array:
        step = distance(u, theta)
        return u - step.error if step.accepted else jnp.full_like(u, jnp.nan)

    def by_fem(u: jax.Array, theta: jax.Array) -> jax.Array:
        solution = simulator.solve(theta, u)
        return solution.displacement if solution.converged else jnp.full_like(u, jnp.nan)

    def answer(z: np.ndarray, equilibrium: Callable[..., jax.Array]) -> FEMAnswer | None:
        """Return FEM's answer at z (p,); None where there is none."""
        draw = {name: values[0] for name, values in predictive.constrain(z[None]).items()}
        thetas = model.states.thetas(draw)
        u = jnp.stack([equilibrium(predict(theta), theta) for theta in thetas])
        exact = observe(u[:, observe.nodes], thetas)
        error = np.asarray(ravel_pytree(exact)[0] - ravel_pytree(means(thetas)[0])[0])
        if not np.isfinite(error).all():
            return None
        height = float(model.fem_log_likelihood(draw, exact, data))
        return FEMAnswer(z, error, height) if np.isfinite(height) else None

    def ask(points: np.ndarray, runs: int) -> tuple[list[FEMAnswer], bool]:
        """Return the answers at points (k, p), ``runs`` at most by FEM, and whether one failed."""
        steps = [answer(z, by_newton) for z in points]
        refused = [z for z, step in zip(points, steps, strict=True) if step is None]
        asked = np.linspace(0, len(refused) - 1, min(runs, len(refused))).astype(int)
        solved = [answer(refused[k], by_fem) for k in asked]
        answers = [a for a in (*steps, *solved) if a is not None]
        return answers, any(a is None for a in solved)

    z = predictive.unconstrain(draws)
    rows = np.linspace(0, len(z) - 1, count + 2)[1:-1].astype(int)
    known, failed = ask(z[np.unique(rows)], _FEWEST_ANSWERS)
    if failed or len(known) < _FEWEST_ANSWERS:
        sizes = dict.fromkeys(observe.parts, np.inf) if failed else {}
        return MapErrors(sizes, np.inf if failed else np.nan)
    sizes = in_noise_sd(model, np.array([a.error for a in known]), draws)
    some = z[np.linspace(0, len(z) - 1, min(_CLOUD, len(z))).astype(int)]
    left = [_FEWEST_ANSWERS]

    def ask_further(points: np.ndarray) -> list[FEMAnswer]:
        answers, _ = ask(points, left[0])
        left[0] -= min(left[0], len(points) - len(answers))
        return answers

    return MapErrors(sizes, largest_move(predictive, some, known, ask_further, count, rng))


def in_noise_sd(
    model: Model, errors: np.ndarray, draws: Mapping[str, np.ndarray]
) -> dict[str, float]:
    """Return the size of the map's errors in noise sd, by the observation's name.

    Root mean squares over its numbers, medians over draws; empty if the likelihood allows for them.

    errors : the map's data less FEM's at draws, flat (s, m).
    draws : draws (s,) by the unknown's name, of which an inferred noise sd is taken.
    """
    if not len(errors) or model.error.is_learned:
        return {}
    sizes, sds = {}, noise_sds(model, draws)
    for name, values in jax.vmap(model.observe.unravel)(jnp.asarray(errors)).items():
        square = np.square(np.asarray(values).reshape(len(errors), -1))
        sizes[name] = float(np.median(np.sqrt(square.mean(axis=1))) / sds[name])
    return sizes


def fit(
    unknowns: np.ndarray, errors: np.ndarray, information: np.ndarray, *, of_mesh: bool = False
) -> Term:
    """Fit the forward map's error to FEM runs.

    unknowns : the unknowns at which FEM was run, (n, q).
    errors : FEM's data less the map's, all observations raveled, (n, d).
    information : the information W of the noise about its mean, (d, d), or its diagonal (d,).
    of_mesh : whether FEM was run on a finer mesh.
    """
    centre, scale = unknowns.mean(axis=0), np.maximum(unknowns.std(axis=0), 1e-12)
    x = (unknowns - centre) / scale
    norms = np.sqrt(np.sum(times(errors, information) * errors, axis=1))
    log_sizes = np.log(np.maximum(norms, 1e-12 * max(float(norms.max()), 1e-300)))
    width = min(
        _WIDTHS, key=lambda w: float(np.mean((_left_out(x, log_sizes, w) - log_sizes) ** 2))
    )
    sizes = np.exp(_left_out(x, log_sizes, width))[:, None]
    size = Amplitude(x, log_sizes, float(width), centre, scale)
    (term,) = marginalised([Term(errors / sizes / np.sqrt(len(x)), size=size)], information).terms
    largest = np.argsort(-term.strength)[:_MODES]
    return Term(term.modes[largest], size=size, of_mesh=of_mesh)


def _left_out(x: np.ndarray, values: np.ndarray, width: float) -> np.ndarray:
    """Return leave-one-out predictions of ``values`` (n,) at ``x`` (n, q) by kernel regression."""
    squared = np.sum((x[:, None] - x[None]) ** 2, axis=-1) / width**2
    np.fill_diagonal(squared, np.inf)
    return np.asarray(kernel_mean(squared, values))
