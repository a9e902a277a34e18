"""From a mesh and a data file to a certified posterior: seconds of each command.

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
from studies.common.output import save

from calibrate.data import write_data
from calibrate.figures.drawing import pyplot
from calibrate.provenance import study_header
from calibrate.workflow import Run, make_data
from emulator.catalogue import find_scene
from emulator.geometry.bodies.ellipsoid import EllipsoidalWall, truncated_ellipsoid
from emulator.geometry.io import write_mesh
from emulator.store import write_json

HERE = Path(__file__).parent
SEED = 4
AIM = 300.0
TRUTH = {"a": 0.33, "b": 2.2, "a_f": 6.0, "b_f": 2.4, "pressure": 1.0}
NOISE = {"displacement": 0.3, "volume": 1.0}
# Semi-axes of the wall (mm), rings, around, layers.
VENTRICLES = {
    "human": (EllipsoidalWall(23.0, 58.0, 34.0, 65.0, 20.0), (8, 28, 3)),
    "dilated, thin": (EllipsoidalWall(30.0, 62.0, 38.0, 68.0, 22.0), (10, 36, 2)),
}
SCENE = """
law = "holzapfel_ogden"
mesh = "mesh.vtu"

[fibres]
rule = "helix"
angles = [60.0, -60.0]

[[supports]]
node_set = "base"

[[loads]]
kind = "cavity_pressure"
facet_set = "endocardium"

[parameters.a]
unit = "kPa"
range = [0.2, 0.52]
scale = "log"

[parameters.b]
unit = ""
range = [1.0, 4.2]
scale = "log"

[parameters.a_f]
unit = "kPa"
range = [3.0, 10.36]
scale = "log"

[parameters.b_f]
unit = ""
range = [1.0, 4.46]
scale = "log"

[parameters.pressure]
unit = "kPa"
range = [0.53, 1.33]

[constants]
kappa = 25.0
"""


def prepare(name: str, size: tuple[int, int, int], folder: Path) -> int:
    """What a user begins with: mesh, scene file and measurements; the number of nodes."""
    mesh = truncated_ellipsoid(VENTRICLES[name][0], *size, 2, grading=1.5)
    write_mesh(folder / "mesh.vtu", mesh)
    (folder / "scene.toml").write_text(SCENE)
    run = Run(
        str(folder / "scene.toml"),
        truth=TRUTH,
        observe="landmarks:24+volume",
        noise=NOISE,
        seed=SEED,
    )
    observe, data = make_data(run, find_scene(run.scene))
    write_data(folder / "data.csv", observe, data)
    return len(mesh.nodes)


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


def one(name: str, size: tuple[int, int, int]) -> dict[str, Any]:
    """Train, infer and certify on one ventricle."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        nodes = prepare(name, size, folder)
        train_s, _ = timed(
            folder, "train", "scene.toml", "--recipe", "mechanics", "--out", "emulator"
        )
        noise = [f"{key}={value}" for key, value in NOISE.items()]
        known = ("scene.toml", "--emulator", "emulator", "--data", "data.csv")
        infer_s, result = timed(
            folder, "infer", *known, "--noise", *noise, "--no-certify", "--out", "posterior"
        )
        certify_s, certificate = timed(folder, "certify", "posterior")
    table = result["parameters"]
    z = {n: (TRUTH[n] - row["mean"]) / row["sd"] for n, row in table.items()}
    case = {
        "name": name,
        "status": certificate["verdict"],
        "nodes": nodes,
        "train_s": round(train_s, 1),
        "infer_s": round(infer_s, 1),
        "certify_s": round(certify_s, 1),
        "total_s": round(train_s + infer_s + certify_s, 1),
        "r_hat": max(row["r_hat"] for row in table.values()),
        "ess_bulk": min(row["ess_bulk"] for row in table.values()),
        "ess_tail": min(row["ess_tail"] for row in table.values()),
        "divergences": result["divergences"],
        "reason": certificate["certificate"]["reason"],
        "mesh": certificate["certificate"]["mesh"],
        "truth_z": z,
    }
    print(
        f"{name:14s} {nodes} nodes: train {train_s:.0f} s, infer {infer_s:.0f} s, certify "
        f"{certify_s:.0f} s, total {case['total_s']:.0f} s; {case['status']}, "
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
    for key, label in (
        ("train_s", "train (21 FEM runs)"),
        ("infer_s", "infer (NUTS, 4 x 1000)"),
        ("certify_s", "certify (200 FEM runs)"),
    ):
        seconds = np.array([case[key] for case in cases])
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
