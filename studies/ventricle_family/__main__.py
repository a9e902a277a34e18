"""A network that has seen ventricles: what does it know of one it has not seen?

    python -m studies.ventricle_family
    python -m studies.ventricle_family --train --runs DIR --out DIR    # how it was trained
    python -m studies.ventricle_family --warm-starts                   # these anew, the rest kept
    python -m studies.ventricle_family --quick --out DIR

Twenty ventricles of the family that the shipped ``ventricle_family`` was not trained on, other in
wall, length, radius, truncation, fibres, uneven thickness and mesh; five theta each, judged by FEM:
before any FEM run, and after 1, 5 and 20 for an emulator that starts from the network, for the
recipe mechanics, and for POD + GP. And the network's prediction as FEM's start. Writes
results.json after each ventricle and family.png; ventricles that results.json holds are kept.
"""

import argparse
import json
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import jax
import numpy as np
from scipy.stats import qmc
from studies.common.output import save, study_header
from studies.ventricle_family.shapes import ventricles
from studies.ventricle_family.training import PLAN, BodyRuns, train_family
from studies.ventricle_family.workers import (
    KEYS,
    NETWORK,
    RUNS,
    THETA_SEED,
    first_prediction,
    one,
    solved,
    warm_starts,
)

import emulator as em
from calibrate.figures import BLUE, GREEN, VERMILION, pyplot
from calibrate.provenance import hardware, versions
from emulator.accuracy.comparison import quantiles
from emulator.core.store import read_arrays, write_json
from emulator.fem.campaign import run_campaign
from emulator.fem.campaign.designs import sobol
from emulator.scenes.built_in.ventricles import left_ventricle
from emulator.surrogates import load, save_emulator

HERE = Path(__file__).parent
TRAINING_SEED, TEST_SEED = 0, 1
TESTS = 5  # theta a ventricle


# How the network was trained.


def solve_family(folder: Path, count: int, each: int, workers: int) -> list[BodyRuns]:
    """FEM runs of ``count`` ventricles at ``each`` theta; what is there is kept."""
    made = ventricles(count, TRAINING_SEED)
    bits = (count * each - 1).bit_length()
    points = qmc.Sobol(5, rng=TRAINING_SEED + 1000).random_base2(bits)[: count * each]
    positions = points.reshape(count, each, 5)
    names = [f"{k:04d}" for k in range(count)]
    with ProcessPoolExecutor(workers, get_context("spawn")) as pool:
        list(pool.map(solved, [folder] * count, made, positions, names))
    runs = []
    for arguments, name in zip(made, names, strict=True):
        arrays, _ = read_arrays(folder / f"{name}.safetensors")
        if len(arrays["position"]) == each:  # equally many of each ventricle
            u = arrays["displacement"].astype(float)
            runs.append(BodyRuns(left_ventricle(**arguments), arrays["position"], u))
    return runs


def train(arguments: argparse.Namespace) -> None:
    """Train the network and write it, an emulator of the built-in ventricle, under --out."""
    arguments.runs.mkdir(parents=True, exist_ok=True)
    runs = solve_family(arguments.runs, arguments.ventricles, arguments.each, arguments.workers)
    plan = replace(PLAN, steps=arguments.steps)
    folder = arguments.out / NETWORK
    emulator = train_family(
        runs, plan, folder, left_ventricle(order=1), progress=True, resume=arguments.resume
    )
    record = {
        **emulator.record,
        "command": "python -m studies.ventricle_family --train --runs DIR --out DIR",
        "fem_runs": sum(len(r.position) for r in runs),
        "hardware": hardware(),
        "versions": versions(),
    }
    save_emulator(replace(emulator, record=record), folder)


# What it knows of others.


def study(arguments: argparse.Namespace) -> list[dict[str, Any]]:
    """All rows; those there already are kept."""
    path = arguments.out / "results.json"
    cases = [] if arguments.again or not path.is_file() else json.loads(path.read_text())["cases"]
    done = {case["name"] for case in cases}
    made = ventricles(arguments.ventricles, TEST_SEED)
    todo = [k for k in range(len(made)) if f"ventricle {k}" not in done]
    with ProcessPoolExecutor(arguments.workers, get_context("spawn")) as pool:
        told = [(k, made[k], arguments.tests, not arguments.quick) for k in todo]
        for row in pool.map(one, *zip(*told, strict=True)) if told else ():
            cases.append(row)
            content = {**study_header(HERE, TEST_SEED), "cases": cases}
            write_json(path, content | {"summary": summary(cases)})
            err = {key: row["before"][key]["median"] for key in KEYS}
            print(f"{row['name']}: {err['err_u']:.3f} mm, {err['err_V']:.2f} %", flush=True)
    return cases


def warm_starts_again(row: dict[str, Any]) -> dict[str, Any]:
    """``row`` with its starts of FEM repeated."""
    number = int(row["name"].split()[1])
    scene = left_ventricle(**{"order": 1, **row["arguments"]})
    network, _ = first_prediction(scene, load(NETWORK))
    known = run_campaign(em.Simulator(scene), sobol(scene, TESTS, THETA_SEED + number))
    jax.clear_caches()
    return {**row, "warm_start": warm_starts(scene, network, known)}


def repeat_warm_starts(out: Path) -> list[dict[str, Any]]:
    """All rows of results.json, their starts of FEM repeated."""
    path = out / "results.json"
    kept = json.loads(path.read_text())
    for place, row in enumerate(kept["cases"]):
        kept["cases"][place] = warm_starts_again(row)
        counts = kept["cases"][place]["warm_start"]
        print(row["name"], *(counts[f"factorisations_from_{s}"] for s in ("rest", "network")))
    header = {name: study_header(HERE, TEST_SEED)[name] for name in ("commit", "versions")}
    write_json(path, kept | {"warm_starts_by": header, "summary": summary(kept["cases"])})
    return kept["cases"]


def summary(cases: list[dict[str, Any]]) -> dict[str, Any]:
    """Over ventricles, quantiles of each one's median."""

    def over(values: list[float]) -> dict[str, float]:
        return quantiles(np.array(values))

    found: dict[str, Any] = {
        "ventricles": len(cases),
        "before": {k: over([c["before"][k]["median"] for c in cases]) for k in KEYS},
        "one_solution_everywhere": {
            k: over([c["one_solution_everywhere"][k]["median"] for c in cases]) for k in KEYS
        },
        "seconds_to_first_prediction": over([c["seconds_to_first_prediction"] for c in cases]),
    }
    starts = [c["warm_start"] for c in cases]
    for name in ("factorisations_from_rest", "factorisations_from_network"):
        found[name] = over([n for start in starts for n in start[name]])
    for place, count in enumerate(RUNS):
        rows = [case["after"][place]["errors"] for case in cases if case["after"]]
        methods = list(rows[0]) if rows else []
        found[f"after {count}"] = {
            m: {k: over([row[m][k]["median"] for row in rows]) for k in KEYS} for m in methods
        }
    return found


METHODS = {"network": ("o", BLUE), "mechanics": ("s", VERMILION), "POD + GP": ("^", GREEN)}


def draw(cases: list[dict[str, Any]], path: Path) -> None:
    """Errors against FEM runs, a mark a ventricle, and factorisations with and without a start."""
    plt = pyplot()
    figure, (left, right) = plt.subplots(
        1, 2, figsize=(10.0, 4.0), layout="constrained", width_ratios=(2, 1)
    )
    jitter = np.random.default_rng(0).uniform(-0.12, 0.12, len(cases))
    before = [case["before"]["err_u"]["median"] for case in cases]
    left.plot(jitter, before, "o", color=METHODS["network"][1], mfc="none", label="network")
    for name, (mark, colour) in METHODS.items():
        for place in range(len(RUNS)):
            some = [
                (place + 1 + x, c["after"][place]["errors"][name]["err_u"]["median"])
                for x, c in zip(jitter, cases, strict=True)
                if c["after"] and name in c["after"][place]["errors"]
            ]
            if some:
                label = name if name != "network" and place == len(RUNS) - 1 else None
                left.plot(*zip(*some, strict=True), mark, color=colour, mfc="none", label=label)
    left.set(yscale="log", xlabel="FEM runs on the new ventricle", ylabel="median err_u, mm")
    left.set_xticks(range(len(RUNS) + 1), [0, *RUNS])
    left.grid(axis="y", color="0.9")
    left.legend(frameon=False)
    counts = [
        [n for case in cases for n in case["warm_start"][f"factorisations_from_{start}"]]
        for start in ("rest", "network")
    ]
    right.boxplot(counts, whis=(0, 100), medianprops={"color": "black"})
    right.set_xticks((1, 2), ["from rest", "from the network"])
    right.set(ylabel="factorisations of a solve", yscale="log")
    right.set_yticks([3, 6, 10, 30, 100], ["3", "6", "10", "30", "100"])
    right.minorticks_off()
    for axes in (left, right):
        axes.spines[["top", "right"]].set_visible(False)
    save(figure, path)


def main() -> None:
    """Train, or run the study."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--train", action="store_true", help="solve the family and train on it")
    parser.add_argument("--runs", type=Path, help="folder of the FEM runs to train on")
    parser.add_argument("--each", type=int, default=10, help="FEM runs of a ventricle")
    parser.add_argument("--steps", type=int, default=PLAN.steps)
    parser.add_argument("--resume", action="store_true", help="go on from the checkpoint")
    parser.add_argument("--ventricles", type=int, help="200 to train on, 20 to judge by")
    parser.add_argument("--tests", type=int, default=TESTS, help="theta a ventricle")
    parser.add_argument("--warm-starts", action="store_true", help="repeat FEM's starts alone")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--again", action="store_true", help="repeat what is there")
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--out", type=Path, default=HERE)
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    if arguments.train:
        if arguments.runs is None:
            parser.error("--train wants --runs, the folder of the FEM runs")
        arguments.ventricles = arguments.ventricles or 200
        train(arguments)
        return
    if arguments.quick:
        arguments.ventricles, arguments.tests, arguments.workers = 1, 2, 1
    arguments.ventricles = arguments.ventricles or 20
    cases = repeat_warm_starts(arguments.out) if arguments.warm_starts else study(arguments)
    draw(cases, arguments.out / "family.png")
    assert all(case["warm_start"]["converged"] for case in cases)
    assert all(case["warm_start"]["largest_difference_mm"] < 1e-5 for case in cases)


if __name__ == "__main__":
    main()
