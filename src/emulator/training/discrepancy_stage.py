"""The last stage of training: a discrepancy model of the FEM runs, and what it stands on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.errors import InputError
from emulator.fem.campaign import Runs
from emulator.surrogates.additive import Emulator
from emulator.surrogates.discrepancy import fit_discrepancy
from emulator.surrogates.taylor import Expansion, constant

_HELD_OUT = 5  # every fifth run is held out
FEWEST = 10  # runs; of fewer, none is held out
_OBSERVATIONS = 4000  # values and derivatives; their covariance matrix takes 128 MB


def add_discrepancy(
    emulator: Emulator, runs: Runs, series: Expansion | None = None
) -> tuple[Emulator, dict[str, Any]]:
    """``emulator`` with a discrepancy model of ``runs``, and a record of how it was chosen.

    The model is fitted on top of nothing, of the Taylor series, and of series and network, and the
    sum with the least error at held-out runs is taken, then fitted to all runs: a network helps
    where runs are few and harms where they are many. Parts that are not in that sum are dropped.

    series : FEM's own, where that in ``emulator`` is of what a family's network leaves.

    Raises
    ------
    InputError
        No run besides the centre's.
    """
    most = _OBSERVATIONS // (1 + runs.theta.shape[1])
    runs = runs.take(slice(0, most))
    count = len(runs.theta)
    if count < 2:
        raise InputError(
            "the discrepancy model needs FEM runs besides the centre's; give a larger budget"
        )
    series = (
        series
        or emulator.taylor
        or constant(np.full(runs.theta.shape[1], 0.5), jnp.zeros(emulator.scene.held.shape))
    )

    def fitted(bare: Emulator, some: Runs) -> Emulator:
        model = fit_discrepancy(bare.scene, some, series, _mean(bare)).rounded()
        return replace(bare, discrepancy=model)

    sums = _sums(emulator, series)
    errors: dict[str, float] = {}
    best = next((n for n in ("coarse", "taylor") if n in sums), "nothing")
    if count >= FEWEST:
        test = np.arange(count) % _HELD_OUT == _HELD_OUT - 1
        for name, bare in sums.items():
            errors[name] = _error(fitted(bare, runs.take(~test)), runs.take(test))
        best = min(errors, key=errors.__getitem__)
    whole = fitted(sums[best], runs)
    assert whole.discrepancy is not None, "it was fitted above"
    modes = len(whole.discrepancy.modes)
    record = {"on": best, "runs": count, "modes": modes, "held_out_err_u_mm": errors}
    return whole, record


def _sums(emulator: Emulator, series: Expansion) -> dict[str, Emulator]:
    """The sums of parts a discrepancy model may be added to, by name."""
    bare = replace(emulator, discrepancy=None)
    nothing = replace(bare, taylor=None, network=None, family=None)
    if emulator.coarse is not None:  # on the same body, it has learned from many runs
        candidates = [bare]
    elif emulator.family is not None:
        alone = replace(bare, taylor=None)
        candidates = [nothing, replace(nothing, taylor=series), alone, bare]
    else:
        candidates = [nothing, replace(bare, network=None), bare]
    return {" + ".join(sum_.parts) or "nothing": sum_ for sum_ in candidates}


def _mean(emulator: Emulator) -> Callable[[jax.Array], jax.Array] | None:
    """Position in the unit box to the displacement (n, 3) of all parts; None without parts."""
    if not emulator.parts:
        return None
    cached = emulator.cache()
    return lambda position: cached(emulator.scene.from_unit(position))


def _error(emulator: Emulator, runs: Runs) -> float:
    """Geometric mean of err_u in mm over ``runs``, so that one large error does not decide."""
    predicted = jax.jit(emulator.cache())(runs.theta)
    each = jnp.mean(jnp.linalg.norm(predicted - runs.displacement, axis=-1), axis=-1)
    return float(jnp.exp(jnp.mean(jnp.log(each + 1e-300))))
