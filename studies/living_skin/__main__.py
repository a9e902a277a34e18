"""Living skin between two pads: how stiff is a scar beside its skin?

    python -m studies.living_skin --data DIR          # DIR has keloid_points.csv and so on
    python -m studies.living_skin --data DIR --quick --out OUT
    python -m studies.living_skin --judge DIR         # DIR has the frames that were kept apart

Writes results.json, with 90 % bands of 60 points and of the force at motions of the pad that were
kept apart, living_skin.png and inclusions.png. It takes Gmsh.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from time import perf_counter
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from studies.common.output import Case, Results, parser, run
from studies.living_skin.bands import ALONG, FORCE_SD, LENGTH, SD, Bands, bands_of, judged
from studies.living_skin.figures import draw, draw_inclusions
from studies.living_skin.skin import (
    FORCE,
    HEALTHY,
    KELOID,
    LAWS,
    Measured,
    Skin,
    data_of,
    force_of,
    measured_of,
    scene_of,
)
from studies.living_skin.twins import coverage, inclusion_twin, stiffness_logs, twins_of

import calibrate as cal
import emulator as em

HERE = Path(__file__).parent
SEED = 61
POINTS, RUNS, FEWER = 60, 120, 60  # points as data; FEM runs with a field, and without
CERTIFIED = 48
TWINS, FIELD_TWINS = 40, 6
CAMERA_SCALE, CAMERA_SHIFT, CAMERA_TURN = 0.02, 0.05, 0.2  # sd: a share, mm, degrees
_CERTIFIED = (
    "verdict", "reason", "findings", "draws", "failed", "shift", "shift_error", "map_errors",
)  # fmt: skip


_OTHERWISE = {"field": "field alone", "force": "force alone", "camera": "camera that moves"}


def emulated(scene: em.Scene, folder: Path, runs: int) -> tuple[em.Emulator, Case]:
    """The emulator of a scene, and its error; one that is in ``folder`` is kept."""
    if not (folder / "emulator.json").is_file():
        began = perf_counter()
        plan = replace(em.recipe("mechanics"), simulations=runs, order=1, seed=SEED)
        emulator = em.train(scene, plan, folder, progress=True)
        em.save_emulator(emulator, folder)
        print(f"trained in {perf_counter() - began:.0f} s", flush=True)
    emulator = em.load(folder, scene)
    of = emulator.record["discrepancy"]
    return emulator, {
        "nodes": len(scene.mesh.nodes),
        "parameters": len(scene.parameters),
        "runs": of["runs"],
        "err_u_mm": of["held_out"]["err_u"],
    }


def model_of(
    scene: em.Scene, forward: Any, measured: Measured, frames: tuple[str, ...], *,
    camera: bool = False, known_size: float | None = None, **which: bool,
) -> tuple[cal.Model, Any]:  # fmt: skip
    """The model of some frames, and their data.

    camera : whether it may have moved and turned in each frame, and its scale may err by 2 %.
    known_size : the sd in mm of what is missed; by default it is inferred.
    """
    observe, data, known = data_of(scene, measured, frames, **which)
    noise = {"displacement": cal.GaussianNoise(sd=SD), FORCE: cal.GaussianNoise(sd=FORCE_SD)}
    modes = [name for name in scene.parameter_names if "mode" in name]
    prior = {name: cal.priors.truncated_normal(0.0, 1.0, -2.5, 2.5) for name in modes}
    noise = {name: each for name, each in noise.items() if name in observe.bases}
    model = cal.model(forward, observe, noise, prior, known=known)
    if "displacement" not in observe.bases:
        return model, data
    error = {
        "kind": "field", "of": "displacement", "along": "pull", "length": LENGTH,
        "along_length": ALONG,
    }  # fmt: skip
    error |= {"sd_scale": 0.1} if known_size is None else {"sd": known_size}
    errors: dict[str, Case] = {"missed": error}
    if camera:
        errors["scale"] = {"kind": "gain", "of": "displacement", "share": CAMERA_SCALE}
        for frame in frames:
            errors[f"moved {frame}"] = {
                "kind": "rigid_motion", "of": f"displacement@{frame}",
                "shift": (CAMERA_SHIFT, CAMERA_SHIFT, 0.0), "turn": (0.0, 0.0, CAMERA_TURN),
            }  # fmt: skip
    return cal.with_described_errors(model, data, errors)


def posterior_of(model: cal.Model, data: Any, sampler: str, quick: bool) -> cal.Posterior:
    """The posterior by NUTS, or near its mode."""
    draws = 50 if quick else 250
    options: Any = cal.samplers.NUTSOptions(warmup=draws, draws=draws, chains=2, rounds=1)
    if sampler == "laplace":
        options = cal.samplers.LaplaceOptions(starts=2)
    elif sampler == "auto":
        options = None
    return cal.sample(model, data, sampler=sampler, options=options, seed=SEED, predictions=False)


def told_by(found: cal.Posterior) -> Case:
    """Means and sds of what is no mode, and the quality of the draws."""
    summary = found.summary()
    return {
        "posterior": {name: row for name, row in summary.items() if "mode" not in name},
        "modes": {
            name: [round(row["mean"], 3), round(row["sd"], 3)]
            for name, row in summary.items()
            if "mode" in name
        },
        "divergences": found.divergences,
        "r_hat": max(float(row["r_hat"]) for row in summary.values()),
        "box": [str(end) for end in found.box_ends()],
    }


def stiffness_map(found: cal.Posterior, scene: em.Scene) -> Case:
    """Mean and sd of the logarithm of mu s, s the factor of each element of the region."""
    middles, of = stiffness_logs(found, scene)
    return {
        "middles_mm": middles.round(2).tolist(),
        "mean_log_kpa": of.mean(axis=0).round(3).tolist(),
        "sd": of.std(axis=0).round(3).tolist(),
    }


def one_layer_of(skin: Skin, data: Path, folder: Path) -> Case:
    """FEM of one element across the thickness beside three, and edges of 1.5 in place of 2.5 mm."""
    forces, fields, nodes = [], [], []
    grids = {"one layer": (2.5, 1), "three layers": (2.5, 3), "smaller edges": (1.5, 1)}
    for name, (size, layers) in grids.items():
        scene = scene_of(
            skin, data, folder / name.replace(" ", "_"), modes=0, size=size, layers=layers
        )
        theta = scene.theta(mu=4.0, foundation=0.003, prestress=5.0, pull=2.0, stiffness_1=6.0)
        u = em.Simulator(scene).solve(theta).require_converged().displacement
        x = np.linspace(2.0, skin.gap - 2.0, 12)
        points = np.stack([np.tile(x, 3), np.repeat([-3.0, 0.0, 3.0], 12)], axis=1)
        top = float(scene.mesh.nodes[:, 2].max())
        seen = cal.landmarks(scene, np.column_stack([points, np.full(len(points), top)]))
        force = cal.Reaction(scene, "moving", "x")
        forces.append(float(force(u[force.nodes], theta)))
        fields.append(np.asarray(seen(u[seen.nodes], theta))[:, :2])
        nodes.append(len(scene.mesh.nodes))
    return {
        "meshes": list(grids),
        "nodes": nodes,
        "force_n": forces,
        "force_share": [abs(f / forces[0] - 1.0) for f in forces],
        "displacement_share": [float(np.abs(u - fields[0]).max()) / 2.0 for u in fields],
    }


def map_against_fem(scene: em.Scene, forward: Any, told: Case, count: int = 4) -> Case:
    """Forces of the map and of FEM at theta about a posterior's means, as wide as its sds."""
    rng, simulator = np.random.default_rng(SEED), em.Simulator(scene)
    rows = {name: (row["mean"], row["sd"]) for name, row in told["posterior"].items()}
    rows |= {name: tuple(row) for name, row in told["modes"].items()}
    force, found = cal.Reaction(scene, "moving", "x"), []
    predicted = jax.jit(force_of(scene, forward))
    for _ in range(count):
        values = {}
        for parameter in scene.parameters:
            if parameter.name in rows:
                mean, sd = rows[parameter.name]
                value = mean + sd * float(rng.normal())
                values[parameter.name] = float(np.clip(value, parameter.low, parameter.high))
        for pull in (0.985, 1.93, 3.0):
            theta = scene.theta(**values, pull=pull)
            u = simulator.solve(theta).require_converged().displacement
            seen = forward(theta)
            found.append(
                {
                    "pull_mm": pull,
                    "fem_n": float(force(u[force.nodes], theta)),
                    "map_n": float(predicted(theta)),
                    "err_u_mm": float(jnp.abs(u - seen).max()),
                }
            )
    off = [row["map_n"] / row["fem_n"] - 1.0 for row in found]
    return {
        "rows": found,
        "force_off": {"median": float(np.median(np.abs(off))), "worst": max(map(abs, off))},
    }


def best_of(held_out: dict[str, Case]) -> str:
    """The law that predicts the force best, of those within 5 % of the least error of points."""
    least = min(case["rms_mm"] for case in held_out.values())
    alike = {n: c["forces"][0] for n, c in held_out.items() if c["rms_mm"] <= 1.05 * least}
    return min(alike, key=lambda n: abs(alike[n]["mean"] - alike[n]["measured"]))


def main() -> None:
    """Run the study."""
    words = parser(__doc__, HERE)
    words.add_argument("--data", type=Path, help="folder of the tables")
    words.add_argument("--judge", type=Path, metavar="DIR", help="folder of what was kept apart")
    words.add_argument("--keep", type=Path, help="folder that keeps meshes and emulators")
    words.add_argument("--twins", type=int, default=TWINS, help=f"number of twins ({TWINS})")
    arguments = words.parse_args()
    if arguments.judge is not None:
        there = json.loads((arguments.out / "results.json").read_text())
        for skin in (KELOID, HEALTHY):
            case = next(case for case in there["cases"] if case["name"] == f"{skin.name}, bands")
            print(json.dumps({skin.name: judged(skin, case, arguments.judge)}, indent=2))
        return
    if arguments.data is None:
        raise em.InputError("give --data DIR, the folder of the tables")
    quick, data = arguments.quick, arguments.data
    keep = arguments.keep or arguments.out / "kept"
    results = Results(arguments.out, SEED, again=arguments.again, settings={"quick": quick})
    runs, fewer = (16, 12) if quick else (RUNS, FEWER)

    @cache
    def measured(skin: Skin) -> Measured:
        return measured_of(skin, data, 20 if quick else POINTS)

    def frames_of(skin: Skin, count: int | None = None) -> tuple[str, ...]:
        return tuple(measured(skin).frame_at(amount) for amount in skin.amounts[:count])

    @cache
    def with_law(skin: Skin, law: str) -> tuple[em.Scene, Any, Case]:
        folder = keep / f"{skin.name}_{law}"
        modes = min(skin.modes, 4) if quick else skin.modes
        scene = scene_of(skin, data, folder, law, modes)
        emulator, told = emulated(scene, folder / "emulator", runs if modes else fewer)
        return scene, emulator.cache(), told

    @cache
    def inferred(
        skin: Skin, law: str, frames: tuple[str, ...], sampler: str, which: Sequence[str] = ()
    ) -> cal.Posterior:
        scene, forward, _ = with_law(skin, law)
        only = {name: name in which for name in ("field", "force")} if which else {}
        only |= {"camera": True, "field": True, "force": True} if "camera" in which else {}
        model, given = model_of(scene, forward, measured(skin), frames, **only)
        return posterior_of(*model.given(given), sampler, quick)

    def timed(found: Any) -> Case:
        began = perf_counter()
        return {**found(), "seconds": perf_counter() - began}

    def held_out(law: str) -> Case:
        """The last frame, predicted from the three before it."""
        scene, forward, told = with_law(KELOID, law)
        before, last = frames_of(KELOID, 3), frames_of(KELOID)[-1]
        found = inferred(KELOID, law, before, "laplace")
        at = measured(KELOID).amounts[last]
        bands = bands_of(found, scene, forward, measured(KELOID), before, (at,), (at,))
        return {**told_by(found), "emulator": told, "held_out": bands.against(measured(KELOID))}

    law = "neo_hookean_split"
    laws = [law] if quick else list(LAWS)
    for name in laws:
        results.case(f"keloid, {name}", lambda n=name: timed(lambda: held_out(n)))
        jax.clear_caches()
    best = law
    if not quick:
        rows = {n: c for n in laws for c in results.cases if c["name"] == f"keloid, {n}"}
        best = best_of({n: c["held_out"] for n, c in rows.items()})
    for skin in (KELOID, HEALTHY):
        chosen = best if skin is KELOID else law
        sampler = "auto" if not skin.modes else "laplace" if quick else "nuts"
        frames = frames_of(skin)

        def whole(
            skin: Skin = skin, chosen: str = chosen, frames: Any = frames, sampler: str = sampler
        ) -> Case:
            found = inferred(skin, chosen, frames, sampler)
            return {**told_by(found), "law": chosen, "emulator": with_law(skin, chosen)[2]}

        def kept_apart(
            skin: Skin = skin, chosen: str = chosen, frames: Any = frames, sampler: str = sampler
        ) -> Case:
            scene, forward, _ = with_law(skin, chosen)
            found = inferred(skin, chosen, frames, sampler)
            made: Bands = bands_of(
                found, scene, forward, measured(skin), frames, skin.later, skin.later_force
            )
            return made.to_json()

        def mapped(
            skin: Skin = skin, chosen: str = chosen, frames: Any = frames, sampler: str = sampler
        ) -> Case:
            found = inferred(skin, chosen, frames, sampler)
            return stiffness_map(found, with_law(skin, chosen)[0])

        results.case(skin.name, lambda f=whole: timed(f))
        results.case(f"{skin.name}, bands", kept_apart)

        def against(skin: Skin = skin, chosen: str = chosen) -> Case:
            scene, forward, _ = with_law(skin, chosen)
            told = next(case for case in results.cases if case["name"] == skin.name)
            return map_against_fem(scene, forward, told)

        results.case(f"{skin.name}, map against FEM", against)
        results.case(f"{skin.name}, map", mapped)
        for which, title in () if quick else _OTHERWISE.items():
            results.case(
                f"{skin.name}, {title}",
                lambda s=skin, w=which, c=chosen, f=frames: told_by(
                    inferred(s, c, f, "laplace", (w,))
                ),
            )
        jax.clear_caches()
    if not quick:
        results.case("layers", lambda: one_layer_of(KELOID, data, keep / "layers"))
    folder = keep / "twins"
    scene = scene_of(KELOID, data, folder, law, 0)
    emulator, _ = emulated(scene, folder / "emulator", fewer)
    made = twins_of(
        scene, emulator.cache(), measured(KELOID), frames_of(KELOID),
        2 if quick else arguments.twins, results,
    )  # fmt: skip

    def with_inclusion(number: int) -> Case:
        scene, forward, _ = with_law(KELOID, law)
        return inclusion_twin(scene, forward, model_of, measured(KELOID), frames_of(KELOID), number)

    inclusions = [
        results.case(f"inclusion {k}", lambda k=k: with_inclusion(k))
        for k in range(1 if quick else FIELD_TWINS)
    ]

    def against_fem() -> Case:
        scene, _, _ = with_law(KELOID, best)
        found = inferred(KELOID, best, frames_of(KELOID), "nuts")
        certificate = cal.certify(
            found, em.Simulator(scene), draws=CERTIFIED, mesh=0, seed=SEED, progress=True
        )
        told = certificate.to_json()
        return {name: told[name] for name in _CERTIFIED}

    if not quick:
        results.case("certificate", lambda: timed(against_fem))
    results.write(
        coverage=coverage(made),
        elements_inside=float(np.mean([case["inside"] for case in inclusions])),
    )
    draw_inclusions(inclusions[:3], arguments.out / "inclusions.png")
    draw({case["name"]: case for case in results.cases}, data, arguments.out / "living_skin.png")


if __name__ == "__main__":
    run(main)
