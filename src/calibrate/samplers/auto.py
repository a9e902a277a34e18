"""The sampler by default: importance sampling where that works, NUTS elsewhere.

Importance sampling is tried where the unknowns are few and the forward map is fast in batches. Its
draws are taken if its independent populations agree and the tail of its weights is light.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, ClassVar

from calibrate.samplers.density import Density
from calibrate.samplers.diagnostics import LARGEST_PARETO_SHAPE, converged
from calibrate.samplers.importance import IMPORTANCE
from calibrate.samplers.nuts import NUTS, NUTSOptions
from calibrate.samplers.protocol import Context, Draws, Sampler
from calibrate.statistical_model import Data
from emulator.core.errors import SolverError

MOST_UNKNOWNS = 8
SAMPLED_BY = "sampled_by"


@dataclass(frozen=True)
class AutoOptions(NUTSOptions):
    """Length of a run, as of NUTS; importance sampling reads its length and limits."""

    label: ClassVar[str] = "auto"


class Auto(Sampler):
    """The sampler that chooses another."""

    def sample(self, density: Density, data: Data, options: AutoOptions, context: Context) -> Draws:
        """Return the draws of the sampler named by the attribute ``sampled_by``.

        Raises
        ------
        SolverError
            As of NUTS.
        """
        if density.dimension <= MOST_UNKNOWNS and density.batches:
            draws = _by_importance(density, data, options, context)
            if draws is not None:
                return _named(draws, IMPORTANCE)
        return _named(NUTS.sample(density, data, _for(NUTS, options), context), NUTS)


def _by_importance(
    density: Density, data: Data, options: AutoOptions, context: Context
) -> Draws | None:
    """Return the draws of importance sampling, unless its own diagnosis is against them."""
    try:
        draws = IMPORTANCE.sample(density, data, _for(IMPORTANCE, options), context)
    except SolverError:
        return None
    light = draws.attributes["weights_pareto_k"] <= LARGEST_PARETO_SHAPE
    return draws if light and converged(draws.z, options.r_hat, options.ess) else None


def _for(sampler: Sampler, options: AutoOptions) -> Any:
    """Return the options of a sampler that ``options`` has, too; its own defaults for others."""
    names = {field.name for field in fields(sampler.options)} & {f.name for f in fields(options)}
    return sampler.options(**{name: getattr(options, name) for name in names})


def _named(draws: Draws, sampler: Sampler) -> Draws:
    attributes: dict[str, Any] = {SAMPLED_BY: sampler.name, **draws.attributes}
    return draws._replace(attributes=attributes)


AUTO = Auto("auto", AutoOptions, ("lp",))
