"""Learning a forward map's error from FEM runs, for the likelihood."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from tqdm import tqdm

from calibrate.approximation_error import fit
from calibrate.noise.information import information_about_means
from calibrate.statistical_model import Model
from emulator.errors import InputError
from emulator.fem import Simulator
from emulator.fem.campaign import Solver, solve_rows

FEWEST = 8


def with_error(
    model: Model, simulator: Simulator, runs: int = 24, *, seed: int = 0, progress: bool = False
) -> Model:
    """``model`` whose likelihood allows for the forward map's own error.

    FEM is solved at ``runs`` draws of the prior, from the map's predictions. See
    :mod:`calibrate.approximation_error`.

    Raises
    ------
    InputError
        Fewer than 8 runs, the simulator of another scene, noise that is not Gaussian or of unknown
        sd, or fewer than 8 draws at which both FEM and the map have an answer.
    """
    _check(model, simulator, runs)
    start, data = jax.jit(model.full), jax.jit(model.predict)
    solver = Solver(simulator, from_rest_again=False)
    draws = model.prior_draws(jax.random.key(seed), runs)
    unknowns, errors = [], []
    for k in tqdm(range(runs), "error of the map", disable=not progress, unit="run"):
        values = {name: draw[k] for name, draw in draws.items()}
        thetas = model.states.thetas(values)
        means, valid = data(values)
        starts = [(start(theta),) for theta in thetas]
        rows = list(solve_rows(solver, thetas, starts=starts.__getitem__))
        if bool(valid) and all(row.converged for row in rows):
            fields = jnp.stack([r.solution.displacement[model.observe.nodes] for r in rows])
            exact = model.observe(fields, thetas)
            errors.append(ravel_pytree(exact)[0] - ravel_pytree(means)[0])
            unknowns.append([float(values[name]) for name in model.states.unknowns])
    if len(errors) < FEWEST:
        raise InputError(
            f"error of the forward map: FEM and the map answered at {len(errors)} of {runs} draws "
            f"of the prior; {FEWEST} are needed"
        )
    information = np.asarray(information_about_means(model.noise, means))
    return replace(model, error=fit(np.array(unknowns), np.array(errors), information))


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
