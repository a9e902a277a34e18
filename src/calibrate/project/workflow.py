"""One calibration from start to end: data, forward map, posterior, certificate, files.

The :class:`~calibrate.project.run.Run` is kept as ``run.json`` beside its results: they can be
certified again, or repeated.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, replace
from functools import lru_cache
from pathlib import Path
from shutil import copyfile
from tempfile import TemporaryDirectory
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from calibrate.certificate import Certificate, examine
from calibrate.certificate.check import can_reweight, reweighted
from calibrate.measurements import Observations, observations_from_json, parse_observation
from calibrate.measurements.data import read_data, read_known, write_data
from calibrate.measurements.present import missing_values
from calibrate.posterior import Posterior, read_tree, sample
from calibrate.priors import prior_of
from calibrate.project.restore import check_forward, check_run, keep_error, restore_error
from calibrate.project.run import Run
from calibrate.samplers import Sampler, find_sampler, options_from
from calibrate.state_names import split
from calibrate.statistical_model import Model, with_error
from calibrate.statistical_model.build import model
from calibrate.statistical_model.load_states import known_thetas, load_states
from calibrate.statistical_model.shared_errors import with_shared_errors
from emulator.catalogue import find_scene
from emulator.core import schema
from emulator.core.errors import InputError
from emulator.core.store import exclusive, read_json, write_json
from emulator.fem import NewtonOptions, Simulator
from emulator.scenes.scene import Scene
from emulator.surrogates import registry
from emulator.surrogates.fem import fem_forward
from emulator.surrogates.kind import Ingredients
from emulator.surrogates.protocol import ForwardMap

RUN, DATA, POSTERIOR, CERTIFICATE = "run.json", "data.csv", "posterior.nc", "certificate.json"
FORWARD, ERROR = "forward.safetensors", "error.safetensors"
REPORT = "report.html"
MEMBERS = "members"  # of a population: their entry in run.json, and the folder of their runs
_RESULTS = (REPORT, CERTIFICATE, POSTERIOR, FORWARD, ERROR)  # of a run that has ended
_NAMED = 4  # files of a folder that an error names
SAMPLING = "sampling.safetensors"  # of a run under way, or killed


@lru_cache(maxsize=2)
def simulator_of(scene: Scene, load_steps: int = 1) -> Simulator:
    """The simulator of a scene, compiled once for data, campaign and certificate."""
    return Simulator(scene, NewtonOptions.load_steps(load_steps))


def ingredients_of(run: Run, scene: Scene, *, progress: bool = False) -> Ingredients:
    """What the forward map of a run is built from."""
    simulator = simulator_of(scene, run.load_steps)
    return Ingredients(scene, simulator, run.emulator, run.seed, progress=progress)


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
    simulator = simulator_of(scene, run.load_steps)
    fields = [simulator(theta)[observe.nodes] for theta in thetas]
    exact = jax.jit(observe)(jnp.stack(fields), thetas)
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
    prior = prior_of(run.prior, scene)
    return model(forward, observe, noises, prior, known=run.known, check_scale=run.check_scale)


def model_before_data(run: Run, *, progress: bool = False) -> Model:
    """The statistical model of a run that has no data yet."""
    scene = find_scene(run.scene, run.root)
    run = with_known(run)
    observe = observed(run, scene)
    built = build_model(run.named(observe), scene, observe, progress=progress)
    if not run.systematic:
        return built
    # Some of these errors depend on where a body is seen: at a draw of the prior.
    draw = {name: each[0] for name, each in built.prior_draws(jax.random.key(run.seed), 1).items()}
    means = {name: np.asarray(mean) for name, mean in built.predict(draw)[0].items()}
    return with_shared_errors(built, means, run.systematic)[0]


def check_names(run: Run) -> None:
    """Refuse names that do not fit a run's scene and data, before a forward map is built.

    Raises
    ------
    InputError
        An observation, a parameter, a load state or an option of the sampler that is not there, by
        its name.
    """
    _sampler(run)
    scene, run = find_scene(run.scene, run.root), with_known(run)
    observe = observed(run, scene)
    run.noises(observe)
    load_states(scene, observe.states, prior_of(run.prior, scene), run.known)
    for name, description in run.systematic.items():
        words = dict.fromkeys(str(description["of"]).split("+"))
        observe.expand(words, f"systematic '{name}': of")


def with_known(run: Run) -> Run:
    """The run with all that is known of its load states, what its files say included.

    Raises
    ------
    InputError
        A file and the run say different things.
    """
    told = {} if run.data == "synthetic" else read_known(run.data)
    for name, value in told.items():
        if run.known.get(name, value) != value:
            raise InputError(
                f"known: '{name}' is {value} in the data file and {run.known[name]} beside it; "
                "say it once"
            )
    return replace(run, known={**told, **run.known})


def by_fem(model: Model) -> Model:
    """``model`` with FEM as its forward map, to make the data it is checked with."""
    whole = fem_forward(simulator_of(model.forward.scene), model.full)
    error = model.error if model.error is not None and model.error.of_fem else None
    return replace(model, full=whole, forward=whole.at(model.observe.nodes), error=error)


def infer(
    run: Run, folder: str | Path | None = None, *, force: bool = False, progress: bool = False
) -> Posterior:
    """Sample the posterior of a run; with ``folder``, keep run, data and posterior there.

    A run into ``folder`` that was killed while sampling goes on where it was. Results of an earlier
    run are replaced with ``force`` alone.

    Raises
    ------
    InputError
        ``folder`` has the results of an earlier run, or another process is writing to it.
    """
    if folder is None:
        return _sampled(run, None, progress=progress)[0]
    folder = Path(folder)
    with exclusive(folder / RUN, "run"):
        there = [name for name in _RESULTS if (folder / name).exists()]
        if there and not force:
            raise InputError(
                f"{folder} has results of an earlier run ({', '.join(there)}); replace them with "
                "--force (in Python: force=True), or name another folder"
            )
        posterior, run, observe, data = _sampled(run, folder / SAMPLING, progress=progress)
        with TemporaryDirectory(dir=folder, prefix=".new.") as made:
            _keep(posterior, run, observe, data, Path(made))
            # Earlier results go first and the posterior comes last: a run that is killed leaves no
            # posterior, rather than one beside the certificate of another.
            for name in _RESULTS:
                (folder / name).unlink(missing_ok=True)
            for path in sorted(Path(made).iterdir(), key=lambda path: path.name == POSTERIOR):
                path.replace(folder / path.name)
    return posterior


def _keep(
    posterior: Posterior,
    run: Run,
    observe: Observations,
    data: Mapping[str, np.ndarray],
    folder: Path,
) -> None:
    """Write all that a run leaves."""
    write_data(folder / DATA, observe, data)
    write_json(folder / RUN, asdict(run))
    registry.keep_forward(posterior.model.full, folder / FORWARD)
    if posterior.model.error is not None:
        keep_error(folder / ERROR, posterior.model.error)
    posterior.tree.attrs["run"] = json.dumps(asdict(run))
    posterior.save(folder / POSTERIOR)


def _sampler(run: Run) -> tuple[Sampler, Any]:
    """The sampler of a run and its options; :class:`InputError` for one that it does not have."""
    sampler = find_sampler(run.sampler)
    length = {"warmup": run.warmup, "draws": run.draws, "chains": run.chains}
    return sampler, options_from(sampler, run.sampler_options, **length)


def _sampled(
    run: Run, checkpoint: Path | None, *, progress: bool
) -> tuple[Posterior, Run, Observations, dict[str, np.ndarray]]:
    """The posterior of a run, the run with its noises by name, its observations and data."""
    sampler, options = _sampler(run)
    scene = find_scene(run.scene, run.root)
    run = with_known(run)
    observe, data = make_data(run, scene)
    run = run.named(observe)
    built = build_model(run, scene, observe, progress=progress)
    present: Mapping[str, Any] = data
    if run.systematic:
        built, present = with_shared_errors(built, data, run.systematic)
    if runs := run.error_runs or run.mesh_error_runs:
        built, present = built.given(data)
        # Now that the data is checked, sampling need not check it again.
        built = with_error(
            replace(built, check_scale=False),
            simulator_of(scene, run.load_steps),
            runs,
            of_mesh=bool(run.mesh_error_runs),
            seed=run.seed,
            progress=progress,
        )
    posterior = sample(
        built,
        present,
        sampler=run.sampler,
        options=options,
        seed=run.seed,
        progress=progress,
        simulator=simulator_of(scene, run.load_steps) if sampler.solves_fem else None,
        checkpoint=checkpoint,
    )
    return posterior, run, observe, data


def holds_population(folder: str | Path) -> bool:
    """Whether ``folder`` is a population's, instead of a run's.

    Raises
    ------
    InputError
        It is neither.
    """
    path = Path(folder) / RUN
    if not path.is_file():
        raise InputError(
            f"{path} does not exist: {_found(path.parent)}; give a folder that calibrate infer "
            "wrote, of a posterior or of a population"
        )
    kept = read_json(path)
    return isinstance(kept, dict) and isinstance(kept.get(MEMBERS), dict)


def _found(folder: Path) -> str:
    """What is there instead of a folder of results, in a few words."""
    if not folder.is_dir():
        return f"{folder} is a file" if folder.exists() else "there is no such folder"
    names = sorted(path.name for path in folder.iterdir())
    more = ", ..." if len(names) > _NAMED else ""
    return f"the folder holds {', '.join(names[:_NAMED]) or 'nothing'}{more}"


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
    if holds_population(folder):
        raise InputError(
            f"{folder} holds a population; name one of its members, {folder / MEMBERS}/NAME"
        )
    run = schema.read_json_as(Run, folder / RUN)
    scene = find_scene(run.scene, run.root)
    tree = read_tree(path)
    if tree.attrs.get("scene_fingerprint") != scene.fingerprint:
        raise InputError(f"{path} was made for another scene than '{run.scene}'")
    check_run(path, tree, read_json(folder / RUN))
    forward = restore_forward(run, scene, folder)
    check_forward(path, tree, forward)
    observe = observations_from_json(scene, json.loads(tree.attrs["observe"]))
    noises = run.noises(observe)
    # Its data was checked when it was sampled, or the check was overruled.
    prior = prior_of(run.prior, scene)
    built: Model = model(forward, observe, noises, prior, known=run.known, check_scale=False)
    if run.error_runs or run.mesh_error_runs or run.systematic:
        error = restore_error(path, tree, folder / ERROR)
        built = replace(built, error=error)
    observed = tree["observed_data"]
    data = built.check_data(
        {n: np.asarray(observed[n]).reshape(part.shape) for n, part in observe.parts.items()}
    )
    return run, Posterior(tree, built, data)


def load(folder: str | Path) -> Posterior:
    """The posterior kept in ``folder`` by :func:`infer` or ``calibrate infer``.

    Raises
    ------
    InputError
        As :func:`read_posterior`.
    """
    return read_posterior(folder)[1]


def certify_and_keep(
    posterior: Posterior,
    folder: str | Path,
    *,
    draws: int | None = None,
    at_most: int | None = None,
    mesh: int | None = None,
    load_steps: int = 1,
    reweight_to: str | Path | None = None,
    scheduler: str | None = None,
    progress: bool = False,
) -> Certificate:
    """Check a posterior against FEM and write certificate.json.

    ``at_most`` and ``mesh`` as of :func:`calibrate.certify`. ``load_steps`` are those of every
    solve. ``scheduler`` is the address of a Dask scheduler whose workers solve. With
    ``reweight_to``, the reweighted posterior is kept in that folder, ready to be certified in its
    turn, where the verdict allows it (:func:`calibrate.certificate.check.can_reweight`).

    Raises
    ------
    InputError
        FEM has decided on the draws already.
    """
    simulator = simulator_of(posterior.model.forward.scene, load_steps)
    check = examine(
        posterior,
        simulator,
        draws=draws,
        at_most=at_most,
        mesh=mesh,
        scheduler=scheduler,
        progress=progress,
    )
    write_json(Path(folder) / CERTIFICATE, check.certificate.to_json())
    _remove_pages(Path(folder).resolve())
    if reweight_to is not None and can_reweight(check.certificate):
        _keep_reweighted(reweighted(check), Path(folder), Path(reweight_to))
    return check.certificate


def _remove_pages(folder: Path) -> None:
    """Remove the pages that tell an earlier verdict: the run's, and its population's."""
    (folder / REPORT).unlink(missing_ok=True)
    above = folder.parent.parent
    if folder.parent.name == MEMBERS and (above / RUN).is_file() and holds_population(above):
        (above / REPORT).unlink(missing_ok=True)


def _keep_reweighted(posterior: Posterior, source: Path, target: Path) -> None:
    """``posterior`` beside copies of the run, data and map it is from."""
    target.mkdir(parents=True, exist_ok=True)
    for name in _RESULTS:
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
