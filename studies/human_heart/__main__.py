"""One heart's frames between its waves of filling: what they tell, and frames nobody has seen.

    python -m studies.human_heart --data DIR           # DIR has LV_ENDOCARDIAL_016.obj and so on
    python -m studies.human_heart --data DIR --quick --out OUT
    python -m studies.human_heart --judge DIR          # DIR has the frames that were kept apart

Writes results.json, with 90 % bands of three surfaces and of the right cavity's volume in frames
kept apart, given the left cavity's volume alone, human_heart.png and surface.png. It takes Gmsh.
"""

from __future__ import annotations

import json
import tomllib
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from time import perf_counter
from typing import Any

import jax
import numpy as np
from studies.common.output import Case, Results, parser, run
from studies.human_heart.bands import KEPT_APART, bands_of, judged
from studies.human_heart.figures import draw, draw_surface
from studies.human_heart.heart import (
    AS_IMAGED,
    CONTRACTING,
    FRAMES,
    LENGTH,
    OTHERS,
    SYSTOLE,
    Assumed,
    scene_of,
    surfaces_of,
)
from studies.human_heart.twins import coverage, twin, unloaded_volumes

import calibrate as cal
import emulator as em

HERE = Path(__file__).parent
SEED = 18
POINTS, RUNS, TWINS = 60, 99, 20  # of a surface, as data; FEM runs of the emulator; hearts
FEWER, FEWEST = 44, 30  # FEM runs of the emulators of other assumptions, and of contraction
MOMENTS = 100  # draws of which a mean and an sd are shown
CERTIFIED = 48  # FEM runs of the certificate, of four load states each
_CERTIFIED = (
    "verdict", "reason", "findings", "draws", "failed", "shift", "shift_error", "map_errors",
    "physics", "tail", "box", "sampling",
)  # fmt: skip
# Pressures by frame, mmHg: mean and sd of the left one; the right one is a fifth to a quarter.
PRESSURES = {"f016": (5.0, 2.0), "f020": (5.0, 2.0), "f022": (6.0, 2.5), "f024": (8.0, 4.0)}
PRESSURES[SYSTOLE] = (120.0, 15.0)
AT_REST = (5.0, 2.0)  # in the frame that is meshed
_MATERIAL = ("a", "a_f", "imaged", "imaged_right", "pericardium", "annulus")


def prior_of(scene: em.Scene, frames: tuple[str, ...], told: Case | None = None) -> dict[str, Any]:
    """Pressures as physiology has them; the rest by the scene's ranges, or as ``told`` has it.

    told : means and sds of parameters that other frames told.
    """
    ranges = {p.name: (p.low, p.high) for p in scene.parameters}

    def about(name: str, mean: float, sd: float) -> Any:
        return cal.priors.truncated_normal(
            mean * em.loads.KPA_PER_MMHG, sd * em.loads.KPA_PER_MMHG, *ranges[name]
        )

    priors = {"imaged": ("imaged", 1.0, AT_REST), "imaged_right": ("imaged_right", 0.225, AT_REST)}
    for frame in frames:
        priors[f"pressure@{frame}"] = ("pressure", 1.0, PRESSURES[frame])
        priors[f"right_pressure@{frame}"] = ("right_pressure", 0.225, PRESSURES[frame])
    prior = {
        unknown: about(name, share * mean, share * sd)
        for unknown, (name, share, (mean, sd)) in priors.items()
        if name in ranges
    }
    for name, row in (told or {}).items():
        if name in ranges:
            prior[name] = cal.priors.truncated_normal(row["mean"], row["sd"], *ranges[name])
    return prior


def model_of(
    scene: em.Scene, forward: Any, folder: Path, frames: tuple[str, ...], quick: bool,
    assumed: Assumed = AS_IMAGED, told: Case | None = None,
) -> tuple[cal.Model, Any]:  # fmt: skip
    """The model of these frames' surfaces, and their data.

    Volumes are of the same surfaces, and would count them twice.
    """
    observe, data = cal.fields.frame_data(
        scene,
        {
            f"{facets}@{frame}": surfaces_of(folder, frame)[surface]
            for frame in frames
            for facets, surface in assumed.surfaces.items()
        },
        12 if quick else POINTS,
    )
    observe = cal.Observations(
        {n: part for n, part in observe.parts.items() if n.startswith("surface")}
    )
    noise = {
        f"surface:{name}": cal.CorrelatedNoise(LENGTH, sd_scale=0.5, spatial_sd_scale=1.5)
        for name in assumed.surfaces
    }
    model = cal.model(forward, observe, noise, prior_of(scene, frames, told))
    return model, {name: data[name] for name in observe.parts}


def posterior_of(model: cal.Model, data: Any, quick: bool) -> cal.Posterior:
    """The posterior of material, supports and pressures."""
    draws = 50 if quick else 250
    options = cal.samplers.NUTSOptions(
        warmup=draws, draws=draws, chains=2, rounds=1 if quick else 2, target_accept=0.95
    )
    return cal.sample(model, data, sampler="nuts", options=options, seed=SEED, predictions=False)


def told_by(found: cal.Posterior, scene: em.Scene, assumed: Assumed = AS_IMAGED) -> Case:
    """Means, sds and 90 % intervals of all unknowns, and the quality of the draws."""
    volumes = {} if assumed.contracts else unloaded_volumes(found, scene, assumed.cavities)
    return {
        "posterior": found.summary(),
        "unloaded_ml": {
            name: {"mean": float(v.mean()), "sd": float(v.std())} for name, v in volumes.items()
        },
        "divergences": found.divergences,
        "box": [str(end) for end in found.box_ends()],
    }


def on_surface(found: cal.Posterior, scene: em.Scene, frame: str) -> Case:
    """Mean and sd of the surface's displacement from the imaged frame, at the nodes, mm."""
    thetas = found.thetas(frame)[:: -(-len(found.thetas(frame)) // MOMENTS)]
    nodes = np.unique(scene.mesh.surface[:, :3])
    at = found.model.full.at(nodes)
    u = np.asarray(jax.jit(lambda t: jax.lax.map(at, t))(thetas))
    return {
        "frame": frame,
        "nodes": nodes.tolist(),
        "moved": u.mean(axis=0).round(2).tolist(),
        "mean": np.linalg.norm(u, axis=2).mean(axis=0).round(2).tolist(),
        "sd": np.sqrt(u.var(axis=0).sum(axis=1)).round(3).tolist(),
    }


def emulated(
    scene: em.Scene, folder: Path, quick: bool, runs: int = RUNS
) -> tuple[em.Emulator, Case]:
    """The emulator of unloading and loading, and its error; one that is in ``folder`` is kept."""
    if not (folder / "emulator.json").is_file():
        plan = replace(
            em.recipe("mechanics"), simulations=12 if quick else runs, order=1, seed=SEED
        )
        emulator = em.train(scene, plan, folder, progress=True)
        em.save_emulator(emulator, folder)
    emulator = em.load(folder, scene)
    return emulator, {
        "nodes": len(scene.mesh.nodes),
        "record": emulator.record.get("discrepancy"),
    }


def under(assumed: Assumed, data: Path, folder: Path, passive: Case) -> Case:
    """The posterior under other assumptions, or of the end of systole.

    passive : means and sds of what the frames between the waves told, for the end of systole.
    """
    folder /= assumed.name.replace(" ", "_")
    scene = scene_of(data, folder, assumed)
    runs = FEWEST if assumed.contracts else FEWER
    emulator, trained = emulated(scene, folder / "emulator", quick=False, runs=runs)
    frames, told = ((SYSTOLE,), passive) if assumed.contracts else (FRAMES, None)
    began = perf_counter()
    model, given = model_of(scene, emulator.cache(), data, frames, False, assumed, told)
    found = posterior_of(*model.given(given), quick=False)
    case = {**told_by(found, scene, assumed), "emulator": trained}
    return {**case, "seconds": perf_counter() - began}


def main() -> None:
    """Run the study."""
    words = parser(__doc__, HERE)
    words.add_argument("--data", type=Path, help="folder of the surfaces")
    words.add_argument("--judge", type=Path, metavar="DIR", help="folder of frames kept apart")
    words.add_argument("--keep", type=Path, help="folder that keeps the emulator")
    words.add_argument("--twins", type=int, default=TWINS, help=f"number of twins ({TWINS})")
    arguments = words.parse_args()
    if arguments.judge is not None:
        there = json.loads((arguments.out / "results.json").read_text())
        case = next(case for case in there["cases"] if case["name"] == "all frames")
        print(json.dumps(judged(case["bands"], arguments.judge, KEPT_APART), indent=2))
        return
    if arguments.data is None:
        raise em.InputError("give --data DIR, the folder of the surfaces")
    quick, data = arguments.quick, arguments.data
    keep = arguments.keep or arguments.out / "emulator"
    scene = scene_of(data, keep.parent)
    results = Results(arguments.out, SEED, again=arguments.again, settings={"quick": quick})
    emulator, trained = emulated(scene, keep, quick)
    forward = emulator.cache()
    results.case("emulator", lambda: trained)

    @cache
    def inferred(frames: tuple[str, ...]) -> cal.Posterior:
        model, given = model_of(scene, forward, data, frames, quick)
        return posterior_of(*model.given(given), quick)

    def of_frames(frames: tuple[str, ...], judge: tuple[str, ...]) -> Case:
        began = perf_counter()
        found = inferred(frames)
        case = told_by(found, scene)
        case["bands"] = bands_of(found, scene, forward, data, frames, quick)
        case["judged"] = judged(case["bands"], data, judge)
        case["seconds"] = perf_counter() - began
        return case

    def against_fem() -> Case:
        began = perf_counter()
        certificate = cal.certify(
            inferred(FRAMES), em.Simulator(scene), draws=CERTIFIED, mesh=0, seed=SEED, progress=True
        )
        told = certificate.to_json()
        return {name: told[name] for name in _CERTIFIED} | {"seconds": perf_counter() - began}

    frames = FRAMES[2:] if quick else FRAMES
    whole = results.case("all frames", lambda: of_frames(frames, frames))
    shown = results.case("surface", lambda: on_surface(inferred(frames), scene, frames[-1]))
    for frame in () if quick else FRAMES:
        others = tuple(other for other in FRAMES if other != frame)
        case = results.case(f"without {frame}", lambda o=others, f=frame: of_frames(o, (f,)))
        case.pop("bands", None)
        jax.clear_caches()
    if not quick:
        passive = {n: r for n, r in whole["posterior"].items() if n in _MATERIAL}
        for assumed in (*OTHERS, CONTRACTING):
            results.case(assumed.name, lambda a=assumed: under(a, data, keep.parent, passive))
            jax.clear_caches()
    model, _ = model_of(scene, forward, data, FRAMES, quick)
    twins = [
        results.case(
            f"twin {k}", lambda k=k: twin(k, model, scene, partial(posterior_of, quick=quick))
        )
        for k in range(1 if quick else arguments.twins)
    ]
    if not quick:
        results.case("certificate", against_fem)
    results.write(coverage=coverage(twins))
    draw({case["name"]: case for case in results.cases}, arguments.out / "human_heart.png")
    axis = np.array(tomllib.loads((keep.parent / "heart.toml").read_text())["fibres"]["axis"])
    draw_surface(shown, scene, axis, arguments.out / "surface.png")


if __name__ == "__main__":
    run(main)
