"""New ventricles: seconds from a mesh to a usable emulator, and its errors.

``python -m studies.new_ventricle [--ventricles N] [--runs N] [--tests N]``. Each ventricle gets
a process of its own, so that imports and compilation count. Writes results.json and
new_ventricle.png beside itself, or under --out, and asserts what the README says.
"""

import argparse
import json
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from studies.common.output import save, study_header
from studies.common.processes import printed

import emulator as em
from calibrate.figures import pyplot
from emulator.accuracy.comparison import evaluate
from emulator.core.store import write_json
from emulator.fem import run_campaign, sobol
from emulator.geometry.generators.ellipsoid import EllipsoidalWall, truncated_ellipsoid
from emulator.scenes import Scene
from emulator.scenes.fibre_rules import Helix
from emulator.training import recipe, train

HERE = Path(__file__).parent
TEST_SEED = 90_210
# Wall (short and long semi-axes inside and outside, base; mm); rings, around, layers; helix angles.
VENTRICLES: dict[str, tuple[EllipsoidalWall, tuple[int, int, int], tuple[float, float]]] = {
    "small, thick": (EllipsoidalWall(18.0, 48.0, 31.0, 57.0, 16.0), (13, 28, 4), (75.0, -45.0)),
    "dilated, thin": (EllipsoidalWall(30.0, 62.0, 38.0, 68.0, 22.0), (17, 34, 2), (50.0, -70.0)),
    "long": (EllipsoidalWall(21.0, 68.0, 32.0, 77.0, 24.0), (18, 26, 3), (60.0, -60.0)),
    "round": (EllipsoidalWall(27.0, 45.0, 37.0, 54.0, 15.0), (14, 36, 3), (90.0, -90.0)),
}


def ventricle(name: str) -> Scene:
    """The built-in scene on the mesh and fibres of ``name``."""
    wall, mesh_size, angles = VENTRICLES[name]
    mesh = truncated_ellipsoid(wall, *mesh_size)
    fibres, _ = Helix(angles).directions(mesh)
    scene = em.scenes.left_ventricle(order=1)
    return replace(scene, name=name, mesh=mesh, fibres=fibres, origin={})


def one(name: str, began: float, runs: int, tests: int) -> dict[str, Any]:
    """Train on one ventricle and compare with FEM; ``began`` is when its process was started."""
    scene = ventricle(name)
    plan = replace(recipe("mechanics"), simulations=runs)
    with tempfile.TemporaryDirectory() as folder:
        forward = train(scene, plan, folder).cache()
        forward(scene.centre).block_until_ready()
    usable = time.time() - began
    known = run_campaign(em.Simulator(scene), sobol(scene, tests, TEST_SEED))
    report = evaluate(forward, known.theta, known.displacement)
    return {
        "name": name,
        "status": "done",
        "nodes": len(scene.mesh.nodes),
        "fem_runs": runs + 1,
        "usable_s": round(usable, 1),
        "tests": tests,
        **{key: report[key] for key in ("err_u", "err_V", "max_u")},
    }


def in_its_own_process(name: str, runs: int, tests: int) -> dict[str, Any]:
    """:func:`one`, imports and compilation included in its seconds."""
    words = ["--one", name, "--began", repr(time.time()), "--runs", str(runs)]
    case = printed("new_ventricle", *words, "--tests", tests)
    print(
        f"{name:14s} {case['nodes']:5d} nodes  usable after {case['usable_s']:5.1f} s  "
        f"err_V median {case['err_V']['median']:.1e} %  err_u {case['err_u']['median']:.1e} mm",
        flush=True,
    )
    return case


def draw(cases: list[dict[str, Any]], path: Path) -> None:
    """Seconds to a usable emulator, and its errors."""
    plt = pyplot()
    figure, panels = plt.subplots(1, 3, figsize=(12, 3.2), layout="constrained", sharey=True)
    names = [f"{case['name']}\n{case['nodes']} nodes" for case in cases]
    panels[0].barh(names, [case["usable_s"] for case in cases], color="tab:blue")
    panels[0].axvline(60.0, color="0.3", ls="--", label="aim: 60 s")
    panels[0].set(xlabel="mesh to usable emulator (s)", xlim=(0.0, None))
    for axes, key, unit in ((panels[1], "err_V", "%"), (panels[2], "err_u", "mm")):
        for q, marker in (("median", "o"), ("q97_5", "|"), ("max", "x")):
            values = [case[key][q] for case in cases]
            axes.plot(values, names, marker, color="tab:blue", label=q.replace("q97_5", "97.5 %"))
        axes.set(xscale="log", xlabel=f"{key} ({unit})")
        axes.grid(alpha=0.25)
    panels[1].axvline(0.1, color="0.3", ls="--", label="aim for the median: 0.1 %")
    for axes in panels[:2]:
        axes.legend(frameon=False, fontsize=8)
    panels[0].invert_yaxis()
    save(figure, path)


def check(cases: list[dict[str, Any]]) -> None:
    """The claims of the study's README that do not depend on the machine."""
    for case in cases:
        assert case["err_V"]["median"] < 0.1, case["name"]


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--ventricles", type=int, default=len(VENTRICLES))
    parser.add_argument("--runs", type=int, default=20, help="FEM runs besides the centre's")
    parser.add_argument("--tests", type=int, default=30)
    parser.add_argument("--out", type=Path, default=HERE)
    parser.add_argument("--one", choices=tuple(VENTRICLES), help=argparse.SUPPRESS)
    parser.add_argument("--began", type=float, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.one:
        print(json.dumps(one(arguments.one, arguments.began, arguments.runs, arguments.tests)))
        return
    names = list(VENTRICLES)[: arguments.ventricles]
    cases = [in_its_own_process(name, arguments.runs, arguments.tests) for name in names]
    arguments.out.mkdir(parents=True, exist_ok=True)
    header = study_header(HERE, TEST_SEED)
    write_json(arguments.out / "results.json", {**header, "cases": cases})
    draw(cases, arguments.out / "new_ventricle.png")
    check(cases)


if __name__ == "__main__":
    main()
