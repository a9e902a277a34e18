"""One calibration from start to end: data, forward map, posterior, certificate, files.

A :class:`Run` is plain JSON and is kept as ``run.json`` beside its results: they can be certified
again, or repeated.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from shutil import copyfile
from typing import Any

import jax.numpy as jnp
import numpy as np

from calibrate.certificate import Certificate, examine
from calibrate.certificate.reweight import keeps, reweighted
from calibrate.data import read_data, write_data
from calibrate.kept import check_forward, check_run, restore_error
from calibrate.learned_error import with_error
from calibrate.load_states import known_thetas
from calibrate.noise import Noise, noise_of, with_discrepancy
from calibrate.observations import (
    DISPLACEMENT,
    Observations,
    observations_from_json,
    parse_observation,
)
from calibrate.observations.present import missing_values
from calibrate.posterior import Posterior, read_tree, sample
from calibrate.samplers import find_sampler, options_from
from calibrate.state_names import split
from calibrate.statistical_model import Model, at_sites, model
from emulator import schema
from emulator.catalogue import find_scene
from emulator.errors import InputError
from emulator.fem import Simulator
from emulator.scenes.scene import Scene
from emulator.store import save_arrays, write_json
from emulator.surrogates import registry
from emulator.surrogates.fem import fem_forward
from emulator.surrogates.kind import Ingredients
from emulator.surrogates.protocol import ForwardMap

RUN, DATA, POSTERIOR, CERTIFICATE = "run.json", "data.csv", "posterior.nc", "certificate.json"
FORWARD, ERROR = "forward.safetensors", "error.safetensors"
SAMPLING = "sampling.safetensors"  # of a run under way, or killed


@dataclass(frozen=True)
class Run:
    """What to calibrate and how.

    scene, root : a scene's name or file; the folder of the published data.
    data : a file, or ``synthetic``: FEM at ``truth`` plus noise.
    truth : parameters of synthetic data by name, ``parameter@state`` in one of several load states
        (:mod:`calibrate.state_names`).
    known : parameters that are not inferred, by the same names. They are those of synthetic data
        too, unless ``truth`` says otherwise.
    observe : observations of synthetic data, joined by ``+``, e.g. ``landmarks:24+volume``; each
        kind of :data:`calibrate.observations.KINDS` says which words ask for it. They are made in
        every load state that ``truth`` and ``known`` name; ``volume@diastole`` in one.
    noise : standard deviation by the observation's name, in its unit, or a kind of
        :data:`calibrate.noise.KINDS` with its options, ``{"kind": "student_t", "dof": 4, "scale":
        0.2}``. A bare number belongs to a single observation, or to the displacements. What is not
        named has its kind's default.
    noise_scale : the same for the scale of the prior of a standard deviation that is to be
        inferred; synthetic data then still has the one of ``noise``.
    discrepancy : discrepancy of the model (:mod:`calibrate.noise.discrepancy`) by the
        observation's name, e.g. ``{"scale": 0.5, "length": 20.0}``; synthetic data has none.
    check_scale : refuse data that is far from every prediction (:mod:`calibrate.magnitude`).
    forward, forward_options : a name of :data:`emulator.surrogates.registry.FORWARD_MAPS`, and its
        options by name, e.g. ``{"fem_runs": 60}``; ``emulator`` a shipped name or folder.
    error_runs : FEM runs from which the forward map's own error is learned, so that the likelihood
        allows for it (:mod:`calibrate.approximation_error`); 0 takes the map as exact.
    sampler, sampler_options : a name of :data:`calibrate.samplers.SAMPLERS`, and its options by
        name, e.g. ``{"target_accept": 0.95}``.
    """

    scene: str
    root: str | None = None
    data: str = "synthetic"
    truth: dict[str, float] = field(default_factory=dict)
    known: dict[str, float] = field(default_factory=dict)
    observe: str = "nodes:20"
    noise: Mapping[str, float | dict[str, Any]] | float = field(default_factory=dict)
    noise_scale: Mapping[str, float] | float = field(default_factory=dict)
    discrepancy: Mapping[str, dict[str, Any]] = field(default_factory=dict)
    check_scale: bool = True
    forward: str = "emulator"
    emulator: str | None = None
    forward_options: dict[str, Any] = field(default_factory=dict)
    error_runs: int = 0
    sampler: str = "nuts"
    sampler_options: dict[str, Any] = field(default_factory=dict)
    warmup: int = 500
    draws: int = 1000
    chains: int = 4
    seed: int = 0

    def __post_init__(self) -> None:
        registry.full_options(self.forward, self.forward_options)
        registry.check_emulator(self.forward, self.emulator)
        for name in ("warmup", "draws", "chains"):
            if getattr(self, name) < 1:
                raise InputError(f"{name} is {getattr(self, name)}; it must be 1 or more")
        if self.error_runs < 0:
            raise InputError(f"error_runs is {self.error_runs}; it must be 0 or more")
        if self.seed < 0:
            raise InputError(f"seed is {self.seed}; it must be 0 or more")

    def named(self, observe: Observations) -> Run:
        """The run with every noise by name, the defaults filled in."""
        scales = _by_name(self.noise_scale, observe, "noise-scale")
        given = _by_name(self.noise, observe, "noise")
        full = observe.expand(given, "noise")
        defaults = {
            split(name)[0]: part.default_noise.upper_sd
            for name, part in observe.parts.items()
            if name not in full
        }
        return replace(self, noise={**defaults, **given}, noise_scale=scales)

    def noises(self, observe: Observations) -> dict[str, Noise]:
        """Noise of each observation in the likelihood."""
        run = self.named(observe)
        assert isinstance(run.noise, Mapping)
        assert isinstance(run.noise_scale, Mapping)
        inferred = observe.expand(run.noise_scale, "noise-scale")
        wrong = observe.expand(run.discrepancy, "discrepancy")
        found: dict[str, Noise] = {}
        for name, (source, given) in observe.expand(run.noise, "noise").items():
            source, scale = inferred.get(name, (source, None))
            source, discrepancy = wrong.get(name, (source, None))
            found[source] = _noise(name, observe, given, scale, discrepancy)
        return found

    def synthetic_noise(self, observe: Observations) -> dict[str, Noise]:
        """Noise of each observation of synthetic data."""
        named = replace(self, noise_scale={}, discrepancy={}).noises(observe)
        each = {name: noise for name, (_, noise) in observe.expand(named, "noise").items()}
        return at_sites(each, observe)


def _by_name[T](
    given: Mapping[str, T] | float, observe: Observations, what: str
) -> dict[str, T | float]:
    """Values by the observation's name; a bare one is a single observation's or displacements'.

    A name without its load state stands for every state.
    """
    if not isinstance(given, Mapping):
        bases = list(dict.fromkeys(split(name)[0] for name in observe.parts))
        if len(bases) > 1 and DISPLACEMENT not in bases:
            raise InputError(f"{what}: give one for each of {', '.join(bases)}, by name")
        return {DISPLACEMENT if len(bases) > 1 else bases[0]: given}
    observe.expand(given, what)
    return dict(given)


def _noise(
    name: str,
    observe: Observations,
    given: float | Mapping[str, Any],
    scale: float | None,
    discrepancy: Mapping[str, Any] | None,
) -> Noise:
    try:
        noise = noise_of(given)
        noise = noise if scale is None else noise.inferred(scale)
        return noise if discrepancy is None else with_discrepancy(noise, discrepancy)
    except InputError as error:
        raise InputError(f"{name} ({observe.parts[name].unit}): {error}") from error


@lru_cache(maxsize=2)
def simulator_of(scene: Scene) -> Simulator:
    """The simulator of a scene, compiled once for data, campaign and certificate."""
    return Simulator(scene)


def ingredients_of(run: Run, scene: Scene, *, progress: bool = False) -> Ingredients:
    """What the forward map of a run is built from."""
    return Ingredients(scene, simulator_of(scene), run.emulator, run.seed, progress=progress)


def build_forward(run: Run, scene: Scene, *, progress: bool = False) -> ForwardMap:
    """The forward map a run asks for, over all nodes."""
    made_of = ingredients_of(run, scene, progress=progress)
    return registry.build_forward(run.forward, made_of, run.forward_options)


def restore_forward(run: Run, scene: Scene, folder: Path) -> ForwardMap:
    """The forward map of the run kept in ``folder``."""
    made_of = ingredients_of(run, scene)
    return registry.restore_forward(run.forward, made_of, run.forward_options, folder / FORWARD)


def make_data(run: Run, scene: Scene) -> tuple[Observations, dict[str, np.ndarray]]:
    """Observations and data of a run by name, read from a file or made by FEM."""
    if run.data != "synthetic":
        return read_data(scene, run.data)
    observe = observed(run, scene)
    thetas = known_thetas(scene, observe.states, {**run.known, **run.truth})
    noises = run.synthetic_noise(observe)
    fields = [simulator_of(scene)(theta)[observe.nodes] for theta in thetas]
    exact = observe(jnp.stack(fields), thetas)
    rng = np.random.default_rng([run.seed, 1])
    return observe, {
        name: np.asarray(exact[name]) + noises[name].simulate(rng, part.shape)
        for name, part in observe.parts.items()
    }


def observed(run: Run, scene: Scene) -> Observations:
    """What a run observes, without making or reading its data if it is synthetic."""
    if run.data != "synthetic":
        return read_data(scene, run.data)[0]
    states = dict.fromkeys(state for _, state in map(split, {**run.known, **run.truth}) if state)
    return parse_observation(scene, run.observe, run.seed, tuple(states) or ("",))


def build_model(run: Run, scene: Scene, observe: Observations, *, progress: bool = False) -> Model:
    """The statistical model of a run, before its data."""
    forward = build_forward(run, scene, progress=progress)
    noises = run.noises(observe)
    return model(forward, observe, noises, known=run.known, check_scale=run.check_scale)


def model_before_data(run: Run, *, progress: bool = False) -> Model:
    """The statistical model of a run that has no data yet."""
    scene = find_scene(run.scene, run.root)
    observe = observed(run, scene)
    return build_model(run.named(observe), scene, observe, progress=progress)


def by_fem(model: Model) -> Model:
    """``model`` with FEM as its forward map, to make the data it is checked with."""
    whole = fem_forward(simulator_of(model.forward.scene), model.full)
    return replace(model, full=whole, forward=whole.at(model.observe.nodes), error=None)


def infer(run: Run, folder: str | Path | None = None, *, progress: bool = False) -> Posterior:
    """Sample the posterior of a run; with ``folder``, keep run, data and posterior there.

    A run into ``folder`` that was killed while sampling goes on where it was.
    """
    sampler = find_sampler(run.sampler)
    length = {"warmup": run.warmup, "draws": run.draws, "chains": run.chains}
    options = options_from(sampler, run.sampler_options, **length)
    scene = find_scene(run.scene, run.root)
    observe, data = make_data(run, scene)
    run = run.named(observe)
    built = build_model(run, scene, observe, progress=progress)
    kept: Mapping[str, Any] = data
    if run.error_runs:
        built, kept = built.given(data)
        built = with_error(
            built, simulator_of(scene), run.error_runs, seed=run.seed, progress=progress
        )
    posterior = sample(
        built,
        kept,
        sampler=run.sampler,
        options=options,
        seed=run.seed,
        progress=progress,
        simulator=simulator_of(scene) if sampler.solves_fem else None,
        checkpoint=None if folder is None else Path(folder) / SAMPLING,
    )
    if folder is not None:
        folder = Path(folder)
        # An earlier result is removed first and the posterior is written last: a run that is killed
        # leaves no posterior, rather than one beside the certificate of another.
        for name in (CERTIFICATE, POSTERIOR, FORWARD, ERROR):
            (folder / name).unlink(missing_ok=True)
        write_data(folder / DATA, observe, data)
        write_json(folder / RUN, asdict(run))
        registry.keep_forward(posterior.model.full, folder / FORWARD)
        if posterior.model.error is not None:
            save_arrays(folder / ERROR, posterior.model.error.arrays(), {})
        posterior.tree.attrs["run"] = json.dumps(asdict(run))
        posterior.save(folder / POSTERIOR)
    return posterior


def read_posterior(folder: str | Path) -> tuple[Run, Posterior]:
    """The run kept in ``folder`` and its posterior, ready to be certified.

    Raises
    ------
    InputError
        A file is missing or damaged, or the posterior was not made with this run, its scene or its
        forward map.
    """
    folder = Path(folder)
    path = folder / POSTERIOR
    run = schema.read_json_as(Run, folder / RUN)
    scene = find_scene(run.scene, run.root)
    tree = read_tree(path)
    if tree.attrs.get("scene_fingerprint") != scene.fingerprint:
        raise InputError(f"{path} was made for another scene than '{run.scene}'")
    check_run(path, tree, asdict(run))
    forward = restore_forward(run, scene, folder)
    check_forward(path, tree, forward)
    observe = observations_from_json(scene, json.loads(tree.attrs["observe"]))
    noises = run.noises(observe)
    # Its data was checked when it was sampled, or the check was overruled.
    built: Model = model(forward, observe, noises, known=run.known, check_scale=False)
    if run.error_runs:
        error = restore_error(path, tree, folder / ERROR)
        built = replace(built, error=error)
    kept = tree["observed_data"]
    data = built.check_data(
        {n: np.asarray(kept[n]).reshape(part.shape) for n, part in observe.parts.items()}
    )
    return run, Posterior(tree, built, data)


def certify_and_keep(
    posterior: Posterior,
    folder: str | Path,
    *,
    draws: int | None = None,
    reweight_to: str | Path | None = None,
    progress: bool = False,
) -> Certificate:
    """Check a posterior against FEM and write certificate.json.

    With ``reweight_to``, the reweighted posterior is kept in that folder, ready to be certified in
    its turn, where the verdict allows it (:func:`calibrate.certificate.reweight.keeps`).

    Raises
    ------
    InputError
        FEM has decided on the draws already.
    """
    if find_sampler(posterior.tree.attrs["sampler"]).solves_fem:
        raise InputError(
            f"the posterior of sampler '{posterior.tree.attrs['sampler']}' is FEM's already; it "
            "needs no certificate"
        )
    simulator = simulator_of(posterior.model.forward.scene)
    check = examine(posterior, simulator, draws=draws, progress=progress)
    write_json(Path(folder) / CERTIFICATE, check.certificate.to_json())
    if reweight_to is not None and keeps(check.certificate):
        _keep_reweighted(reweighted(check), Path(folder), Path(reweight_to))
    return check.certificate


def _keep_reweighted(posterior: Posterior, source: Path, target: Path) -> None:
    """``posterior`` beside copies of the run, data and map it is from."""
    target.mkdir(parents=True, exist_ok=True)
    for name in (CERTIFICATE, POSTERIOR, FORWARD, ERROR):
        (target / name).unlink(missing_ok=True)
    for name in (RUN, DATA, FORWARD, ERROR):
        if (source / name).exists():
            copyfile(source / name, target / name)
    posterior.save(target / POSTERIOR)


def report(run: Run, posterior: Posterior, certificate: Certificate | None) -> dict[str, Any]:
    """The result as plain JSON: parameter table, diagnostics, verdict."""
    table = posterior.summary()
    for name, row in table.items() if run.data == "synthetic" else ():
        if (value := run.truth.get(name, run.truth.get(split(name)[0]))) is not None:
            row["truth"] = value
    result: dict[str, Any] = {
        "scene": run.scene,
        "forward": run.forward,
        "parameters": table,
        "divergences": posterior.divergences,
        "verdict": "not certified",
        "k_hat": None,
        "prior_cut": dict(posterior.model.prior_cut),
        "missing": missing_values(posterior.model.observe),
        "draws": int(posterior.tree["posterior"].sizes["draw"]),
        "chains": int(posterior.tree["posterior"].sizes["chain"]),
        "warnings": posterior.warnings(),
    }
    if "fem_solves" in posterior.tree.attrs:
        result["fem_solves"] = int(posterior.tree.attrs["fem_solves"])
        result["verdict"] = "decided by FEM"
    if "log_evidence" in posterior.tree.attrs:
        result["log_evidence"] = posterior.tree.attrs["log_evidence"]
        result["log_evidence_error"] = posterior.tree.attrs.get("log_evidence_error")
    if certificate is not None:
        result.update(verdict=certificate.verdict, k_hat=certificate.k_hat)
        result["certificate"] = certificate.to_json()
    return result
