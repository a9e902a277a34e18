"""A posterior: draws as an ArviZ DataTree, with the model and data they came from.

Groups of the DataTree have ArviZ's names, so that ArviZ works on the saved file as it is.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import jax
import numpy as np
import xarray as xr

from calibrate.arviz import base
from calibrate.measurements import Observation
from calibrate.measurements.labels import datum_names, labels_of, missing_places
from calibrate.posterior import predictions
from calibrate.posterior.box import BoxEnd, box_ends
from calibrate.posterior.diagnosis import (
    DATUM_NAMES,
    TAUGHT_AT,
    Summary,
    diagnose,
    misfits,
    nothing_learned,
    summary_of,
)
from calibrate.posterior.reliance import Reliance, reliance_of, rests_on_prior
from calibrate.posterior.taken_up import TakenUp, sentences, taken_up
from calibrate.provenance import as_attributes, describe_distribution, versions
from calibrate.samplers import check_options, density_of, find_sampler
from calibrate.samplers.modes import MISSED_BY, MOST, MOST_BY_FEM, explore, missed_mode
from calibrate.samplers.protocol import Context
from calibrate.state_names import split
from calibrate.statistical_model import Data, Model
from calibrate.statistical_model.density import named_draws, prior_draws
from emulator.core.checkpoint import Checkpoint, identity_of
from emulator.core.display import TableRepr
from emulator.core.errors import InputError, check_known
from emulator.core.machine import one_blas_thread
from emulator.core.store import write_netcdf
from emulator.scenes.forward_problem import ForwardProblem

# Keep the keys of replicated data and of the search for modes apart from the sampler's.
_PREDICTIONS, _MODES = 0x9E3779B9, 0x85EBCA6B
_WITH_UNITS = ("posterior", "prior", "posterior_predictive", "prior_predictive", "observed_data")


@dataclass(frozen=True, eq=False, repr=False)
class Posterior(TableRepr):
    """Draws, with the model and the data they came from.

    tree : DataTree with groups posterior, sample_stats, observed_data, constant_data; with
        predictions also log_likelihood (of each datum at each draw), posterior_predictive, prior
        and prior_predictive (at about 500 draws). Variables have units; attributes hold the
        provenance.
    model, data : the model, and the data by the observation's name that it is conditioned on.
    """

    tree: xr.DataTree
    model: Model
    data: Data

    def summary_rows(self) -> tuple[str, list[tuple[str, str]]]:
        """Return mean and sd of every unknown, the number of draws, and the faults of the run."""
        table, sizes = self.summary(), self.tree["posterior"].sizes
        rows = [(name, f"{row['mean']:.4g} +- {row['sd']:.2g}") for name, row in table.items()]
        worst = max(row["r_hat"] for row in table.values())
        rows.append(("draws", f"{sizes['chain']} x {sizes['draw']}, R-hat at most {worst:.3f}"))
        rows += [("warning", sentence) for sentence in self.warnings()]
        return f"Posterior of '{self.model.forward.scene.name}'", rows

    def draws(self) -> dict[str, np.ndarray]:
        """Return all draws by name, chains joined, each (s,)."""
        return {n: np.asarray(self.tree["posterior"][n]).reshape(-1) for n in self.model.names}

    def thetas(self, state: str | None = None) -> jax.Array:
        """Return all draws of theta, (s, p), in load state ``state``, by default the only one."""
        states = self.model.states.states
        if state is None and len(states) > 1:
            raise InputError(f"the posterior has several load states: {', '.join(states)}")
        if state is not None:
            check_known(state, states, "load state")
        return self.model.states.thetas(self.draws())[:, states.index(state or states[0])]

    def predict(
        self, known: Mapping[str, float], observe: Observation, *, state: str | None = None
    ) -> np.ndarray:
        """Return the noise-free values of ``observe`` at every draw: one ``(s, *shape)`` array.

        Parameters
        ----------
        known : parameters that are given instead of drawn, such as another pressure:
            ``posterior.predict({"pressure": 1.2}, cal.CavityVolume(scene))``.
        observe : an observation of the scene; it need not be one of the model's.
        state : load state whose parameters are drawn, where there are several.

        Raises
        ------
        InputError
            An unknown parameter or state, a value that is not finite, an observation of another
            mesh, or a draw at which the forward map has no answer.
        """
        scene, thetas = self.model.forward.scene, self.thetas(state)
        if np.max(observe.nodes, initial=0) >= scene.node_count:
            raise InputError(f"prediction: the observation is not of scene '{scene.name}'")
        for name, value in known.items():
            if name not in scene.parameter_names:
                names = ", ".join(scene.parameter_names)
                raise InputError(f"prediction: '{name}' is no parameter; there are {names}")
            if not np.isfinite(value):
                raise InputError(f"prediction: {name} is {value}; give a finite number")
            thetas = thetas.at[:, scene.parameter_names.index(name)].set(value)
        outputs = predictions.outputs_of(observe, self.model.full)
        return outputs.values(thetas).reshape(-1, *observe.shape)

    def predict_on(self, scene: ForwardProblem, observe: Any, **options: Any) -> Any:
        """Return predictions of another scene: :func:`calibrate.prediction.predict_on`."""
        room = import_module("calibrate.prediction")
        return room.predict_on(self, scene, observe, **options)

    def summary(self, probability: float = 0.9) -> Summary:
        """Return mean, sd, equal-tailed interval, R-hat, bulk and tail ESS, by parameter."""
        draws = self.tree["posterior"]
        return summary_of({n: np.asarray(draws[n]) for n in self.model.names}, probability)

    @property
    def divergences(self) -> int:
        """Number of divergent transitions; 0 for samplers that have none."""
        statistics = self.tree["sample_stats"]
        return int(statistics["diverging"].sum()) if "diverging" in statistics else 0

    def warnings(self) -> list[str]:
        """Return a sentence for each fault of run or data, with what to do; empty if none."""
        groups = [self.tree[name].to_dataset() for name in ("posterior", "sample_stats")]
        draws, statistics = (
            {str(name): np.asarray(values) for name, values in group.data_vars.items()}
            for group in groups
        )
        attributes = {str(name): value for name, value in self.tree.attrs.items()}
        faults = [*diagnose(draws, statistics, self.summary(), attributes, self.box_ends())]
        model = self.model
        if "prior" in self.tree.children:
            faults += predictions.shortfall(self.tree["prior"].sizes["draw"])
            sds = {
                model.noise_names[name]: f"sd {noise.upper_sd:g} {model.observe.parts[name].unit}"
                for name, noise in model.noise.items()
            }
            noise = ", ".join(f"{sd} of {name}" for name, sd in sds.items())
            faults += nothing_learned(self.tree, model.states.unknowns, noise)
        on_prior = rests_on_prior(self.reliance())
        return [*faults, *misfits(self.tree), *sentences(self.inferred_noise()), *on_prior]

    def reliance(self) -> dict[str, Reliance]:
        """Return what each unknown with a log-normal prior owes to it."""
        return reliance_of(self.model, self.draws())

    def inferred_noise(self) -> list[TakenUp]:
        """Return the inferred noise of each observation, beside its signal and its scatter."""
        return list(taken_up(self.model, self.data, self.draws()))

    def taught_at(self) -> dict[str, np.ndarray]:
        """Return the draws (s,) by name at which FEM has taught the map; empty for other maps."""
        taught = json.loads(self.tree.attrs.get(TAUGHT_AT, "{}"))
        return {name: np.asarray(values) for name, values in taught.items()}

    def box_ends(self) -> list[BoxEnd]:
        """Return the ends of ranges that end the posterior in place of the data, worst first."""
        return box_ends(self.draws(), self.model.box, self.model.forward.scene.quantities)

    def save(self, path: str | Path) -> None:
        """Write the DataTree as netCDF, whole or not at all."""
        write_netcdf(path, self.tree)


def read_tree(path: str | Path) -> xr.DataTree:
    """Return the DataTree in a netCDF file, in memory; :class:`InputError` when it is not one."""
    path = Path(path)
    if not path.is_file():
        raise InputError(f"posterior file {path} does not exist")
    try:
        with xr.open_datatree(path, engine="h5netcdf") as tree:
            return tree.load()
    except (OSError, ValueError, KeyError) as error:
        raise InputError(f"posterior file {path} is truncated or not netCDF") from error


def provenance(model: Model, seed: int, sampler: str, options: Any) -> dict[str, Any]:
    """Return everything needed to repeat how a posterior was made; plain JSON values."""
    scene = model.forward.scene
    return {
        "scene": dict(scene.origin),
        "scene_name": scene.name,
        "scene_fingerprint": scene.fingerprint,
        "forward": model.forward.kind,
        "forward_fingerprint": model.full.fingerprint,
        "forward_error": model.error.fingerprint if model.error.terms else None,
        "observe": model.observe.to_json(),
        "missing": missing_places(model.observe),
        DATUM_NAMES: {name: datum_names(model.observe, name) for name in model.observe.parts},
        "noise": {name: noise.to_json() for name, noise in model.noise.items()},
        "prior": {name: describe_distribution(d) for name, d in model.prior.items()},
        "prior_dependence": None if model.dependence is None else model.dependence.to_json(),
        "prior_cut": dict(model.prior_cut),
        "load_states": model.states.to_json(),
        "sampler": sampler,
        "sampler_options": asdict(options),
        "seed": seed,
        "versions": versions(),
    }


@one_blas_thread()
def sample(
    model: Model,
    data: np.ndarray | Mapping[str, np.ndarray],
    *,
    sampler: str | None = None,
    options: Any | None = None,
    seed: int = 0,
    progress: bool = False,
    predictions: bool = True,
    checkpoint: str | Path | None = None,
) -> Posterior:
    """Draw from the posterior of ``model`` given ``data``.

    With several observations, ``data`` maps their names to values: displacements (d, 3) in mm, a
    volume in mL. Missing values are NaN and left out. ``sampler`` is a name of
    :data:`calibrate.samplers.SAMPLERS`; ``options`` is an instance of that sampler's options,
    ``None`` for its defaults. Without a name the sampler is that of the options, or ``auto``:
    importance sampling for up to eight unknowns, where its own diagnosis says that it works, and
    NUTS elsewhere.

    Parameters
    ----------
    predictions : whether the DataTree gets log likelihoods and replicated data.
    checkpoint : a file that the run's state is kept in every few seconds. If the run is killed, the
        same call goes on from there to the same draws; the file is removed when they are complete.

    Raises
    ------
    InputError
        Unknown sampler, options of another sampler, data of the wrong shape, with infinite values
        or of which all values are missing, a checkpoint of another run.
    """
    method = find_sampler(sampler, options)
    model, checked = model.given(data)
    kept = len(model.names) + 2 * sum(np.size(values) for values in checked.values())
    options = check_options(method, options, kept, checkpoint)
    record = provenance(model, seed, method.name, options)
    # The scene's place is no matter. Messages name the first difference, so what a user changes
    # most comes first.
    first = {name: record[name] for name in ("sampler", "seed", "sampler_options")}
    matters = first | {name: value for name, value in record.items() if name != "scene"}
    state = Checkpoint(checkpoint, identity_of(matters, checked))
    density = density_of(model)
    run = method.sample(density, checked, options, Context(seed, progress, state))
    attributes = dict(run.attributes)
    if MISSED_BY not in attributes:
        z = np.asarray(run.z).reshape(-1, density.dimension)
        key = jax.random.fold_in(jax.random.key(seed), _MODES)
        starts = prior_draws(density, key, MOST if density.batches else MOST_BY_FEM)
        modes = explore(density, checked, starts, z)
        attributes |= missed_mode(density, checked, z, modes)
    rng_key = jax.random.fold_in(jax.random.key(seed), _PREDICTIONS) if predictions else None
    tree = make_tree(model, checked, named_draws(model, run.z), run.statistics, rng_key)
    tree.attrs.update(as_attributes(record | attributes))
    state.remove()
    return Posterior(tree, model, checked)


def make_tree(
    model: Model,
    data: Data,
    draws: Mapping[str, np.ndarray],
    statistics: Mapping[str, np.ndarray],
    rng_key: jax.Array | None,
    means: Mapping[str, np.ndarray] | None = None,
) -> xr.DataTree:
    """Return draws and statistics (chains, draws) by name, with all that follows from them.

    Parameters
    ----------
    rng_key : the random key of replicated data; ``None`` leaves out the predictions
        (``log_likelihood``, ``posterior_predictive``, ``prior``, ``prior_predictive``).
    means : data without noise at the draws, (chains, draws, *shape) by the observation's name,
        for draws of FEM's posterior; by default the model's forward map gives them.
    """
    constants, dims, coords = labels_of(model.observe)
    # ArviZ wants a dimension of every observation: a single number gets one of length 1.
    single = [name for name, values in data.items() if np.ndim(values) == 0]
    dims |= {name: [f"{name}_number"] for name in single}
    groups: dict[str, Any] = {
        "posterior": dict(draws),
        "sample_stats": dict(statistics),
        "observed_data": {name: np.atleast_1d(values) for name, values in data.items()},
        **({"constant_data": constants} if constants else {}),
    }
    if rng_key is None:
        tree = base.from_dict(groups, dims=dims, coords=coords)
    else:
        posterior_key, prior_key = jax.random.split(rng_key)
        rows, some = predictions.spread(draws)
        means = predictions.means_of(model, draws) if means is None else means
        at_some = {name: np.asarray(values)[:, rows] for name, values in means.items()}
        prior = predictions.prior_replicates(model, prior_key)
        likelihood = predictions.log_likelihood(model, draws, data, means)
        replicated = predictions.replicates(model, some, posterior_key, at_some)
        replicated_prior = {name: values[None] for name, values in prior.data.items()}
        for group in (likelihood, replicated, replicated_prior):
            group |= {name: group[name][..., None] for name in single}
        groups["posterior_predictive"] = replicated
        groups["prior"] = {name: values[None] for name, values in prior.draws.items()}
        groups["prior_predictive"] = replicated_prior
        tree = base.from_dict(groups, dims=dims, coords=coords)
        # Dependent data have one number a draw and no data dimensions.
        full = {name: np.atleast_1d(values).ndim + 2 for name, values in data.items()}
        pointwise = {n: dims[n] for n, v in likelihood.items() if n in dims and v.ndim == full[n]}
        used = {name for names in pointwise.values() for name in names}
        coords = {name: values for name, values in coords.items() if name in used}
        labelled = base.dict_to_dataset(likelihood, dims=pointwise, coords=coords)  # type: ignore[arg-type]
        tree["log_likelihood"] = xr.DataTree(labelled)
        replicated_group = tree["posterior_predictive"].to_dataset()
        tree["posterior_predictive"] = xr.DataTree(replicated_group.assign_coords(draw=rows))
    _write_units(tree, model)
    return tree


def _write_units(tree: xr.DataTree, model: Model) -> None:
    """Write units of parameters, observations, unknown numbers of noise, and positions."""
    parameters = {p.name: p.unit for p in model.forward.scene.parameters}
    units = {name: parameters[split(name)[0]] for name in model.states.unknowns}
    for name, part in model.observe.parts.items():
        units[name] = part.unit
        # The unknown numbers of every noise are standard deviations and the like.
        units |= dict.fromkeys(model.noise_sites[name].values(), part.unit)
    for group in _WITH_UNITS:
        if group in tree:
            for name in units.keys() & tree[group].data_vars:
                tree[group][name].attrs["units"] = units[name] or "1"
    if "constant_data" in tree:  # reference positions
        for constant in tree["constant_data"].data_vars:
            tree["constant_data"][str(constant)].attrs["units"] = "mm"
