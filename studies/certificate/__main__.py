"""Does a certificate say the truth? Posteriors made wrong in known ways, verdict against truth.

    python -m studies.certificate
    python -m studies.certificate --quick --out DIR    # three posteriors
    python -m studies.certificate --until 1000    # FEM runs doubled while a verdict is undecided
    python -m studies.certificate --fem --nuts         # the beam's: FEM judges what NUTS drew

Writes results.json and certificate.png (with --fem, --nuts, --until or several: fem.json,
fem_nuts.json, until.json), and asserts what the README of the study says.
"""

import argparse
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from studies.certificate import problems
from studies.certificate.cases import cases
from studies.certificate.problems import ExactSimulator
from studies.common.figures import BLUE, GREEN, ORANGE, VERMILION, pyplot
from studies.common.output import save, study_header, write_json

import calibrate as cal
import emulator as em

HERE = Path(__file__).parent
NUTS = cal.samplers.NUTSOptions(500, 1000, chains=4)
SEED = 0
LARGEST_SHIFT, LARGEST_SD = 0.5, 0.25  # what no accepted posterior may exceed
# Colours and shapes that differ for every reader (Okabe and Ito 2008).
MARKS = {
    "accepted": (GREEN, "o"),
    "reweight": (BLUE, "s"),
    "undecided": (ORANGE, "^"),
    "not certified": (VERMILION, "X"),
}


def row(case, problem, simulator, budget, *, nuts=False, at_most=None) -> dict[str, Any]:
    """Verdict and truth of one case; with ``nuts``, of NUTS's draws from its wrong model."""
    begin = time.perf_counter()
    posterior, (mean, sd) = case.make(problem, case.size, case.seed)
    if nuts and case.sampled:
        data = posterior.data["displacement"]
        posterior = cal.sample(posterior.model, data, options=NUTS, seed=case.seed)
    if posterior.model.full.scene is not problem.scene:  # in a box of its own
        simulator = ExactSimulator(posterior.model.full)
    certificate = cal.certify(
        posterior, simulator, draws=budget or case.budget, at_most=at_most, seed=case.seed
    )
    draws = np.stack(list(posterior.draws().values()), axis=1)
    e = certificate.evidence
    return {
        "name": case.name,
        "status": certificate.verdict,
        "problem": case.problem,
        "kind": case.kind,
        "size": case.size,
        "good": case.good,
        "reason": certificate.reason,
        "true_shift": float(np.max(np.abs(draws.mean(0) - mean) / sd)),
        "true_sd": float(np.max(np.abs(draws.std(0, ddof=1) / sd - 1.0))),
        # How far FEM's mean and sd by the certificate are from the truth, and by its own errors.
        "found_mean": _largest(
            (f.value - m) / s for f, m, s in zip(e.mean.values(), mean, sd, strict=False)
        ),
        "found_sd": _largest(f.value / s - 1.0 for f, s in zip(e.sd.values(), sd, strict=False)),
        "z": [float((f.value - m) / f.error) for f, m in zip(e.mean.values(), mean, strict=False)],
        "spread": e.tail.spread,
        "p": min(m.p for m in e.misfit.values()),
        "k_hat": e.tail.k_hat,
        "pool": e.tail.pool,
        "runs": e.physics.runs,
        "sound": case.sampled and case.kind != "wrong_noise",
        "seconds": time.perf_counter() - begin,
    }


def _largest(values) -> float:
    return float(np.max(np.abs(list(values))))


def is_wrong(case) -> bool:
    return case["true_shift"] > LARGEST_SHIFT or case["true_sd"] > LARGEST_SD


def conclude(rows) -> dict[str, Any]:
    good = [r for r in rows if r["good"]]
    within = [r for r in rows if r["sound"] and r["true_shift"] < 0.2 and r["true_sd"] < 0.15]
    repaired = [r for r in rows if r["status"] == "reweight"]
    return {
        "posteriors": len(rows),
        "verdicts": dict(Counter(r["status"] for r in rows)),
        "wrong": sum(map(is_wrong, rows)),
        "wrong_and_accepted": [
            r["name"] for r in rows if is_wrong(r) and r["status"] == "accepted"
        ],
        "good": len(good),
        "good_verdicts": dict(Counter(r["status"] for r in good)),
        "within": len(within),
        "within_verdicts": dict(Counter(r["status"] for r in within)),
        "reweighted_largest_error_of_a_mean": max((r["found_mean"] for r in repaired), default=0.0),
        "reweighted_largest_error_of_an_sd": max((r["found_sd"] for r in repaired), default=0.0),
    }


def draw(rows, path: Path) -> None:
    """True shift and true change of sd of every posterior, coloured by verdict."""
    plt = pyplot()
    figure, axes = plt.subplots(figsize=(7.5, 5.5), layout="constrained")
    axes.fill_between([1e-9, LARGEST_SHIFT], 1e-9, LARGEST_SD, color="0.93", lw=0)
    for verdict, (colour, mark) in MARKS.items():
        chosen = [r for r in rows if r["status"] == verdict]
        x = [max(r["true_shift"], 3e-3) for r in chosen]
        y = [max(r["true_sd"], 3e-3) for r in chosen]
        axes.plot(x, y, mark, color=colour, ls="", label=f"{verdict} ({len(chosen)})", alpha=0.7)
    axes.axvline(LARGEST_SHIFT, color="k", lw=0.8)
    axes.axhline(LARGEST_SD, color="k", lw=0.8)
    axes.set(xscale="log", yscale="log", xlabel="largest true shift of a mean / sd")
    axes.set(xlim=(2e-3, 9.0), ylim=(2.5e-3, 2.5))
    axes.set(ylabel="largest true change of an sd")
    axes.legend(loc="lower right")
    axes.set_title("Verdicts: none accepted beyond the lines")
    save(figure, path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--only", help="kinds to run, comma-separated")
    parser.add_argument("--fem", action="store_true", help="the beam's, judged by FEM itself")
    parser.add_argument("--nuts", action="store_true", help="draws by NUTS, not independent ones")
    parser.add_argument("--draws", type=int, help="FEM runs a certificate; by default the case's")
    parser.add_argument("--until", type=int, metavar="N", help="double runs until decided, up to N")
    parser.add_argument("--out", type=Path, default=HERE)
    arguments = parser.parse_args()
    rows: list[dict[str, Any]] = []
    built: dict[str, Any] = {}
    for case in cases(arguments.quick):
        if arguments.only and case.kind not in arguments.only.split(","):
            continue
        if arguments.fem and case.problem != "beam":
            continue
        if case.problem not in built:
            problem = getattr(problems, case.problem)()
            exact = ExactSimulator(problem.forward)
            built[case.problem] = problem, em.Simulator(problem.scene) if arguments.fem else exact
        problem, simulator = built[case.problem]
        options = {"nuts": arguments.nuts, "at_most": arguments.until}
        rows.append(row(case, problem, simulator, arguments.draws, **options))
        r = rows[-1]
        print(
            f"{r['name']:38s} {r['status']:13s} true {r['true_shift']:6.2f} {r['true_sd']:6.2f} "
            f"found {r['found_mean']:6.3f} {r['found_sd']:6.3f} spread {r['spread']:8.3f} "
            f"pool {r['pool']:5.0f} p {r['p']:.3f} k {r['k_hat']:5.2f} {r['seconds']:4.1f} s "
            f"{r['reason']}",
            flush=True,
        )
    summary = conclude(rows)
    print(summary)
    header = study_header(HERE, SEED)
    routes = [name for name in ("fem", "nuts", "until") if getattr(arguments, name)]
    name = "_".join(routes) or "results"
    write_json(arguments.out / f"{name}.json", {**header, "summary": summary, "cases": rows})
    if not routes:
        draw(rows, arguments.out / "certificate.png")
    assert not summary["wrong_and_accepted"]
    refused = summary["good_verdicts"].get("not certified", 0)
    assert refused <= 0.05 * summary["good"]


if __name__ == "__main__":
    main()
