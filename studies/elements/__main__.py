"""Elements: what right to the tissue costs.

    python -m studies.elements
    python -m studies.elements --quick --out DIR

The ventricle, the beam, the liver and the cube in linear tetrahedra, plain and with one volume
change for each patch, and in quadratic ones: straight and curved, with mean dilatation, with
fibres an element, a node and a quadrature point. At the centre of the box and at some of its
corners: displacement of 40 landmarks, growth of the cavity, fibre strain, each against the limit
of fine meshes, and seconds a solve from rest, compiled. The limit of landmarks and growth is
Richardson's, from meshes of elements twice and four times as long, where these are given, else the
finest mesh's. Beside each error the estimate of ``emulator.accuracy.mesh_error``, from the mesh
alone. Writes results.json after each case and elements.png.
"""

import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from studies.common.output import Case, Results, parser, save
from studies.elements.bodies import BEAM, BODIES, Body, Measured, measured

import emulator as em
from calibrate.figures import pyplot
from calibrate.measurements.displacements import spread_landmarks
from emulator.scenes.scene import Scene

HERE = Path(__file__).parent
SEED, LANDMARKS = 0, 40
_INWARDS = 0.03  # landmarks keep this fraction of the body's size from its surface, or nearly


def positions(body: Body, scene: Scene) -> np.ndarray:
    """The theta of the study (t, p): the centre and the corners."""
    each = [np.full(len(scene.parameters), 0.5), *(np.array(c) for c in body.corners)]
    return np.stack([np.asarray(scene.from_unit(jnp.asarray(x, float))) for x in each])


def landmarks_of(scene: Scene) -> np.ndarray:
    """Points (d, 3) inside the body, whatever its mesh."""
    points = spread_landmarks(scene, 3 * LANDMARKS, SEED)
    surface = scene.mesh.nodes[np.unique(scene.mesh.surface)]
    distance = np.array([np.linalg.norm(surface - p, axis=1).min() for p in points])
    return points[np.argsort(-distance)[:LANDMARKS]]


def solved(body: Body, scene: Scene) -> tuple[np.ndarray, list[float]]:
    """Equilibria (t, n, 3) mm from rest, and seconds of all but the first, which compiles."""
    simulator, fields, seconds = em.Simulator(scene), [], []
    for theta in positions(body, scene):
        began = time.perf_counter()
        solution = simulator.solve(jnp.asarray(theta)).require_converged(scene.name)
        fields.append(np.asarray(solution.displacement))
        seconds.append(time.perf_counter() - began)
    return np.stack(fields), seconds[1:]


def limit(body: Body, points: np.ndarray, *, quick: bool) -> tuple[Measured, dict[str, Any]]:
    """The limit of fine meshes, and what it is made of."""
    scenes = (
        [body.coarser[0]()] if quick else [body.reference(), *(make() for make in body.coarser)]
    )
    found = [measured(scene, solved(body, scene)[0], points) for scene in scenes]
    told = {"nodes": [len(scene.mesh.nodes) for scene in scenes], "extrapolated": len(found) == 3}
    if len(found) < 3:
        return found[0], told

    def extrapolated(fine: np.ndarray, middle: np.ndarray, coarse: np.ndarray) -> np.ndarray:
        """The limit of a sequence whose differences shrink evenly, theta by theta."""
        axes = tuple(range(1, fine.ndim))
        before, after = (
            np.sqrt(np.nanmean(d**2, axis=axes)) for d in (middle - coarse, fine - middle)
        )
        ratio = np.clip(after / before, 0.05, 0.6).reshape(-1, *(1 for _ in axes))
        return fine + (fine - middle) * ratio / (1.0 - ratio)

    fine, middle, coarse = found
    growth = None
    if fine.growth is not None:
        growth = extrapolated(fine.growth, middle.growth, coarse.growth)
        told["growth_mL"] = [each.growth.tolist() for each in found]
    return Measured(
        extrapolated(fine.landmarks, middle.landmarks, coarse.landmarks), growth, fine.strains
    ), told


def errors(found: Measured, true: Measured) -> Case:
    """Errors at the centre and the largest at the corners, by what is measured."""
    wrong = np.nanmedian(np.linalg.norm(found.landmarks - true.landmarks, axis=2), axis=1)
    size = np.nanmedian(np.linalg.norm(true.landmarks, axis=2), axis=1)
    told = {
        "landmark_mm": {"centre": wrong[0], "corners": wrong[1:].max()},
        "landmark_percent": {
            "centre": 100.0 * wrong[0] / size[0],
            "corners": (100.0 * wrong / size)[1:].max(),
        },
    }
    if true.growth is not None and found.growth is not None:
        relative = 100.0 * (found.growth / true.growth - 1.0)
        told["growth_percent"] = {
            "centre": relative[0],
            "corners": relative[1:][np.argmax(np.abs(relative[1:]))],
        }
    if true.strains is not None and found.strains is not None:
        strain = np.nanmedian(np.abs(found.strains - true.strains), axis=1)
        told["strain"] = {"centre": strain[0], "corners": strain[1:].max()}
    return told


def one(body: Body, scene: Scene, points: np.ndarray, true: Measured, *, estimate: bool) -> Case:
    """Errors and seconds of one kind of elements."""
    fields, seconds = solved(body, scene)
    found = measured(scene, fields, points)
    case: Case = {
        "nodes": len(scene.mesh.nodes),
        "elements": len(scene.mesh.elements),
        "seconds": float(np.median(seconds)),
        **errors(found, true),
    }
    if estimate:
        case |= effectivity(scene, points, found, true, positions(body, scene)[0])
    return case


def effectivity(
    scene: Scene, points: np.ndarray, found: Measured, true: Measured, theta: np.ndarray
) -> Case:
    """The estimated errors over the true ones, at the centre of the box."""
    error = em.mesh_error(scene)
    try:
        told = error(jnp.asarray(theta))
    except em.SolverError as reason:
        return {"effectivity": {"failed": str(reason)}}
    there = measured(error.finer.scene, np.asarray(told.fine)[None], points)
    error.forget()
    jax.clear_caches()  # programs keep the systems they were compiled for, gigabytes in all
    estimated, wrong = (
        np.nanmedian(np.linalg.norm(found.landmarks[0] - other.landmarks[0], axis=1))
        for other in (there, true)
    )
    ratios = {"landmark": float(estimated / wrong), "solved": told.solved}
    if found.growth is not None and there.growth is not None and true.growth is not None:
        ratios["growth"] = float(
            (found.growth[0] - there.growth[0]) / (found.growth[0] - true.growth[0])
        )
    if found.strains is not None and there.strains is not None and true.strains is not None:
        ratios["strain"] = float(
            np.nanmedian(np.abs(found.strains[0] - there.strains[0]))
            / np.nanmedian(np.abs(found.strains[0] - true.strains[0]))
        )
    return {"effectivity": ratios}


def main() -> None:
    """The table, body by body."""
    arguments = parser(__doc__, HERE).parse_args()
    results = Results(arguments.out, SEED, again=arguments.again)
    bodies = {BEAM.name: BEAM} if arguments.quick else BODIES
    for name, body in bodies.items():
        rungs = dict(list(body.rungs.items())[:1]) if arguments.quick else body.rungs
        points = landmarks_of(body.coarser[-1]())
        known: dict[str, Measured] = {}

        def reference(body: Body = body, points: np.ndarray = points) -> Case:
            known["limit"], told = limit(body, points, quick=arguments.quick)  # noqa: B023
            return told

        done = {case["name"] for case in results.cases}
        wanted = [rung for rung in rungs if f"{name}, {rung}" not in done]
        if wanted:
            results.cases = [c for c in results.cases if c["name"] != f"{name}, limit"]
            results.case(f"{name}, limit", reference)
        for rung in wanted:
            make = rungs[rung]
            results.case(
                f"{name}, {rung}",
                lambda make=make: {
                    "body": name,  # noqa: B023
                    "rung": rung,  # noqa: B023
                    **one(body, make(), points, known["limit"], estimate=not arguments.quick),  # noqa: B023
                },
            )
    save(drawn(results.cases), arguments.out / "elements.png")
    if not arguments.quick:
        check(results.cases)


def check(cases: list[Case]) -> None:
    """The defaults are within their limits."""
    for case in cases:
        if case.get("rung") != "default":
            continue
        assert case["landmark_mm"]["centre"] < 0.13, case["name"]
        small = case["landmark_mm"]["corners"] < 0.05
        assert small or case["landmark_percent"]["corners"] < 2.0, case["name"]
        if "growth_percent" in case:
            assert abs(case["growth_percent"]["centre"]) < 0.7, case["name"]


def drawn(cases: list[Case]) -> Any:
    """Error of the landmarks over seconds a solve, a panel a body."""
    plt = pyplot()
    names = [name for name in BODIES if any(case.get("body") == name for case in cases)]
    figure, grid = plt.subplots(1, len(names), figsize=(4.6 * len(names), 4.4), squeeze=False)
    for axes, name in zip(grid[0], names, strict=True):
        for case in cases:
            if case.get("body") != name:
                continue
            rung = case["rung"]
            colour = {"l": "tab:red", "q": "tab:blue", "d": "black"}[rung[0]]
            error = case["landmark_mm"]["centre"]
            axes.plot(case["seconds"], error, "o", color=colour)
            label = rung.replace("quadratic, ", "")
            axes.annotate(
                f"{label} ({case['nodes']})", (case["seconds"], error), fontsize=7,
                xytext=(4, 3), textcoords="offset points",
            )  # fmt: skip
        axes.set(xscale="log", yscale="log", title=name, xlabel="seconds a solve from rest")
        axes.margins(x=0.35)
        axes.xaxis.set_minor_formatter("")  # within a decade the labels would overlap
        axes.grid(alpha=0.3)
    grid[0, 0].set_ylabel("landmarks' median distance from the limit (mm)")
    figure.suptitle("Elements: red linear, blue quadratic, black the default (nodes)")
    figure.tight_layout()
    return figure


if __name__ == "__main__":
    main()
