"""From a bare mesh and a data file to the report of a certified posterior: each command's seconds.

    python -m studies.mesh_to_certificate [--irregular N] [--quick]

Each command is a process of its own, and the cache of compiled programs is empty before the first,
as on the first day. No emulator, and no range of a parameter that the data could leave. Twenty
irregular ventricles follow, with truths drawn from wide priors and without the finer mesh. Writes
results.json, after each case, and mesh_to_certificate.png; cases that are there are kept.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from studies.any_ventricle.shapes import bodies
from studies.common.figures import pyplot
from studies.common.output import Case, Results, parser, save
from studies.common.twins import twin

import calibrate as cal
import emulator as em

HERE = Path(__file__).parent
SEED = 4
AIM = 300.0
TRUTH = {"a": 0.33, "b": 2.2, "a_f": 6.0, "b_f": 2.4, "pressure": 1.0}
NOISE = {"displacement": 0.3, "volume": 1.0}
SPREAD = {"a": 1.0, "b": 0.5, "a_f": 0.7, "b_f": 0.5, "pressure": 0.3}  # log sd of truths
# Semi-axes of the wall (mm), rings, around, layers.
VENTRICLES = {
    "human": (em.generators.EllipsoidalWall(23.0, 58.0, 34.0, 65.0, 20.0), (8, 28, 3)),
    "dilated, thin": (em.generators.EllipsoidalWall(30.0, 62.0, 38.0, 68.0, 22.0), (10, 36, 2)),
}
COARSE = (5, 12, 1)
STAGES = {
    "init": "init (a first scene file)",
    "infer": "infer (rounds of FEM runs, 4 x 1000 draws)",
    "certify": "certify (FEM runs until decided, finer mesh)",
    "report": "report (one HTML page)",
}


def timed(folder: Path, *words: str) -> tuple[float, dict[str, Any]]:
    """Seconds of a command in ``folder``, and what it printed as JSON."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith("JAX_COMPILATION")}
    environment["CALIBRATE_CACHE"] = str(folder.parent / "cache")
    began = time.perf_counter()
    done = subprocess.run(
        [str(Path(sys.executable).with_name("calibrate")), *words, "--json"],
        cwd=folder, env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    seconds = time.perf_counter() - began
    if not done.stdout.strip():
        raise SystemExit(f"calibrate {' '.join(words)}: {done.stderr[-2000:]}")
    return seconds, json.loads(done.stdout)


def measure(folder: Path, truth: dict[str, float]) -> int:
    """Write the body's data at ``truth``, by FEM; the number of nodes of its mesh."""
    scene = em.find_scene(str(folder / "body.toml"))
    theta = np.array([truth[name] for name in scene.parameter_names])
    u = em.Simulator(scene).solve(theta).require_converged("the data").displacement
    observe, _, data = twin(scene, "landmarks:24+volume", NOISE, theta, u, SEED)
    cal.write_data(folder / "data.csv", observe, data)
    return len(scene.mesh.nodes)


def one(place: Path, mesh: em.Mesh, truth: dict[str, float], *, finer: bool) -> dict[str, Any]:
    """From a mesh to the page of its posterior, in a new folder of ``place``.

    finer : whether the certificate asks a finer mesh, too.
    """
    with tempfile.TemporaryDirectory(dir=place) as name:
        folder = Path(name)
        em.write_mesh(folder / "body.msh", mesh)
        seconds = {"init": timed(folder, "init", "body.msh")[0]}
        nodes = measure(folder, truth)
        noise = [f"{key}={value}" for key, value in NOISE.items()]
        words = ("body.toml", "--data", "data.csv", "--noise", *noise, "--no-certify")
        seconds["infer"], result = timed(folder, "infer", *words, "--out", "posterior")
        mesh_words = () if finer else ("--no-mesh",)
        seconds["certify"], certificate = timed(folder, "certify", "posterior", *mesh_words)
        seconds["report"], _ = timed(folder, "report", "posterior")
    table = result["parameters"]
    return {
        "status": certificate["verdict"],
        "nodes": nodes,
        **{f"{stage}_s": round(took, 1) for stage, took in seconds.items()},
        "total_s": round(sum(seconds.values()), 1),
        "r_hat": max(row["r_hat"] for row in table.values()),
        "ess_bulk": min(row["ess_bulk"] for row in table.values()),
        "ess_tail": min(row["ess_tail"] for row in table.values()),
        "reason": certificate["certificate"]["reason"],
        "mesh": certificate["certificate"]["mesh"],
        "truth": truth,
        "inside_90": {n: table[n]["low"] <= truth[n] <= table[n]["high"] for n in truth},
    }


def draw(cases: list[Case], path: Path) -> None:
    """Seconds of each command, one bar a ventricle."""
    cases = [case for case in cases if case["name"] in VENTRICLES]
    plt = pyplot()
    figure, axes = plt.subplots(figsize=(7.5, 1.2 + 0.6 * len(cases)), layout="constrained")
    names = [f"{case['name']}\n{case['nodes']} nodes" for case in cases]
    left = np.zeros(len(cases))
    for stage, label in STAGES.items():
        seconds = np.array([case[f"{stage}_s"] for case in cases])
        axes.barh(names, seconds, left=left, label=label)
        left += seconds
    axes.axvline(AIM, color="0.3", ls="--", label="aim: 5 minutes")
    axes.set(xlabel="s, start and compilation included", xlim=(0.0, 1.05 * max(AIM, left.max())))
    axes.invert_yaxis()
    axes.legend(frameon=False, fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
    save(figure, path)


def main() -> None:
    """Run the study."""
    words = parser(__doc__, HERE)
    words.add_argument("--irregular", type=int, default=20, help="irregular ventricles")
    arguments = words.parse_args()
    results = Results(arguments.out, SEED, again=arguments.again)
    quick = arguments.quick
    for name, (wall, size) in list(VENTRICLES.items())[: 1 if quick else None]:
        mesh = em.generators.truncated_ellipsoid(wall, *(COARSE if quick else size), grading=1.5)
        with tempfile.TemporaryDirectory() as place:
            results.case(name, lambda p=place, m=mesh: one(Path(p), m, TRUTH, finer=not quick))
    with tempfile.TemporaryDirectory() as place:
        for k, body in enumerate(bodies(20, 2, 1.0)[: 0 if quick else arguments.irregular]):
            rng = np.random.default_rng([SEED, k])
            truth = {n: float(v * np.exp(SPREAD[n] * rng.normal())) for n, v in TRUTH.items()}
            mesh = body.scene(1).mesh
            results.case(
                f"irregular {k}", lambda m=mesh, t=truth: one(Path(place), m, t, finer=False)
            )
    draw(results.cases, arguments.out / "mesh_to_certificate.png")


if __name__ == "__main__":
    main()
