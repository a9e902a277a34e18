"""From a bare mesh and a data file to the report of a certified posterior: each command's seconds.

``python -m studies.mesh_to_certificate [--ventricles N] [--mesh RINGS AROUND LAYERS]``. Each
command is a process of its own, and the cache of compiled programs is empty before the first, as
on the first day. Writes results.json and mesh_to_certificate.png beside itself, or under --out.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from studies.common.figures import pyplot
from studies.common.output import save, study_header, write_json
from studies.common.twins import twin

import calibrate as cal
import emulator as em

HERE = Path(__file__).parent
SEED = 4
AIM = 300.0
TRUTH = {"a": 0.33, "b": 2.2, "a_f": 6.0, "b_f": 2.4, "pressure": 1.0}
NOISE = {"displacement": 0.3, "volume": 1.0}
# Semi-axes of the wall (mm), rings, around, layers.
VENTRICLES = {
    "human": (em.generators.EllipsoidalWall(23.0, 58.0, 34.0, 65.0, 20.0), (8, 28, 3)),
    "dilated, thin": (em.generators.EllipsoidalWall(30.0, 62.0, 38.0, 68.0, 22.0), (10, 36, 2)),
}
STAGES = {
    "init": "init (a first scene file)",
    "train": "train (60 FEM runs)",
    "infer": "infer (4 x 1000 draws)",
    "certify": "certify (FEM runs until decided)",
    "report": "report (one HTML page)",
}


def timed(folder: Path, *words: str) -> tuple[float, dict[str, Any]]:
    """Seconds of a command in ``folder``, and what it printed as JSON."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith("JAX_COMPILATION")}
    environment["CALIBRATE_CACHE"] = str(folder / "cache")
    began = time.perf_counter()
    done = subprocess.run(
        [str(Path(sys.executable).with_name("calibrate")), *words, "--json"],
        cwd=folder, env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    seconds = time.perf_counter() - began
    if not done.stdout.strip():
        raise SystemExit(f"calibrate {' '.join(words)}: {done.stderr[-2000:]}")
    return seconds, json.loads(done.stdout)


def measure(folder: Path) -> int:
    """The data file of the body, by FEM; the number of nodes of its mesh."""
    scene = em.find_scene(str(folder / "body.toml"))
    theta = np.array([TRUTH[name] for name in scene.parameter_names])
    u = em.Simulator(scene).solve(theta).require_converged("the data").displacement
    observe, _, data = twin(scene, "landmarks:24+volume", NOISE, theta, u, SEED)
    cal.write_data(folder / "data.csv", observe, data)
    return len(scene.mesh.nodes)


def one(name: str, size: tuple[int, int, int]) -> dict[str, Any]:
    """From the mesh file of one ventricle to the page of its posterior."""
    noise = [f"{key}={value}" for key, value in NOISE.items()]
    known = ("body.toml", "--emulator", "emulator", "--data", "data.csv", "--noise", *noise)
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        mesh = em.generators.truncated_ellipsoid(VENTRICLES[name][0], *size, grading=1.5)
        em.write_mesh(folder / "body.msh", mesh)
        seconds = {"init": timed(folder, "init", "body.msh")[0]}
        nodes = measure(folder)
        recipe = ("--recipe", "mechanics", "--out", "emulator")
        seconds["train"], _ = timed(folder, "train", "body.toml", *recipe)
        out = ("--no-certify", "--out", "posterior")
        seconds["infer"], result = timed(folder, "infer", *known, *out)
        seconds["certify"], certificate = timed(folder, "certify", "posterior")
        seconds["report"], _ = timed(folder, "report", "posterior")
    table = result["parameters"]
    z = {n: (TRUTH[n] - row["mean"]) / row["sd"] for n, row in table.items()}
    case = {
        "name": name,
        "status": certificate["verdict"],
        "nodes": nodes,
        **{f"{stage}_s": round(took, 1) for stage, took in seconds.items()},
        "total_s": round(sum(seconds.values()), 1),
        "r_hat": max(row["r_hat"] for row in table.values()),
        "ess_bulk": min(row["ess_bulk"] for row in table.values()),
        "ess_tail": min(row["ess_tail"] for row in table.values()),
        "divergences": result["divergences"],
        "reason": certificate["certificate"]["reason"],
        "mesh": certificate["certificate"]["mesh"],
        "truth_z": z,
    }
    stages = ", ".join(f"{stage} {took:.0f} s" for stage, took in seconds.items())
    print(
        f"{name:14s} {nodes} nodes: {stages}, total {case['total_s']:.0f} s; {case['status']}, "
        f"R-hat {case['r_hat']:.4f}, ESS {case['ess_bulk']:.0f}, {case['divergences']} divergences",
        flush=True,
    )
    return case


def draw(cases: list[dict[str, Any]], path: Path) -> None:
    """Seconds of each command, one bar a ventricle."""
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
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--ventricles", type=int, default=len(VENTRICLES))
    parser.add_argument("--mesh", type=int, nargs=3, help="rings, around, layers of all")
    parser.add_argument("--out", type=Path, default=HERE)
    arguments = parser.parse_args()
    names = list(VENTRICLES)[: arguments.ventricles]
    cases = [one(name, tuple(arguments.mesh or VENTRICLES[name][1])) for name in names]
    arguments.out.mkdir(parents=True, exist_ok=True)
    header = study_header(HERE, SEED)
    write_json(arguments.out / "results.json", {**header, "cases": cases})
    draw(cases, arguments.out / "mesh_to_certificate.png")


if __name__ == "__main__":
    main()
