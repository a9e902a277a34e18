"""The last stage of training: what the FEM runs still have to teach."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from emulator.errors import InputError
from emulator.fem.campaign import Runs
from emulator.surrogates.additive import BASES, Base, Emulator
from emulator.surrogates.discrepancy import Residual, fit_residual
from emulator.surrogates.taylor import Expansion

_HELD_OUT = 5  # one run in so many judges what the residual is fitted on top of
FEWEST = 10  # runs; with fewer, all are needed for fitting
_OBSERVATIONS = 4000  # values and slopes a covariance matrix of 128 MB has room for


def rounded(series: Expansion) -> Expansion:
    """The series in numbers that float32 can hold, so that a file half as long loses nothing."""
    return replace(
        series,
        displacement=_round(series.displacement),
        derivatives=_round(series.derivatives),
    )


def _round(array: jax.Array) -> jax.Array:
    return array.astype(jnp.float32).astype(jnp.float64)


def add_residual(
    emulator: Emulator, runs: Runs, bases: tuple[Base, ...] = BASES
) -> tuple[Emulator, dict[str, Any]]:
    """``emulator`` with the residual of ``runs``, and a record of how it was chosen.

    A network trained for minutes is worth standing on when runs are few, and a rough ground when
    they are many: which of ``bases`` to add the residual to is judged by runs held out, then fitted
    to all.

    Raises
    ------
    InputError
        No run besides the centre's.
    """
    most = _OBSERVATIONS // (1 + runs.theta.shape[1])
    runs = runs.take(slice(0, most))
    count = len(runs.theta)
    if count < 2:
        raise InputError("the residual needs FEM runs besides the centre's; give the budget more")
    bare = replace(emulator, residual=None)
    errors: dict[str, float] = {}
    best: Base = "series"
    if count >= FEWEST:
        test = np.arange(count) % _HELD_OUT == _HELD_OUT - 1
        for base in bases:
            fitted = replace(bare, base=base, residual=_fit(bare, runs.take(~test), base))
            errors[base] = _error(fitted, runs.take(test))
        best = min(bases, key=errors.__getitem__)
    residual = _fit(bare, runs, best)
    record = {
        "base": best,
        "runs": count,
        "modes": len(residual.modes),
        "held_out_err_u_mm": errors,
    }
    return replace(bare, base=best, residual=residual), record


def _fit(emulator: Emulator, runs: Runs, base: Base) -> Residual:
    residual = fit_residual(emulator.scene, runs, emulator.series, _mean(emulator, base))
    return replace(residual, offset=_round(residual.offset), modes=_round(residual.modes))


def _mean(emulator: Emulator, base: Base) -> Callable[[jax.Array], jax.Array] | None:
    """Position in the box to the displacement (n, 3) of what is below the residual."""
    if base == "nothing":
        return None
    cached = replace(emulator, base=base).cache()
    return lambda position: cached(emulator.scene.from_unit(position))


def _error(emulator: Emulator, runs: Runs) -> float:
    """Mean err_u in mm of a typical run: one hard corner does not outvote the box."""
    predicted = jax.jit(emulator.cache())(runs.theta)
    each = jnp.mean(jnp.linalg.norm(predicted - runs.displacement, axis=-1), axis=-1)
    return float(jnp.exp(jnp.mean(jnp.log(each + 1e-300))))
