"""Systematic errors of a model's data, and how far its forward map is from FEM.

The errors themselves, and how they are integrated out, are in :mod:`calibrate.model_error`. They
need Gaussian noise of known standard deviation, whose information they are marginalised beside.
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
from calibrate.model_error.marginal import ModelError, Term
from calibrate.model_error.systematic import Systematic
from calibrate.noise import information_about_means
from calibrate.statistical_model.model import Model
from calibrate.statistical_model.moves import FEMAnswer, largest_move
from calibrate.statistical_model.predictive import Predictive, noise_sds
from emulator.accuracy.estimate import newton_distance
from emulator.core.errors import InputError
from emulator.fem import Simulator
from emulator.fem.compiled import compiled

_WHAT = "systematic errors"  # the beginning of messages
_STEPS = 12  # Newton steps of a round that tell the map's error, over all load states
_FEWEST_ANSWERS = 4  # points of a round, and FEM runs where Newton steps are refused
_CLOUD = 1024  # draws that points are put around


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
    return replace(model, error=_joined(model, terms))


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
    check_algebra(_WHAT, model.noise)
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
        return _joined(model, terms)

    return error_of


def _joined(model: Model, terms: Sequence[Term]) -> ModelError:
    """Return the errors of ``model``'s data and these terms together, integrated out.

    :class:`InputError` where they lack a property that this needs.
    """
    every = (*model.error.declarations, *terms)
    check_algebra(_WHAT, model.noise, {term.unknown_size for term in every} - {""})
    means = {name: jnp.zeros(shape) for name, shape in model.observe.shapes.items()}
    error = marginalised(every, np.asarray(information_about_means(model.noise, means)))
    if taken := error.priors.keys() & replace(model, error=ModelError()).names:
        raise InputError(f"{_WHAT}: a size is called '{taken.pop()}', as an unknown of the model")
    return error


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
    if simulator.scene.loaded_by:
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
        height = float(model.log_likelihood(draw, exact, data))
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

    Root mean squares over its numbers, medians over draws; empty if there are none.

    errors : the map's data less FEM's at draws, flat (s, m).
    draws : draws (s,) by the unknown's name, of which an inferred noise sd is taken.
    """
    if not len(errors):
        return {}
    sizes, sds = {}, noise_sds(model, draws)
    for name, values in jax.vmap(model.observe.unravel)(jnp.asarray(errors)).items():
        square = np.square(np.asarray(values).reshape(len(errors), -1))
        sizes[name] = float(np.median(np.sqrt(square.mean(axis=1))) / sds[name])
    return sizes
