"""Learning a forward map's error from FEM runs, for the likelihood."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from calibrate.measurements.mesh_error import on_finer
from calibrate.noise.information import information_about_means
from calibrate.statistical_model.approximation_error import fit
from calibrate.statistical_model.model import Data, Model
from emulator.accuracy.mesh_error import mesh_error
from emulator.core.errors import InputError, SolverError
from emulator.core.progress import counting
from emulator.fem import Simulator
from emulator.fem.campaign import Solver, solve_rows

FEWEST = 8


def with_error(
    model: Model,
    simulator: Simulator,
    runs: int = 24,
    *,
    of_mesh: bool = False,
    seed: int = 0,
    progress: bool = False,
) -> Model:
    """``model`` whose likelihood allows for the forward map's own error.

    FEM is solved at ``runs`` draws of the prior, from the map's predictions. See
    :mod:`calibrate.statistical_model.approximation_error`.

    Parameters
    ----------
    of_mesh : solve on the next finer mesh of the same body, so that the mesh's error is allowed
        for, too.

    Raises
    ------
    InputError
        Fewer than 8 runs, the simulator of another scene, noise that is not Gaussian or of unknown
        sd, no finer mesh (:func:`~emulator.accuracy.mesh_error.mesh_error`), or fewer than 8 draws
        at which both FEM and the map have an answer.
    """
    _check(model, simulator, runs)
    data = jax.jit(model.predict)
    exact = _on_finer(model, simulator) if of_mesh else _on_mesh(model, simulator)
    draws = model.prior_draws(jax.random.key(seed), runs)
    unknowns, errors = [], []
    what = "error of map and mesh" if of_mesh else "error of the map"
    for k in counting(range(runs), what, disable=not progress, unit="run"):
        values = {name: draw[k] for name, draw in draws.items()}
        means, valid = data(values)
        if bool(valid) and (found := exact(model.states.thetas(values))) is not None:
            errors.append(ravel_pytree(found)[0] - ravel_pytree(means)[0])
            unknowns.append([float(values[name]) for name in model.states.unknowns])
    if len(errors) < FEWEST:
        raise InputError(
            f"error of the forward map: FEM and the map answered at {len(errors)} of {runs} draws "
            f"of the prior; {FEWEST} are needed"
        )
    information = np.asarray(information_about_means(model.noise, means))
    error = fit(np.array(unknowns), np.array(errors), information, of_mesh=of_mesh)
    return replace(model, error=error)


Exact = Callable[[jax.Array], Data | None]
"""Data without noise by FEM at theta of each load state (S, p); None where FEM has no answer."""


def _on_mesh(model: Model, simulator: Simulator) -> Exact:
    start, solver = jax.jit(model.full), Solver(simulator, from_rest_again=False)

    def exact(thetas: jax.Array) -> Data | None:
        starts = [(start(theta),) for theta in thetas]
        rows = list(solve_rows(solver, thetas, starts=starts.__getitem__))
        if not all(row.converged for row in rows):
            return None
        fields = jnp.stack([r.solution.displacement[model.observe.nodes] for r in rows])
        return model.observe(fields, thetas)

    return exact


def _on_finer(model: Model, simulator: Simulator) -> Exact:
    error = mesh_error(simulator)
    observe, start = on_finer(error, model.observe), jax.jit(model.full)

    def exact(thetas: jax.Array) -> Data | None:
        try:
            told = [error(theta, start(theta)) for theta in thetas]
        except SolverError:
            return None
        return observe(jnp.stack([each.fine[observe.nodes] for each in told]), thetas)

    return exact


def _check(model: Model, simulator: Simulator, runs: int) -> None:
    if runs < FEWEST:
        raise InputError(f"error of the forward map: {runs} FEM runs; give {FEWEST} or more")
    if simulator.scene.fingerprint != model.forward.scene.fingerprint:
        raise InputError("error of the forward map: the simulator is for another scene")
    for name, noise in model.noise.items():
        if noise.priors or not noise.gaussian:
            raise InputError(
                f"error of the forward map: the noise of {name} must be Gaussian and of known sd"
            )
