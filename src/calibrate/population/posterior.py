"""Draws of a population, of its members, and of a member not seen: the DataTree and its views."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr

from calibrate.arviz import base
from calibrate.population.density import PopulationDensity
from calibrate.population.model import MEDIAN, SD, PopulationModel
from calibrate.population.second_stage import LARGEST_ERROR, Stage
from calibrate.posterior import predictions, read_tree
from calibrate.posterior.box import BoxEnd, box_ends
from calibrate.posterior.diagnosis import diagnose, summary_of
from calibrate.priors import Population, population_of_fits
from calibrate.statistical_model import Model
from emulator.core.display import TableRepr
from emulator.core.errors import InputError, look_up
from emulator.core.store import write_netcdf
from emulator.mechanics.laws.law import Quantity
from emulator.scenes.parameter_space import Parameter

ALONE, NEW, CORRELATION = "alone", "new_member", "correlation"
IN_USE = "draws_in_use"  # of each member
# These describe the weights of the population's draws; the last is in nats.
SHAPE, SHARE, ERROR = "pareto_shape", "effective_share", "log_likelihood_error"
WEIGHS = "weighed"  # whether they are used
_NEW = 0x85EBCA6B  # keeps the key of members not seen apart from the sampler's
PARAMETER, MEMBER = "parameter", "member"
_OTHER = "other_parameter"
_ALONE_DRAWS = 1000  # kept of each member by itself


class Shrinkage(NamedTuple):
    """Mean and sd of a member's unknown: alone, under its model's prior, and in the population."""

    alone_mean: float
    alone_sd: float
    mean: float
    sd: float


@dataclass(frozen=True, eq=False, repr=False)
class Hierarchy(TableRepr):
    """Draws of a population, of its members, and of a member not seen.

    tree : the DataTree. Its group ``posterior`` has ``median`` and ``sd`` (chain, draw, parameter)
        of the population, before the cut to the range, ``correlation`` of the normal scores, each
        shared unknown (chain, draw, member), and own unknowns as ``name[member]``; ``new_member``
        has each shared unknown of a member not seen; ``alone`` has draws of each member by itself;
        ``sample_stats``. Attributes hold the provenance.
    """

    tree: xr.DataTree

    @property
    def shared(self) -> tuple[str, ...]:
        """Unknowns that follow the population."""
        return tuple(map(str, np.asarray(self.tree["posterior"][PARAMETER])))

    @property
    def members(self) -> tuple[str, ...]:
        """Names of the members."""
        return tuple(map(str, np.asarray(self.tree["posterior"][MEMBER])))

    def summary_rows(self) -> tuple[str, list[tuple[str, str]]]:
        """Return median and sd of the population by parameter, number of draws, and warnings."""
        table = self.summary()
        rows = [
            (name, f"{table[name]['mean']:.4g} +- {table[name]['sd']:.2g}")
            for parameter in self.shared
            for name in (f"{MEDIAN}[{parameter}]", f"{SD}[{parameter}]")
        ]
        sizes = self.tree["posterior"].sizes
        worst = max(row["r_hat"] for row in table.values())
        rows.append(("draws", f"{sizes['chain']} x {sizes['draw']}, R-hat at most {worst:.3f}"))
        rows += [("warning", sentence) for sentence in self.warnings()]
        return f"Population of {len(self.members)} members", rows

    def draws(self) -> dict[str, np.ndarray]:
        """Return all draws by name, each (chains, draws).

        Names are ``median[mu]``, ``sd[mu]``, ``correlation[mu, lam]``, and ``mu[beam1]``.
        """
        variables = self.tree["posterior"].to_dataset().data_vars
        posterior = {str(name): np.asarray(values) for name, values in variables.items()}
        draws = {
            f"{role}[{name}]": posterior[role][..., k]
            for k, name in enumerate(self.shared)
            for role in (MEDIAN, SD)
        }
        for k, name in enumerate(self.shared):
            for j, earlier in enumerate(self.shared[:k]):
                draws[f"{CORRELATION}[{earlier}, {name}]"] = posterior[CORRELATION][..., j, k]
        for name in self.shared:
            for i, member in enumerate(self.members):
                draws[f"{name}[{member}]"] = posterior[name][..., i]
        return draws | {name: values for name, values in posterior.items() if values.ndim == 2}

    def member(self, name: str) -> dict[str, np.ndarray]:
        """Return draws (s,) of a member's unknowns, shared and own, by the names of its model."""
        look_up(dict.fromkeys(self.members), name, "member")
        suffix = f"[{name}]"
        return {
            key.removesuffix(suffix): values.reshape(-1)
            for key, values in self.draws().items()
            if key.endswith(suffix) and not key.startswith((f"{MEDIAN}[", f"{SD}["))
        }

    def new_member(self) -> dict[str, np.ndarray]:
        """Return draws (s,) of the shared unknowns of a member not seen."""
        return {n: np.asarray(self.tree[NEW][n]).reshape(-1) for n in self.shared}

    def predict(self, model: Model, *, seed: int = 0) -> dict[str, np.ndarray]:
        """Return data of a member not seen, noise included: ``(s, *shape)`` by observation.

        There are about 500 draws. Own unknowns of ``model`` are drawn from its prior; a model that
        does not infer a shared unknown is refused.
        """
        for name in self.shared:
            if name not in model.states.unknowns:
                raise InputError(f"prediction: the model does not infer '{name}'")
        _, some = predictions.spread({n: np.asarray(self.tree[NEW][n]) for n in self.shared})
        shape = some[self.shared[0]].shape
        prior_key, data_key = jax.random.split(jax.random.key(seed))
        draws = {name: jnp.asarray(values) for name, values in some.items()}
        keys = jax.random.split(prior_key, len(model.sampled_priors))
        for key, (name, prior) in zip(keys, model.sampled_priors.items(), strict=True):
            if name not in self.shared:
                draws[name] = model.given_earlier(name, prior, draws).sample(key, shape)
        data = predictions.replicates(model, draws, data_key)
        return {name: values.reshape(-1, *values.shape[2:]) for name, values in data.items()}

    def as_prior(self) -> Population:
        """Return the population as a prior: log-normals fitted to :meth:`new_member`.

        The uncertainty of the population widens it. A parameter with values of 0 or less is
        refused.
        """
        source = f"a hierarchy of {len(self.members)} members"
        return population_of_fits({n: v.tolist() for n, v in self.new_member().items()}, source)

    def shrinkage(self) -> dict[str, dict[str, Shrinkage]]:
        """Return mean and sd alone and in the population, by shared unknown and member."""
        table: dict[str, dict[str, Shrinkage]] = {name: {} for name in self.shared}
        for name, rows in table.items():
            alone, together = (np.asarray(self.tree[g][name]) for g in (ALONE, "posterior"))
            for i, member in enumerate(self.members):
                both = (alone[i], together[..., i])
                rows[member] = Shrinkage(
                    *(float(f) for d in both for f in (d.mean(), d.std(ddof=1)))
                )
        return table

    def summary(self, probability: float = 0.9) -> dict[str, dict[str, float]]:
        """Return mean, sd, equal-tailed interval, R-hat, bulk and tail ESS of :meth:`draws`."""
        return summary_of(self.draws(), probability)

    def warnings(self) -> list[str]:
        """Return a sentence for each fault of the run, with what to do; empty if there is none."""
        return [*self._unweighed(), *self._of_chains()]

    def _unweighed(self) -> Iterator[str]:
        """Yield a sentence where the members' draws are too few for the population's."""
        error = self.tree.attrs.get(ERROR, 0.0)
        weighs = self.tree.attrs.get(WEIGHS, 1)
        if weighs and error <= LARGEST_ERROR:
            return
        in_use = np.asarray(self.tree[ALONE][IN_USE])
        worst = int(np.argmin(in_use))
        fault = (
            f"too few: its log likelihood errs by {error:.2g} nats, and its means by as many of "
            "their sds"
        )
        if not weighs:
            fault = "too few to check it: it is that of normals fitted to the members"
        yield (
            f"the population rests on {in_use[worst]:.0f} draws of {self.members[worst]}, {fault}; "
            "take more draws of each"
        )

    def _of_chains(self) -> list[str]:
        statistics = {str(n): v.values for n, v in self.tree["sample_stats"].data_vars.items()}
        return [*diagnose(self.draws(), statistics, self.summary(), {}, self.box_ends())]

    def box_ends(self) -> list[BoxEnd]:
        """Return the ends of ranges that end members' posteriors in place of the data."""
        box, limits = {}, dict[str, Quantity]()
        for name in self.shared:
            about = self.tree["posterior"][name].attrs
            if "box" in about:
                low, high, *nature = map(float, about["box"])
                if nature:
                    limits[name] = Quantity(name, low=nature[0], high=nature[1])
                box[name] = Parameter(name, about["units"], low, high, about["scale"])
        ends = []
        for member in self.members:
            member_ends = box_ends(self.member(member), box, limits)
            ends += [replace(end, name=f"{end.name}[{member}]") for end in member_ends]
        return sorted(ends, key=lambda end: -end.shift)

    def save(self, path: str | Path) -> None:
        """Write the DataTree as netCDF, whole or not at all."""
        write_netcdf(path, self.tree)


def read_hierarchy(path: str | Path) -> Hierarchy:
    """Return a saved hierarchy; :class:`InputError` where the file holds none."""
    tree = read_tree(path)
    if NEW not in tree.children:
        raise InputError(f"{path} holds no hierarchy; Hierarchy.save writes one")
    return Hierarchy(tree)


def make_tree(
    model: PopulationModel, density: PopulationDensity, stage: Stage, seed: int
) -> xr.DataTree:
    """Return the groups ``posterior``, ``new_member`` and ``sample_stats``, and its weights."""
    shape, rows = stage.draws.z.shape[:2], stage.rows(seed)
    population = density.constrain(jnp.asarray(stage.draws.z).reshape(-1, density.dimension)[rows])
    chosen = stage.weighed.member_draws[rows].T
    members = {
        member: {name: values[draws] for name, values in stage.members[member].items()}
        for member, draws in zip(model.members, chosen, strict=True)
    }
    correlation = np.einsum("...ik,...jk->...ij", population.factor, population.factor)
    posterior = {
        MEDIAN: population.median,
        SD: population.sd,
        CORRELATION: correlation,
        **{name: np.stack([draws[name] for draws in members.values()], axis=1)
           for name in model.shared},
        **{f"{name}[{member}]": members[member][name]
           for member, names in model.unshared.items() for name in names},
    }  # fmt: skip

    def by_chain(draws: Mapping[str, Any]) -> dict[str, np.ndarray]:
        return {n: np.asarray(v).reshape(*shape, *v.shape[1:]) for n, v in draws.items()}

    names = list(model.shared)
    dims = {MEDIAN: [PARAMETER], SD: [PARAMETER], CORRELATION: [PARAMETER, _OTHER]}
    tree = base.from_dict(
        {"posterior": by_chain(posterior), "sample_stats": dict(stage.draws.statistics)},
        dims=dims | {name: [MEMBER] for name in names},
        coords={PARAMETER: names, _OTHER: names, MEMBER: list(model.members)},
    )
    key = jax.random.fold_in(jax.random.key(seed), _NEW)
    scores = jax.random.normal(key, (len(rows), len(names)))
    new = density.values(population, scores)
    tree[NEW] = xr.DataTree(base.dict_to_dataset(by_chain(new)))
    for name, parameter in model.shared.items():
        for group in ("posterior", NEW):
            tree[group][name].attrs.update(units=parameter.unit or "1", scale=parameter.scale)
        if all(name in member.boxed for member in model.members.values()):
            limits = next(iter(model.members.values())).forward.scene.quantities[name]
            box = [parameter.low, parameter.high, limits.low, limits.high]
            tree["posterior"][name].attrs["box"] = box
    tree.attrs |= {SHAPE: stage.shape, SHARE: stage.share, ERROR: stage.error}
    tree.attrs[WEIGHS] = int(stage.weighs)
    return tree


def tree_of_alone(
    draws: Mapping[str, Mapping[str, np.ndarray]], names: tuple[str, ...], in_use: np.ndarray
) -> xr.DataTree:
    """Return the group ``alone``: draws of each member, evenly spaced, and how many are in use."""

    def spaced(values: np.ndarray) -> np.ndarray:
        return values[np.linspace(0, len(values) - 1, _ALONE_DRAWS).astype(int)]

    members = draws.values()
    variables: dict[str, Any] = {
        n: ((MEMBER, "draw"), np.stack([spaced(by[n]) for by in members])) for n in names
    }
    variables[IN_USE] = ((MEMBER,), in_use)
    return xr.DataTree(xr.Dataset(variables, coords={MEMBER: list(draws)}))
