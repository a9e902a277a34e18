"""Models whose data have errors besides noise: declared, described in a run, or learned from FEM.

The errors themselves, and how they are integrated out, are in :mod:`calibrate.model_error`. They
need Gaussian noise of known standard deviation, whose information they are marginalised beside.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from calibrate.measurements.outputs import on_finer
from calibrate.model_error import learned
from calibrate.model_error.kinds import Measured, read_systematic
from calibrate.model_error.marginal import ModelError
from calibrate.model_error.systematic import Systematic, marginalised
from calibrate.noise import information_about_means
from calibrate.statistical_model.fem_likelihood import FEMLikelihood
from calibrate.statistical_model.model import Data, Model
from emulator.accuracy.mesh_error import mesh_error
from emulator.core.errors import InputError, SolverError
from emulator.core.progress import counting
from emulator.fem import Simulator

FEWEST = 8  # FEM runs from which an error is learned


def with_systematic(model: Model, *errors: Systematic) -> Model:
    """Return ``model`` whose data have these errors besides their noise.

    Raises
    ------
    InputError
        No errors are given, one does not fit the model's observations, noise is not Gaussian or of
        unknown sd, or the model has another error.
    """
    if not errors:
        raise InputError("systematic errors: give one or more")
    return replace(model, error=_marginaliser(model)(errors))


def with_described_errors(
    model: Model, data: Mapping[str, Any], descriptions: Mapping[str, Mapping[str, Any]]
) -> tuple[Model, Mapping[str, jax.Array]]:
    """Return ``model`` of the values that are not missing, with the described errors, and these.

    Parameters
    ----------
    data : the data by the observation's name, NaN where missing.
    descriptions : the description of each error as in an experiment file, by the error's name.

    Raises
    ------
    InputError
        As :func:`errors_of_data`.
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

    Raises
    ------
    InputError
        An error does not fit, by its name; and as :func:`with_systematic`.
    """
    kinds = {name: read_systematic(name, each) for name, each in descriptions.items()}
    marginalise = _marginaliser(model)
    parameters = model.forward.scene.parameter_names
    states = zip(model.states.states, model.states.entries, strict=True)
    theta = {state: dict(zip(parameters, row, strict=True)) for state, row in states}

    def error_of(data: Mapping[str, Any]) -> ModelError:
        arrays = {name: np.asarray(values) for name, values in data.items()}
        measured = Measured(model.observe, arrays, theta)
        errors = []
        for name, kind in kinds.items():
            try:
                errors.append(measured.present(kind.systematic(name, measured)))
            except InputError as wrong:
                raise InputError(f"systematic '{name}': {wrong}") from wrong
        return marginalise(errors)

    return error_of


def _noise_information(model: Model, errors: str) -> np.ndarray:
    """Return the information (d, d) of the noise about the data's means.

    Marginalisation beside the noise needs one that is the same for all data and unknowns, so
    :class:`InputError` is raised where the noise is not Gaussian or of unknown sd.
    """
    for name, noise in model.noise.items():
        if noise.priors or not noise.gaussian:
            raise InputError(f"{errors}: the noise of {name} must be Gaussian and of known sd")
    means = {name: jnp.zeros(shape) for name, shape in model.observe.shapes.items()}
    return np.asarray(jax.jit(lambda m: information_about_means(model.noise, m))(means))


def _marginaliser(model: Model) -> Callable[[Sequence[Systematic]], ModelError]:
    """Return the function that integrates systematic errors of ``model``'s data out."""
    if model.error is not None:
        raise InputError("systematic errors: the model's likelihood has an error already")
    information = _noise_information(model, "systematic errors")
    return partial(
        marginalised,
        shapes=model.observe.shapes,
        information=information,
        unknowns=model.names,
    )


def with_error(
    model: Model,
    simulator: Simulator,
    runs: int = 24,
    *,
    of_mesh: bool = False,
    seed: int = 0,
    progress: bool = False,
) -> Model:
    """Return ``model`` whose likelihood allows for the forward map's own error.

    FEM is solved at ``runs`` draws of the prior, from the map's predictions
    (:mod:`calibrate.model_error.learned`).

    Parameters
    ----------
    of_mesh : whether to solve on the next finer mesh of the body, so that the mesh's error is
        allowed for, too.
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
    information = _noise_information(model, "error of the forward map")
    predict = jax.jit(model.predict)
    by_fem = _on_finer_mesh(model, simulator) if of_mesh else _on_mesh(model, simulator)
    draws = model.prior_draws(jax.random.key(seed), runs)
    unknowns, errors = [], []
    what = "error of map and mesh" if of_mesh else "error of the map"
    for k in counting(range(runs), what, disable=not progress, unit="run"):
        values = {name: draw[k] for name, draw in draws.items()}
        means, valid = predict(values)
        if bool(valid) and (exact := by_fem(values)) is not None:
            errors.append(ravel_pytree(exact)[0] - ravel_pytree(means)[0])
            unknowns.append([float(values[name]) for name in model.states.unknowns])
    if len(errors) < FEWEST:
        raise InputError(
            f"error of the forward map: FEM and the map answered at {len(errors)} of {runs} draws "
            f"of the prior; {FEWEST} are needed"
        )
    error = learned.fit(np.array(unknowns), np.array(errors), information, of_mesh=of_mesh)
    return replace(model, error=error)


ByFEM = Callable[[Mapping[str, Any]], Data | None]
"""Data without noise by FEM at a draw of the prior; ``None`` where FEM has no answer."""


def _on_mesh(model: Model, simulator: Simulator) -> ByFEM:
    fem, nodes = FEMLikelihood(model, simulator), model.observe.nodes

    def by_fem(draw: Mapping[str, Any]) -> Data | None:
        ((_, fields),) = fem.equilibria([draw])
        if fields is None:
            return None
        return model.observe(jnp.stack([u[nodes] for u in fields]), model.states.thetas(draw))

    return by_fem


def _on_finer_mesh(model: Model, simulator: Simulator) -> ByFEM:
    error = mesh_error(simulator)
    observe, start = on_finer(error, model.observe), jax.jit(model.full)

    def by_fem(draw: Mapping[str, Any]) -> Data | None:
        thetas = model.states.thetas(draw)
        try:
            estimates = [error(theta, start(theta)) for theta in thetas]
        except SolverError:
            return None
        return observe(jnp.stack([each.fine[observe.nodes] for each in estimates]), thetas)

    return by_fem
