"""Muscle that relaxes: which viscosity do six tests show, and what of a rate that nobody saw?

    python -m studies.muscle --data DIR            # DIR has A_10_1.csv and so on; half an hour
    python -m studies.muscle --data DIR --quick --out OUT
    python -m studies.muscle --judge DIR           # DIR has curves that were kept apart

Writes results.json, with 90 % bands of both directions pressed at 5 % a second, and muscle.png.
``--judge`` prints how many points of the curves in DIR are inside of the band of the likeliest law
at their own times and stretches.
"""

from __future__ import annotations

import json
import re
from functools import partial
from pathlib import Path
from time import perf_counter

import numpy as np
from studies.common.figures import BLUE, ORANGE, pyplot
from studies.common.output import Case, Results, parser, run, save
from studies.muscle.tests_of_muscle import (
    DIRECTIONS,
    Curve,
    posterior_of,
    pressed,
    read,
    stresses,
)

import emulator as em

HERE = Path(__file__).parent
SEED = 88
MODELS = ("elastic", "1", "2", "3", "spectrum")
HELD_OUT = "30_1"  # the fastest test, which is left out in turn
FASTER = (20.0, 5.0)  # %, and % a second
KEPT = 200  # draws in results.json, of cases that are predicted from
WORDS = {"1": "one term", "2": "two terms", "3": "three terms"}


def fit(curves: list[Curve], model: str, quick: bool, keep: bool) -> Case:
    """The posterior of some curves and its evidence; where ``keep``, a few of its draws, too."""
    start = perf_counter()
    posterior = posterior_of(model, curves, SEED, quick)
    rows, attributes = posterior.summary(), posterior.tree.attrs
    draws, thetas = posterior.draws(), np.asarray(posterior.thetas())
    sds = np.stack([np.asarray(draws[name]) for name in ("noise_sd", "spatial_sd")], axis=-1)
    kept = np.linspace(0, len(thetas) - 1, min(KEPT, len(thetas))).astype(int)
    keys = ("mean", "sd", "low", "high", "r_hat", "ess_bulk")
    few = {"thetas": np.round(thetas[kept], 5).tolist(), "sds": np.round(sds[kept], 5).tolist()}
    return {
        "log_evidence": float(attributes["log_evidence"]),
        "log_evidence_error": float(attributes["log_evidence_error"]),
        "parameters": {n: {k: round(float(r[k]), 4) for k in keys} for n, r in rows.items()},
        "tests": [curve.name for curve in curves],
        **(few if keep else {}),
        "seconds": round(perf_counter() - start, 1),
    }


def bands(model: str, case: Case, curves: list[Curve]) -> list[dict[str, list[float]]]:
    """90 % bands (k,) of each curve in kPa: of what is measured, errors included, and of the law.

    Both kinds of errors are drawn at each point, which is all that a band of points needs.
    """
    names = ("low", "high", "law_low", "median", "law_high")
    result, rng = [], np.random.default_rng(SEED)
    for predicted in stresses(model, np.array(case["thetas"]), curves):
        errors = np.linalg.norm(case["sds"], axis=1)[:, None] * rng.normal(size=predicted.shape)
        ends = np.quantile(predicted + errors, [0.05, 0.95], axis=0)
        of_law = np.quantile(predicted, [0.05, 0.5, 0.95], axis=0)
        values = zip(names, (*ends, *of_law), strict=True)
        result.append({name: np.round(value, 4).tolist() for name, value in values})
    return result


def likeliest(cases: dict[str, Case], direction: str) -> str:
    """The model of largest evidence."""
    names = [m for m in MODELS if f"{direction} {m}" in cases]
    return max(names, key=lambda m: cases[f"{direction} {m}"]["log_evidence"])


def judge(folder: Path, cases: dict[str, Case]) -> None:
    """Print how many points of each curve lie in the band of the likeliest law."""
    for direction in DIRECTIONS:
        curves = [curve for curve in read(folder) if curve.direction == direction]
        model = likeliest(cases, direction)
        predicted = bands(model, cases[f"{direction} {model}"], curves) if curves else []
        for curve, band in zip(curves, predicted, strict=True):
            low, high = np.array(band["low"]), np.array(band["high"])
            inside = (low <= curve.stress) & (curve.stress <= high)
            peak = int(np.argmin(curve.stress))
            print(
                f"{curve.name}: {inside.sum()} of {len(inside)} points inside of the 90 % band of "
                f"{WORDS.get(model, model)}; at the largest stress {curve.stress[peak]:.3f} kPa, "
                f"band {low[peak]:.3f} to {high[peak]:.3f}, at the end {curve.stress[-1]:.3f}, "
                f"band {low[-1]:.3f} to {high[-1]:.3f}"
            )


def draw(cases: dict[str, Case], curves: list[Curve], path: Path) -> Case:
    """Draw data, the likeliest law's bands and the elastic law; return the bands of the faster."""
    figure, axes = pyplot().subplots(2, 4, figsize=(12.0, 5.5), layout="constrained", sharex="col")
    faster: Case = {}
    for row, direction in zip(axes, DIRECTIONS, strict=True):
        if not any(name.startswith(f"{direction} ") for name in cases):
            continue
        model, unseen = likeliest(cases, direction), pressed(direction, *FASTER)
        shown = [*(curve for curve in curves if curve.direction == direction), unseen]
        predicted = bands(model, cases[f"{direction} {model}"], shown)
        elastic = cases.get(f"{direction} elastic")
        without = bands("elastic", elastic, shown) if elastic is not None else predicted
        for axis, curve, band, other in zip(row, shown, predicted, without, strict=True):
            axis.fill_between(curve.time, band["low"], band["high"], color=BLUE, alpha=0.2, lw=0)
            axis.plot(curve.time, other["median"], color=ORANGE, lw=1, label="elastic")
            axis.plot(curve.time, band["median"], color=BLUE, label=WORDS.get(model, model))
            axis.plot(curve.time, curve.stress, "k.", ms=3)
            title = f"{direction}, {curve.percent:g} % at {curve.rate:g} %/s"
            axis.set_title(title + " (not seen)" * (curve is unseen), fontsize=9)
            axis.spines[["top", "right"]].set_visible(False)
        faster[direction] = {
            "model": model,
            "time": unseen.time.tolist(),
            "stretch": unseen.stretch.tolist(),
            **predicted[-1],
        }
        row[0].set_ylabel("Cauchy stress, kPa")
        row[0].legend(frameon=False, fontsize=8)
    for axis in axes[1]:
        axis.set_xlabel("time, s")
    save(figure, path)
    return faster


def conclude(cases: dict[str, Case]) -> Case:
    """Evidence and held-out density of each model over the best one's, by direction."""
    summary: Case = {}
    for direction in DIRECTIONS:
        for model in MODELS:
            whole = cases.get(f"{direction} {model}")
            rest = cases.get(f"{direction} {model} without {HELD_OUT}")
            if whole is not None:
                entry = {"log_evidence": round(whole["log_evidence"], 2)}
                if rest is not None:
                    density = whole["log_evidence"] - rest["log_evidence"]
                    entry["log_density_held_out"] = round(density, 2)
                summary[f"{direction} {model}"] = entry
    return summary


def main() -> None:
    """Run the study."""
    words = parser(__doc__, HERE)
    words.add_argument("--data", type=Path, help="folder of the curves")
    words.add_argument("--judge", type=Path, metavar="DIR", help="folder of curves kept apart")
    words.add_argument("--only", default="", help="cases whose names match, such as 'A .*'")
    arguments = words.parse_args()
    if arguments.judge is not None:
        there = json.loads((arguments.out / "results.json").read_text())
        of_all = arguments.judge / "muscle"
        folder = of_all if of_all.is_dir() else arguments.judge
        judge(folder, {case["name"]: case for case in there["cases"]})
        return
    if arguments.data is None:
        raise em.InputError("give --data DIR, the folder of the curves")
    quick = arguments.quick
    curves = read(arguments.data, 4 if quick else 1)
    results = Results(arguments.out, SEED, again=arguments.again, settings={"quick": quick})
    for direction in DIRECTIONS[: 1 if quick else None]:
        for model in MODELS[1:2] if quick else MODELS:
            own = [curve for curve in curves if curve.direction == direction]
            rest = [curve for curve in own if not curve.name.endswith(f"_{HELD_OUT}")]
            parts = {f"{direction} {model}": own, f"{direction} {model} without {HELD_OUT}": rest}
            for name, some in list(parts.items())[: 1 if quick else None]:
                if re.match(arguments.only, name):
                    results.case(name, partial(fit, some, model, quick, keep=some is own))
    cases = {case["name"]: case for case in results.cases}
    summary = conclude(cases)
    faster = draw(cases, curves, arguments.out / "muscle.png")
    results.write(summary=summary, bands=faster)
    print(json.dumps(summary, indent=2))


if __name__ == "__main__":
    run(main)
