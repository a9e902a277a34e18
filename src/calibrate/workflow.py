"""One calibration from start to end: data, forward map, posterior, certificate, files.

A :class:`Run` is plain JSON, kept as ``run.json`` beside its results, so that any result can be
certified again or repeated.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from calibrate.certificate import Certificate, certify
from calibrate.data import DISPLACEMENT, is_volume, read_data, volume_of, write_data
from calibrate.noise import GaussianNoise
from calibrate.observations import (
    Landmarks,
    NodalDisplacements,
    Observation,
    Observations,
    landmarks,
    nodal_displacements,
    observations_from,
    spread_landmarks,
    spread_nodes,
)
from calibrate.posterior import Posterior, emulator_fingerprint, read_tree, sample
from calibrate.samplers import find_sampler
from calibrate.statistical_model import Model, model
from emulator.catalogue import find_scene
from emulator.errors import InputError
from emulator.fem import Simulator, run_campaign, sobol
from emulator.scenes.scene import Scene
from emulator.store import read_json, write_json
from emulator.surrogates import load
from emulator.surrogates.corrected import corrected
from emulator.surrogates.fem import fem_forward
from emulator.surrogates.pod_gp import fit_reduced
from emulator.surrogates.protocol import ForwardMap

FORWARDS = ("emulator", "corrected", "reduced", "fem")
RUN, DATA, POSTERIOR, CERTIFICATE = "run.json", "data.csv", "posterior.nc", "certificate.json"


@dataclass(frozen=True)
class Run:
    """What to calibrate and how.

    scene, root : a scene's name or file; where published data is.
    data : a file, or ``synthetic``: FEM at ``truth`` plus noise.
    truth : named parameters of synthetic data.
    observe : of synthetic data: ``nodes:20``, ``landmarks:24``, ``all``, a node set, ``3,14,15``,
        ``volume``, ``volume:<facet set>``, or several of these joined by ``+``.
    noise_sd : of displacements, mm; known unless ``noise_scale``, the scale of its prior, asks to
        infer it. volume_noise_sd, volume_noise_scale : the same of volumes, mL.
    forward : one of :data:`FORWARDS`; ``emulator`` a shipped name or folder; ``fem_runs`` those
        the reduced model is fitted to.
    """

    scene: str
    root: str | None = None
    data: str = "synthetic"
    truth: dict[str, float] = field(default_factory=dict)
    observe: str = "nodes:20"
    noise_sd: float | None = 0.2
    noise_scale: float | None = None
    volume_noise_sd: float | None = 1.0
    volume_noise_scale: float | None = None
    forward: str = "emulator"
    emulator: str | None = None
    fem_runs: int = 30
    sampler: str = "nuts"
    warmup: int = 500
    draws: int = 1000
    chains: int = 4
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("fem_runs", "warmup", "draws", "chains"):
            if getattr(self, name) < 1:
                raise InputError(f"{name} is {getattr(self, name)}; it must be 1 or more")
        if self.seed < 0:
            raise InputError(f"seed is {self.seed}; it must be 0 or more")

    def noise(self, observe: Observations) -> dict[str, GaussianNoise]:
        """The noise of each observation's likelihood."""
        return {
            name: self._noise(part, *self._given_noise(part))
            for name, part in observe.parts.items()
        }

    def synthetic_sd(self, part: Observation) -> float:
        """Standard deviation of a synthetic observation's noise, in its unit."""
        sd, _ = self._given_noise(part)
        if sd is None:
            raise InputError(
                f"synthetic data needs a noise standard deviation of the {part.quantity}, "
                f"{part.unit}"
            )
        self._noise(part, sd, None)
        return sd

    def _given_noise(self, part: Observation) -> tuple[float | None, float | None]:
        if part.quantity == "volume":
            return self.volume_noise_sd, self.volume_noise_scale
        return self.noise_sd, self.noise_scale

    def _noise(self, part: Observation, sd: float | None, scale: float | None) -> GaussianNoise:
        try:
            return GaussianNoise(sd if scale is None else None, scale)
        except InputError as error:
            raise InputError(f"{part.quantity} ({part.unit}): {error}") from error


@lru_cache(maxsize=2)
def simulator_of(scene: Scene) -> Simulator:
    """The simulator of a scene, compiled once for data, campaign and certificate."""
    return Simulator(scene)


def build_forward(run: Run, scene: Scene, *, progress: bool = False) -> ForwardMap:
    """The forward map a run asks for, over all nodes."""
    if run.forward not in FORWARDS:
        raise InputError(f"forward map '{run.forward}' is unknown; known: {', '.join(FORWARDS)}")
    if run.forward == "reduced":
        thetas = sobol(scene, run.fem_runs, run.seed)
        return fit_reduced(scene, run_campaign(simulator_of(scene), thetas, progress=progress))
    if run.forward == "fem":
        return fem_forward(simulator_of(scene))
    cached = load(run.emulator or scene.name, scene).cache()
    return cached if run.forward == "emulator" else corrected(cached, simulator_of(scene))


def parse_observation(scene: Scene, text: str, seed: int) -> Observations:
    """What the words joined by ``+`` stand for; see :class:`Run`."""
    parts: dict[str, Observation] = {}
    for word in text.split("+"):
        name = word if is_volume(word) else DISPLACEMENT
        if name in parts:
            raise InputError(f"observe '{text}': {name} is given twice; once is enough")
        parts[name] = (
            volume_of(scene, word) if is_volume(word) else _displacements(scene, word, seed)
        )
    return Observations(parts)


def _displacements(scene: Scene, text: str, seed: int) -> NodalDisplacements | Landmarks:
    kind, _, count = text.partition(":")
    if kind in ("nodes", "landmarks") and count:
        if not count.isdigit() or int(count) < 1:
            raise InputError(f"observe '{text}': '{count}' is not a number of {kind}")
        if kind == "nodes":
            return nodal_displacements(scene, spread_nodes(scene, int(count), seed))
        return landmarks(scene, spread_landmarks(scene, int(count), seed))
    if text == "all" or text in scene.mesh.node_sets:
        return nodal_displacements(scene, text)
    try:
        nodes = [int(word) for word in text.split(",")]
    except ValueError as error:
        raise InputError(
            f"observe '{text}': give nodes:N, landmarks:N, all, volume, node numbers like "
            f"3,14,15, or a node set: {', '.join(sorted(scene.mesh.node_sets)) or 'none here'}"
        ) from error
    return nodal_displacements(scene, nodes)


def make_data(run: Run, scene: Scene) -> tuple[Observations, dict[str, np.ndarray]]:
    """The observations and data of a run by name, read from a file or made by FEM."""
    if run.data != "synthetic":
        return read_data(scene, run.data)
    theta = scene.theta(**run.truth)
    observe = parse_observation(scene, run.observe, run.seed)
    sds = {name: run.synthetic_sd(part) for name, part in observe.parts.items()}
    exact = observe(simulator_of(scene)(theta)[observe.nodes])
    rng = np.random.default_rng([run.seed, 1])
    return observe, {
        name: np.asarray(exact[name]) + rng.normal(0.0, sds[name], part.shape)
        for name, part in observe.parts.items()
    }


def infer(run: Run, folder: str | Path | None = None, *, progress: bool = False) -> Posterior:
    """Sample the posterior of a run; with ``folder``, keep run, data and posterior there."""
    options = find_sampler(run.sampler).options(
        warmup=run.warmup, draws=run.draws, chains=run.chains
    )
    scene = find_scene(run.scene, run.root)
    observe, data = make_data(run, scene)
    noise = run.noise(observe)
    built = model(build_forward(run, scene, progress=progress), observe, noise)
    posterior = sample(
        built, data, sampler=run.sampler, options=options, seed=run.seed, progress=progress
    )
    if folder is not None:
        folder = Path(folder)
        # An earlier result goes first and the posterior comes last: killed in between, the folder
        # holds no posterior rather than one beside another's certificate.
        for name in (CERTIFICATE, POSTERIOR):
            (folder / name).unlink(missing_ok=True)
        write_data(folder / DATA, observe, data)
        write_json(folder / RUN, asdict(run))
        posterior.save(folder / POSTERIOR)
    return posterior


def read_posterior(folder: str | Path, *, progress: bool = False) -> tuple[Run, Posterior]:
    """The run kept in ``folder`` and its posterior, ready to be certified."""
    folder = Path(folder)
    text = read_json(folder / RUN)
    try:
        run = Run(**text)
    except TypeError as error:
        raise InputError(f"{folder / RUN} does not describe a run: {error}") from error
    scene = find_scene(run.scene, run.root)
    tree = read_tree(folder / POSTERIOR)
    if tree.attrs.get("scene_fingerprint") != scene.fingerprint:
        raise InputError(f"{folder / POSTERIOR} was made for another scene than '{run.scene}'")
    observe = observations_from(scene, json.loads(tree.attrs["observe"]))
    built: Model = model(build_forward(run, scene, progress=progress), observe, run.noise(observe))
    data = built.check_data({n: np.asarray(tree["observed_data"][n]) for n in observe.parts})
    made_with = tree.attrs.get("emulator_fingerprint")
    if made_with != (found := emulator_fingerprint(built.full)):
        raise InputError(
            f"{folder / POSTERIOR} was made with emulator {made_with}, but "
            f"'{run.emulator or scene.name}' is now {found}; infer again"
        )
    return run, Posterior(tree, built, data)


def certify_and_keep(
    posterior: Posterior, folder: str | Path, *, draws: int = 200, progress: bool = False
) -> Certificate:
    """Check a posterior against FEM and write certificate.json."""
    simulator = simulator_of(posterior.model.forward.scene)
    certificate = certify(posterior, simulator, draws=draws, progress=progress)
    write_json(Path(folder) / CERTIFICATE, certificate.to_json())
    return certificate


def report(run: Run, posterior: Posterior, certificate: Certificate | None) -> dict[str, Any]:
    """The result as plain JSON: parameter table, diagnostics, verdict."""
    table = posterior.summary()
    for name, value in run.truth.items() if run.data == "synthetic" else ():
        table[name]["truth"] = value
    result: dict[str, Any] = {
        "scene": run.scene,
        "forward": run.forward,
        "parameters": table,
        "divergences": posterior.divergences,
        "verdict": "not certified",
        "k_hat": None,
        "draws": int(posterior.tree["posterior"].sizes["draw"]),
        "chains": int(posterior.tree["posterior"].sizes["chain"]),
    }
    if certificate is not None:
        result.update(verdict=certificate.verdict, k_hat=certificate.k_hat)
        result["certificate"] = certificate.to_json()
    return result
