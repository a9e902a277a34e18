"""The DataTree of a hierarchy: population, members, a member not seen, each member alone."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import numpy as np
import xarray as xr

from calibrate.arviz import base
from calibrate.population.density import Population, density_of_hierarchy
from calibrate.population.model import MEDIAN, SD, HierarchicalModel

ALONE, NEW, CORRELATION = "alone", "new_member", "correlation"
PARAMETER, MEMBER = "parameter", "member"
_OTHER = "other_parameter"


def make_tree(
    model: HierarchicalModel,
    drawn: tuple[Population, jax.Array, Mapping[str, Any]],
    shape: tuple[int, int],
    statistics: Mapping[str, Any],
    rng_key: jax.Array,
) -> xr.DataTree:
    """Groups ``posterior``, ``new_member`` and ``sample_stats``, from draws (s, ...).

    ``shape`` (chains, draws) of them; ``rng_key`` for the member not seen.
    """
    population, scores, own = drawn
    new = jax.random.normal(rng_key, (len(scores), scores.shape[-1]))
    values = density_of_hierarchy(model).values
    correlation = np.einsum("...ik,...jk->...ij", population.factor, population.factor)
    posterior = {
        MEDIAN: population.median,
        SD: population.sd,
        CORRELATION: correlation,
        **values(*population, scores),
        **own,
    }

    def by_chain(draws: Mapping[str, Any]) -> dict[str, np.ndarray]:
        return {n: np.asarray(v).reshape(*shape, *v.shape[1:]) for n, v in draws.items()}

    names = list(model.shared)
    dims = {MEDIAN: [PARAMETER], SD: [PARAMETER], CORRELATION: [PARAMETER, _OTHER]}
    tree = base.from_dict(
        {"posterior": by_chain(posterior), "sample_stats": dict(statistics)},
        dims=dims | {name: [MEMBER] for name in names},
        coords={PARAMETER: names, _OTHER: names, MEMBER: list(model.members)},
    )
    tree[NEW] = xr.DataTree(base.dict_to_dataset(by_chain(values(*population, new))))
    for name, parameter in model.shared.items():
        for group in ("posterior", NEW):
            tree[group][name].attrs.update(units=parameter.unit or "1", scale=parameter.scale)
    return tree


def tree_of_alone(draws: Mapping[str, Mapping[str, np.ndarray]], count: int = 1000) -> xr.DataTree:
    """The group ``alone``: at most ``count`` draws of each member, evenly spaced."""
    first = next(iter(draws.values()))

    def spaced(values: np.ndarray) -> np.ndarray:
        return values[np.linspace(0, len(values) - 1, count).astype(int)]

    variables = {
        name: ((MEMBER, "draw"), np.stack([spaced(by[name]) for by in draws.values()]))
        for name in first
    }
    return xr.DataTree(xr.Dataset(variables, coords={MEMBER: list(draws)}))
