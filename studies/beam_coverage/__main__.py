"""Coverage on real solver output: infer the beam's parameters from the released FEniCS solutions.

For each of the 50 released OnceClampedBeam cases: the stored displacement at 20 nodes, Gaussian
noise of 0.2 mm, the posterior of (mu, lam) with an emulator of the released linear elements, and
its check against FEM.

    python -m studies.beam_coverage PUBLISHED_DIR
"""

import argparse
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from studies.common.figures import pyplot
from studies.common.output import study_header, write_json
from studies.common.twins import spread_nodes

import calibrate as cal
import emulator as em

HERE = Path(__file__).parent
SEED = 50
NOISE = 0.2  # mm
MODEL = "OnceClampedBeam"


def study(root: Path, count: int) -> list[dict[str, Any]]:
    """One row for each released case."""
    scene = em.scenes.once_clamped_beam(order=1)  # the released mesh
    with tempfile.TemporaryDirectory() as folder:
        emulator = em.train(scene, em.recipe("mechanics"), folder)
    thetas, tests = em.released.published_tests(MODEL, root)
    observe = cal.nodal_displacements(scene, spread_nodes(scene, 20, SEED))
    model = cal.model(emulator.cache(), observe, cal.GaussianNoise(sd=NOISE))
    simulator = em.Simulator(scene)
    rows = []
    for k in range(count):
        begin = time.perf_counter()
        noise = np.random.default_rng([SEED, k]).normal(0.0, NOISE, observe.points.shape)
        data = tests.displacement[k][observe.nodes] + noise
        posterior = cal.sample(model, data, seed=SEED + k)
        certificate = cal.certify(posterior, simulator)
        summary = posterior.summary(0.9)
        for name, truth in zip(scene.parameter_names, np.asarray(thetas[k]), strict=True):
            summary[name].update(
                truth=float(truth),
                covered=bool(summary[name]["low"] <= truth <= summary[name]["high"]),
            )
        rows.append(
            {
                "name": f"{MODEL} {k}",
                "status": certificate.verdict,
                "parameters": summary,
                "k_hat": certificate.k_hat,
                "shift": certificate.shift,
                "divergences": posterior.divergences,
                "seconds": time.perf_counter() - begin,
            }
        )
        worst = max(entry["r_hat"] for entry in summary.values())
        print(
            f"{k:3d} {certificate.verdict:13s} k {certificate.k_hat:6.2f}  R-hat {worst:.4f}  "
            + "covered "
            + " ".join(f"{name}:{'yes' if e['covered'] else 'no '}" for name, e in summary.items())
            + f"  {rows[-1]['seconds']:.0f} s",
            flush=True,
        )
    return rows


def conclude(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Coverage, largest R-hat, verdicts."""
    names = rows[0]["parameters"]
    return {
        "covered": {n: sum(row["parameters"][n]["covered"] for row in rows) for n in names},
        "cases": len(rows),
        "largest_r_hat": max(e["r_hat"] for row in rows for e in row["parameters"].values()),
        "smallest_ess": min(e["ess_bulk"] for row in rows for e in row["parameters"].values()),
        "accepted": sum(row["status"] == "accepted" for row in rows),
        "largest_k_hat": max(row["k_hat"] for row in rows),
        "largest_shift": max(abs(s) for row in rows for s in row["shift"].values()),
        "divergences": sum(row["divergences"] for row in rows),
    }


def draw(rows: list[dict[str, Any]], path: Path) -> None:
    """Every interval with its true value; intervals that miss it in red."""
    plt = pyplot()
    names = list(rows[0]["parameters"])
    figure, panels = plt.subplots(
        len(names), 1, figsize=(10, 6.5), sharex=True, layout="constrained"
    )
    for axes, name in zip(panels, names, strict=True):
        for k, row in enumerate(rows):
            entry = row["parameters"][name]
            colour = "tab:blue" if entry["covered"] else "tab:red"
            axes.plot([k, k], [entry["low"], entry["high"]], color=colour, lw=2.2)
            axes.plot(k, entry["truth"], "k_", ms=7)
        hits = sum(row["parameters"][name]["covered"] for row in rows)
        axes.set(ylabel=f"{name} (kPa)", title=f"{name}: {hits} of {len(rows)} truths covered")
    panels[-1].set_xlabel("released case")
    figure.suptitle("90 % intervals from 20 noisy displacements (FEniCS + 0.2 mm), black: truth")
    figure.savefig(path, dpi=130)
    plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("root", type=Path, help="folder of the released data")
    parser.add_argument("--cases", type=int, default=50)
    parser.add_argument("--out", type=Path, default=HERE)
    arguments = parser.parse_args()
    rows = study(arguments.root, arguments.cases)
    summary = conclude(rows)
    print(summary)
    header = study_header(HERE, SEED)
    write_json(arguments.out / "results.json", {**header, "summary": summary, "cases": rows})
    draw(rows, arguments.out / "coverage.png")
    if arguments.cases == 50:
        assert all(40 <= hits <= 50 for hits in summary["covered"].values())
        assert summary["largest_r_hat"] < 1.01
        assert summary["accepted"] >= 48


if __name__ == "__main__":
    main()
