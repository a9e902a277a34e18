"""A beating ventricle with mass, viscosity, springs and dashpots, beside EasyFEA on one mesh.

    python -m studies.cardiac_cycle --peer PYTHON    # an interpreter with EasyFEA 7.1 and Gmsh
    python -m studies.cardiac_cycle --quick          # a few steps on a coarse mesh

Writes results.json and cardiac_cycle.png.
"""

import os
import subprocess
import tempfile
from dataclasses import replace
from functools import partial
from pathlib import Path
from time import perf_counter

import jax.numpy as jnp
import numpy as np
from studies.cardiac_cycle import ventricle as of
from studies.common.figures import BLUE, GREEN, ORANGE, pyplot
from studies.common.output import Case, Results, parser, run, save

import emulator as em

HERE = Path(__file__).parent
PEER = HERE / "easyfea_cycle.py"
MM, KPA = 1e-3, 1e3  # in m and Pa
SECONDS = 1.0


def energy(strain, a, b, a_f, b_f, a_s, b_s, a_fs, b_fs, kappa):
    """The benchmark's law in kPa: stretches with their change of volume, switches of a sigmoid."""
    F, (fibre, sheet) = strain.H + jnp.eye(3), strain.directions
    total = 0.5 * a / b * jnp.expm1(b * strain.isochoric_I1_minus_3)
    for direction, c, d in ((fibre, a_f, b_f), (sheet, a_s, b_s)):
        x = jnp.sum((F @ direction) ** 2) - 1.0
        total += 0.5 * c / d * jnp.expm1(d * x**2) / (1.0 + jnp.exp(-of.SWITCH * x))
    total += 0.5 * a_fs / b_fs * jnp.expm1(b_fs * jnp.vdot(F @ fibre, F @ sheet) ** 2)
    return total + 0.25 * kappa * ((1.0 + strain.J_minus_1) ** 2 - 1.0 - 2.0 * strain.ln_J)


LAW = em.laws.Law(
    "arostica",
    (*(em.laws.modulus(n) if n.startswith("a") else em.laws.number(n) for n in of.LAW),
     em.laws.modulus("kappa")),
    energy, fibres=True, sheets=True, exponential=True,
)  # fmt: skip


def scene_of(path: Path) -> em.Scene:
    """The scene of the mesh in ``path``, in mm, kPa and s, by a scene file beside it."""
    mesh = em.read_mesh(path)  # takes lengths as mm
    mesh = em.Mesh(mesh.nodes / MM, mesh.elements, facet_sets=mesh.facet_sets)
    fibres, sheets = of.directions(mesh.nodes[mesh.elements].mean(axis=1) * MM)
    em.write_mesh(path.with_suffix(".vtu"), mesh, fibres, sheets)
    em.laws.LAWS[LAW.name] = LAW
    constants = {n: v / KPA if n.startswith("a") else v for n, v in of.LAW.items()}
    constants |= {"kappa": of.BULK / KPA, "eta": of.ETA / KPA}
    lines = [f'law = "{LAW.name}"', f'mesh = "{path.stem}.vtu"', "[constants]"]
    lines += [f"{name} = {value}" for name, value in constants.items()]
    lines += ["[viscosity]", 'kind = "kelvin_voigt"', "[inertia]", f"density = {of.DENSITY / 1e3}"]
    for name, unit in (("pressure", "kPa"), ("tension", "kPa"), ("time", "s")):
        lines += [f"[parameters.{name}]", f'unit = "{unit}"', "range = [0.0, 1000.0]"]
    lines += ["[[loads]]", 'kind = "follower_pressure"', 'facet_set = "endo"']
    lines += ["[[loads]]", 'kind = "active_tension"']
    for surface, numbers, direction in (("top", of.TOP, "all"), ("epi", of.EPI, "normal")):
        kinds = (("elastic", "stiffness"), ("dashpots", "damping"))
        for (kind, name), number in zip(kinds, numbers, strict=True):
            lines += ["[[supports]]", f'kind = "{kind}"', f'facet_set = "{surface}"']
            lines += [f"{name} = {number * MM / KPA}", f'direction = "{direction}"']
    path.with_suffix(".toml").write_text("\n".join(lines))
    return em.find_scene(str(path.with_suffix(".toml")))


def at_points(mesh: em.Mesh, u: np.ndarray) -> dict[str, np.ndarray]:
    """The displacement (m, 3) mm of the benchmark's points, from (m, n, 3) at the nodes."""
    answers = {}
    for name, point in of.POINTS.items():
        corners = mesh.nodes[mesh.elements[:, :4]]
        sides = corners[:, 1:] - corners[:, :1]
        shares = np.linalg.solve(
            np.swapaxes(sides, 1, 2), (np.array(point) / MM - corners[:, 0])[..., None]
        )[..., 0]
        shares = np.column_stack([1.0 - shares.sum(axis=1), shares])
        where = int(np.argmax(shares.min(axis=1)))
        answers[name] = np.einsum("a,mai->mi", shares[where], u[:, mesh.elements[where, :4]])
    return answers


def ours(scene: em.Scene, count: int, seconds: float) -> tuple[np.ndarray, float, float]:
    """The displacements (count, n, 3) mm, and the seconds of a first and of a second run."""
    times = seconds * (np.arange(count) + 1.0) / count
    tension, pressure = (curve / KPA for curve in of.curves(times))
    thetas = jnp.stack([jnp.asarray(pressure), jnp.asarray(tension), jnp.asarray(times)], axis=1)
    simulator, took = em.Simulator(scene), list[float]()
    for _ in range(2):
        begin = perf_counter()
        solution = simulator.path(thetas)
        u = np.asarray(solution.displacement)
        took.append(perf_counter() - begin)
    if np.asarray(solution.status).any():
        raise em.SolverError(f"{scene.name}: {int(np.asarray(solution.status != 0).sum())} steps")
    return u, took[0], took[1]


def cycle(size: float, count: int, seconds: float, peer: str | None) -> Case:
    """Both programs on one mesh of tetrahedra of ``size`` m."""
    with tempfile.TemporaryDirectory() as place:
        path = Path(place) / "ventricle.msh"
        of.write_mesh(str(path), size)
        scene = scene_of(path)
        u, first, again = ours(scene, count, seconds)
        points = at_points(scene.mesh, u)
        static = replace(scene, inertia=None)
        slow = at_points(scene.mesh, ours(static, count, seconds)[0])
        answer: Case = {
            "nodes": len(scene.mesh.nodes),
            "steps": count,
            "seconds": {"first": round(first, 1), "again": round(again, 1)},
            "times": [round(seconds * (k + 1) / count, 6) for k in range(count)],
            "points": {n: np.round(x, 5).tolist() for n, x in points.items()},
            "without mass": {n: np.round(x, 5).tolist() for n, x in slow.items()},
            "mass moves by": {n: float(np.abs(slow[n] - points[n]).max()) for n in points},
        }
        if peer is None:
            return answer
        words = [peer, str(PEER), place, str(count), str(seconds)]
        subprocess.run(words, check=True, stdout=subprocess.DEVNULL)
        told = np.load(Path(place) / "easyfea.npz")
        order = np.argmin(
            np.abs(told["nodes"][None] / MM - scene.mesh.nodes[:, None]).sum(axis=2), axis=1
        )
        others = at_points(scene.mesh, told["u"][:, order] / MM)
    largest = {n: float(np.linalg.norm(x, axis=1).max()) for n, x in others.items()}
    apart = {n: float(np.linalg.norm(others[n] - points[n], axis=1).max()) for n in others}
    return answer | {
        "easyfea": str(told["version"]),
        "easyfea seconds": round(float(told["seconds"]), 1),
        "easyfea points": {n: np.round(x, 5).tolist() for n, x in others.items()},
        "largest": largest,
        "apart": apart,
        "apart, of the largest": {n: apart[n] / largest[n] for n in apart},
    }


def draw(case: Case, path: Path) -> None:
    """Each point's displacement through the cycle, and the two programs' difference."""
    figure, axes = pyplot().subplots(1, 3, figsize=(12.0, 3.6), layout="constrained")
    times = case["times"]
    for axis, name in zip(axes, case["points"], strict=False):
        for k, (component, colour) in enumerate(zip("xyz", (BLUE, ORANGE, GREEN), strict=True)):
            axis.plot(times, np.array(case["points"][name])[:, k], color=colour, label=component)
            if "easyfea points" in case:
                other = np.array(case["easyfea points"][name])[:, k]
                axis.plot(times[::6], other[::6], "o", color=colour, ms=3.5, mfc="none")
        axis.set(xlabel="time (s)", ylabel="displacement (mm)", title=f"{name}; circles EasyFEA")
        axis.legend(frameon=False)
    for name, colour in zip(case["points"], (BLUE, ORANGE), strict=True):
        x = np.array(case["points"][name])
        slow = np.linalg.norm(np.array(case["without mass"][name]) - x, axis=1)
        axes[2].plot(times, slow, ":", color=colour, label=f"{name}: without mass")
        if "easyfea points" in case:
            apart = np.linalg.norm(np.array(case["easyfea points"][name]) - x, axis=1)
            axes[2].plot(times, apart, color=colour, label=f"{name}: EasyFEA")
    axes[2].set(xlabel="time (s)", ylabel="difference (mm)", yscale="log", title="differences")
    axes[2].legend(frameon=False, fontsize=8)
    save(figure, path)


def main() -> None:
    """Run the study."""
    words = parser(__doc__, HERE)
    words.add_argument("--peer", default=os.environ.get("CALIBRATE_EASYFEA"))
    arguments = words.parse_args()
    results = Results(arguments.out, 0, again=arguments.again)
    if arguments.quick:
        results.case("quick", partial(cycle, 0.02, 8, 0.2, arguments.peer))
    else:
        results.case("cycle", partial(cycle, 0.008, 250, SECONDS, arguments.peer))
    case = results.cases[-1]
    for name, share in case.get("apart, of the largest", {}).items():
        print(f"{name}: {case['apart'][name]:.3f} mm apart, {100.0 * share:.2f} % of the largest")
    print(f"seconds: {case['seconds']}; EasyFEA {case.get('easyfea seconds', 'not run')}")
    results.write()
    draw(case, arguments.out / "cardiac_cycle.png")


if __name__ == "__main__":
    run(main)
