"""One heart's frames between its waves of filling: what they tell, and frames nobody has seen.

    python -m studies.human_heart --data DIR           # DIR has LV_ENDOCARDIAL_016.obj and so on
    python -m studies.human_heart --data DIR --quick --out OUT
    python -m studies.human_heart --judge DIR          # DIR has the frames that were kept apart

Writes results.json, with 90 % bands of three surfaces and of the right cavity's volume in frames
kept apart, given the left cavity's volume alone, and human_heart.png. Meshing needs Gmsh.
"""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any

import jax
from studies.common.output import Case, Results, parser, run
from studies.human_heart.bands import KEPT_APART, bands_of, judged
from studies.human_heart.figures import draw
from studies.human_heart.heart import FRAMES, LENGTH, SURFACES, scene_of, surfaces_of
from studies.human_heart.twins import coverage, twin, unloaded_volumes

import calibrate as cal
import emulator as em
from calibrate.measurements.collection import observations
from calibrate.measurements.frames import frame_data
from emulator.core.errors import InputError
from emulator.scenes import Scene
from emulator.scenes.loads import KPA_PER_MMHG
from emulator.training import recipe, train

HERE = Path(__file__).parent
SEED = 18
POINTS, RUNS, TWINS = 60, 44, 20  # of a surface, as data; FEM runs of the emulator; hearts
# Pressures by frame, mmHg: mean and sd of the left one; the right one is a fifth to a quarter.
PRESSURES = {"f016": (5.0, 2.0), "f020": (5.0, 2.0), "f022": (6.0, 2.5), "f024": (8.0, 4.0)}
AT_REST = (5.0, 2.0)  # in the frame that is meshed


def prior_of(scene: Scene, frames: tuple[str, ...]) -> dict[str, Any]:
    """Pressures as physiology has them; the rest by the scene's ranges."""
    ranges = {p.name: (p.low, p.high) for p in scene.parameters}

    def about(name: str, mean: float, sd: float) -> Any:
        return cal.truncated_normal(mean * KPA_PER_MMHG, sd * KPA_PER_MMHG, *ranges[name])

    prior = {"imaged": about("imaged", *AT_REST)}
    prior["imaged_right"] = about("imaged_right", *(0.225 * x for x in AT_REST))
    for frame in frames:
        mean, sd = PRESSURES[frame]
        prior[f"pressure@{frame}"] = about("pressure", mean, sd)
        prior[f"right_pressure@{frame}"] = about("right_pressure", 0.225 * mean, 0.225 * sd)
    return prior


def model_of(
    scene: Scene, forward: Any, folder: Path, frames: tuple[str, ...], quick: bool
) -> tuple[cal.Model, Any]:
    """The model of these frames' surfaces, and their data.

    Volumes are of the same surfaces, and would count them twice.
    """
    observe, data = frame_data(
        scene,
        {
            f"{name}@{frame}": surface
            for frame in frames
            for name, surface in surfaces_of(folder, frame).items()
        },
        12 if quick else POINTS,
    )
    observe = observations(
        {n: part for n, part in observe.parts.items() if n.startswith("surface")}
    )
    noise = {
        f"surface:{name}": cal.CorrelatedNoise(LENGTH, sd_scale=0.5, spatial_sd_scale=1.5)
        for name in SURFACES
    }
    model = cal.model(forward, observe, noise, prior_of(scene, frames))
    return model, {name: data[name] for name in observe.parts}


def posterior_of(model: cal.Model, data: Any, quick: bool) -> cal.Posterior:
    """The posterior of material, supports and pressures."""
    draws = 50 if quick else 250
    options = cal.NUTSOptions(warmup=draws, draws=draws, chains=2, rounds=1 if quick else 2)
    return cal.sample(model, data, sampler="nuts", options=options, seed=SEED, predictions=False)


def told_by(found: cal.Posterior, scene: Scene) -> Case:
    """Means, sds and 90 % intervals of all unknowns, and the quality of the draws."""
    volumes = {
        name: {"mean": float(v.mean()), "sd": float(v.std())}
        for name, v in unloaded_volumes(found, scene).items()
    }
    return {
        "posterior": found.summary(),
        "unloaded_ml": volumes,
        "divergences": found.divergences,
        "box": [str(end) for end in found.box_ends()],
    }


def emulated(scene: Scene, folder: Path, quick: bool) -> tuple[em.Emulator, Case]:
    """The emulator of unloading and loading, and its error; one that is in ``folder`` is kept."""
    if not (folder / "emulator.json").is_file():
        plan = replace(recipe("mechanics"), simulations=12 if quick else RUNS, order=1, seed=SEED)
        emulator = train(scene, plan, folder, progress=True)
        em.save_emulator(emulator, folder)
    emulator = em.load(folder, scene)
    return emulator, {
        "nodes": len(scene.mesh.nodes),
        "record": emulator.record.get("discrepancy"),
    }


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
        raise InputError("give --data DIR, the folder of the surfaces")
    quick, data = arguments.quick, arguments.data
    keep = arguments.keep or arguments.out / "emulator"
    scene = scene_of(data, keep.parent)
    results = Results(arguments.out, SEED, again=arguments.again, settings={"quick": quick})
    emulator, trained = emulated(scene, keep, quick)
    forward = emulator.cache()
    results.case("emulator", lambda: trained)

    def of_frames(frames: tuple[str, ...], judge: tuple[str, ...]) -> Case:
        began = perf_counter()
        model, given = model_of(scene, forward, data, frames, quick)
        found = posterior_of(*model.given(given), quick)
        case = told_by(found, scene)
        case["bands"] = bands_of(found, scene, forward, data, frames, quick)
        case["judged"] = judged(case["bands"], data, judge)
        case["seconds"] = perf_counter() - began
        return case

    frames = FRAMES[2:] if quick else FRAMES
    results.case("all frames", lambda: of_frames(frames, frames))
    for frame in () if quick else FRAMES:
        others = tuple(other for other in FRAMES if other != frame)
        case = results.case(f"without {frame}", lambda o=others, f=frame: of_frames(o, (f,)))
        case.pop("bands", None)
        jax.clear_caches()
    model, _ = model_of(scene, forward, data, FRAMES, quick)
    twins = [
        results.case(
            f"twin {k}", lambda k=k: twin(k, model, scene, partial(posterior_of, quick=quick))
        )
        for k in range(1 if quick else arguments.twins)
    ]
    results.write(coverage=coverage(twins))
    draw({case["name"]: case for case in results.cases}, arguments.out / "human_heart.png")


if __name__ == "__main__":
    run(main)
