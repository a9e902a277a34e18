"""What members of one population, calibrated together, say: population, members, and new ones."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr

from calibrate.population.model import MEDIAN, SD
from calibrate.population.tree import ALONE, CORRELATION, MEMBER, NEW, PARAMETER
from calibrate.posterior import predictions, read_tree
from calibrate.posterior.diagnosis import diagnose
from calibrate.posterior.summary import summary_of
from calibrate.priors import Population, population_of_fits
from calibrate.statistical_model import Model
from emulator.core.errors import InputError, look_up
from emulator.core.representation import TableRepr
from emulator.core.store import write_netcdf


class Shrinkage(NamedTuple):
    """Mean and sd of a member's unknown: alone, under its model's prior, and with the others."""

    alone_mean: float
    alone_sd: float
    mean: float
    sd: float


@dataclass(frozen=True, eq=False, repr=False)
class Hierarchy(TableRepr):
    """Draws of a population, of its members, and of a member not seen.

    tree : DataTree. Group ``posterior`` has ``median`` and ``sd`` (chain, draw, parameter) of the
        population, before the cut to the range, ``correlation`` of the normal scores, each shared
        unknown (chain, draw, member), and what members have to themselves as ``name[member]``;
        ``new_member`` each shared unknown of a member not seen; ``alone`` draws of each member by
        itself; ``sample_stats``. Attributes hold the provenance.
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
        """Median and sd of the population by parameter, draws, and what is wrong with them."""
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
        """All draws by name, each (chains, draws).

        ``median[mu]``, ``sd[mu]``, ``correlation[mu, lam]``; ``mu[beam1]`` and the like of members.
        """
        every = self.tree["posterior"].to_dataset().data_vars
        posterior = {str(name): np.asarray(values) for name, values in every.items()}
        found = {
            f"{role}[{name}]": posterior[role][..., k]
            for k, name in enumerate(self.shared)
            for role in (MEDIAN, SD)
        }
        for k, name in enumerate(self.shared):
            for j, earlier in enumerate(self.shared[:k]):
                found[f"{CORRELATION}[{earlier}, {name}]"] = posterior[CORRELATION][..., j, k]
        for name in self.shared:
            for i, member in enumerate(self.members):
                found[f"{name}[{member}]"] = posterior[name][..., i]
        return found | {name: values for name, values in posterior.items() if values.ndim == 2}

    def member(self, name: str) -> dict[str, np.ndarray]:
        """All draws of what a member has, shared and own, by the names of its model, each (s,)."""
        look_up(dict.fromkeys(self.members), name, "member")
        mine = f"[{name}]"
        return {
            key.removesuffix(mine): values.reshape(-1)
            for key, values in self.draws().items()
            if key.endswith(mine) and not key.startswith((f"{MEDIAN}[", f"{SD}["))
        }

    def new_member(self) -> dict[str, np.ndarray]:
        """Draws (s,) of the shared unknowns of a member not seen."""
        return {n: np.asarray(self.tree[NEW][n]).reshape(-1) for n in self.shared}

    def predict(self, model: Model, *, seed: int = 0) -> dict[str, np.ndarray]:
        """Data that a member not seen would give, noise included: ``(s, *shape)`` by observation.

        At about 500 draws. What ``model`` has besides the shared unknowns is drawn from its prior.

        Raises
        ------
        InputError
            ``model`` does not infer a shared unknown.
        """
        for name in self.shared:
            if name not in model.states.unknowns:
                raise InputError(f"prediction: the model does not infer '{name}'")
        _, some = predictions.spread({n: np.asarray(self.tree[NEW][n]) for n in self.shared})
        shape = some[self.shared[0]].shape
        prior_key, data_key = jax.random.split(jax.random.key(seed))
        draws = {name: jnp.asarray(values) for name, values in some.items()}
        for key, (name, prior) in zip(
            jax.random.split(prior_key, len(model.sampled_priors)),
            model.sampled_priors.items(),
            strict=True,
        ):
            if name not in self.shared:
                given = model.given_earlier(name, prior, draws)
                draws[name] = given.sample(key, shape)
        made = predictions.replicates(model, draws, data_key)
        return {name: values.reshape(-1, *values.shape[2:]) for name, values in made.items()}

    def as_prior(self, source: str = "") -> Population:
        """The population as a prior of the next member: log-normals fitted to :meth:`new_member`.

        What is not known of the population widens it.

        Raises
        ------
        InputError
            A parameter that takes values of 0 or less.
        """
        source = source or f"a hierarchy of {len(self.members)} members"
        return population_of_fits({n: v.tolist() for n, v in self.new_member().items()}, source)

    def shrinkage(self) -> dict[str, dict[str, Shrinkage]]:
        """By shared unknown and member: mean and sd alone, and among the others."""
        found: dict[str, dict[str, Shrinkage]] = {name: {} for name in self.shared}
        for name in self.shared:
            for i, member in enumerate(self.members):
                alone = np.asarray(self.tree[ALONE][name])[i]
                together = np.asarray(self.tree["posterior"][name])[..., i]
                numbers = (alone.mean(), alone.std(ddof=1), together.mean(), together.std(ddof=1))
                found[name][member] = Shrinkage(*map(float, numbers))
        return found

    def summary(self, probability: float = 0.9) -> dict[str, dict[str, float]]:
        """Per entry of :meth:`draws`: mean, sd, equal-tailed interval, R-hat, bulk and tail ESS."""
        return summary_of(self.draws(), probability)

    def warnings(self) -> list[str]:
        """What is wrong with the run and what to do, a sentence each; empty if nothing is."""
        statistics = {str(n): v.values for n, v in self.tree["sample_stats"].data_vars.items()}
        return diagnose(self.draws(), statistics, self.summary(), {})

    def save(self, path: str | Path) -> None:
        """Write the DataTree as netCDF, whole or not at all."""
        write_netcdf(path, self.tree)


def read_hierarchy(path: str | Path) -> Hierarchy:
    """A saved hierarchy; :class:`InputError` where the file holds none."""
    tree = read_tree(path)
    if NEW not in tree.children:
        raise InputError(f"{path} holds no hierarchy; Hierarchy.save writes one")
    return Hierarchy(tree)
