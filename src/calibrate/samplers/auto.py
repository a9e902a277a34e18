"""The sampler by default, which chooses between importance sampling and NUTS.

It takes the draws of importance sampling where unknowns are few, the forward map is fast in
batches, populations agree and the tail of the weights is light, and those of NUTS elsewhere. Where
too many of its transitions diverge, NUTS runs again in smaller steps, unless each solves FEM.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar

import jax
import numpy as np

from calibrate.importance.weights import LARGEST_PARETO_SHAPE
from calibrate.samplers.diagnostics import LARGEST_DIVERGENT, converged
from calibrate.samplers.importance import IMPORTANCE
from calibrate.samplers.nuts import NUTS, NUTSOptions
from calibrate.samplers.protocol import Context, Draws, Sampler
from calibrate.statistical_model import Data
from calibrate.statistical_model.density import Density
from emulator.core.checkpoint import Checkpoint
from emulator.core.errors import SolverError

MOST_UNKNOWNS = 8
# Draws of a population from which agreement is judged: fewer would disagree, or be too few for the
# limit of effective draws, where populations are right.
_JUDGED = 1000
_SMALL_STEPS = 0.97  # acceptance that a second run of NUTS adapts to
# Attributes of a run of ``auto``: whose draws they are, and why not those of importance sampling.
SAMPLED_BY, NOT_BY_IMPORTANCE = "sampled_by", "not_by_importance"
TARGET_ACCEPT = "target_accept"  # of a second run of NUTS


@dataclass(frozen=True)
class AutoOptions(NUTSOptions):
    """Length of a run, as of NUTS; importance sampling reads its length and limits."""

    label: ClassVar[str] = "auto"


class Auto(Sampler):
    """The sampler that chooses between importance sampling and NUTS."""

    def sample(self, density: Density, data: Data, options: AutoOptions, context: Context) -> Draws:
        """Return the draws of the sampler named by the attribute ``sampled_by``.

        The attribute ``not_by_importance`` says why it is not importance sampling.

        Raises
        ------
        SolverError
            No chain of NUTS could start where the density is finite.
        """
        draws = _by_importance(density, data, options, context)
        if isinstance(draws, Draws):
            return draws._replace(attributes={SAMPLED_BY: IMPORTANCE.name, **draws.attributes})
        if context.progress:
            print(f"sampled by {NUTS.name}: {draws}", file=sys.stderr, flush=True)
        why = {SAMPLED_BY: NUTS.name, NOT_BY_IMPORTANCE: draws}
        draws = _by_nuts(density, data, _for(NUTS, options), context)
        return draws._replace(attributes={**why, **draws.attributes})


def _by_nuts(density: Density, data: Data, options: NUTSOptions, context: Context) -> Draws:
    """Return the draws of NUTS: of two runs, where the first diverges, those that do so less."""
    draws = NUTS.sample(density, data, options, context)
    small = replace(options, target_accept=max(_SMALL_STEPS, options.target_accept))
    share = _diverging(draws)
    if share <= LARGEST_DIVERGENT or small == options or not density.batches:
        return draws
    if context.progress:
        said = f"{share:.2g} of its transitions diverge: again in smaller steps"
        print(f"{NUTS.name}: {said}", file=sys.stderr, flush=True)
    again = NUTS.sample(density, data, small, context._replace(checkpoint=Checkpoint()))
    again = again._replace(attributes={TARGET_ACCEPT: small.target_accept, **again.attributes})
    return min(again, draws, key=_diverging)


def _diverging(draws: Draws) -> float:
    """Return the share of transitions that diverge."""
    return float(np.mean(draws.statistics["diverging"]))


def _by_importance(
    density: Density, data: Data, options: AutoOptions, context: Context
) -> Draws | str:
    """Return the draws of importance sampling, or the reason to reject them."""
    if density.dimension > MOST_UNKNOWNS:
        return f"{density.dimension} unknowns; up to {MOST_UNKNOWNS} are few"
    if not density.batches:
        return "the forward map solves FEM"
    importance = _for(IMPORTANCE, options)
    judged = replace(importance, draws=max(importance.draws, _JUDGED))
    try:
        draws = IMPORTANCE.sample(density, data, judged, context)
    except SolverError as error:
        return str(error)
    if not (shape := draws.attributes["weights_pareto_k"]) <= LARGEST_PARETO_SHAPE:
        return f"the weights' tail is heavy, Pareto k {shape:.2f}"
    if not converged(draws.z, options.r_hat, options.ess):
        return "independent populations disagree"
    if judged == importance:
        return draws  # of as many rounds as it took
    z, statistics, attributes = draws
    z, statistics = jax.tree.map(lambda of_chain: of_chain[:, : options.draws], (z, statistics))
    return Draws(z, statistics, attributes)


def _for(sampler: Sampler, options: AutoOptions) -> Any:
    """Return a sampler's options: from ``options`` where it has them, else the defaults."""
    names = {field.name for field in fields(sampler.options)} & {f.name for f in fields(options)}
    return sampler.options(**{name: getattr(options, name) for name in names})


AUTO: Sampler = Auto("auto", AutoOptions)
