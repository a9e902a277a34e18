"""From an image to a posterior: what do unloading and unknown fibres change?

    python -m studies.imaged_heart            # 20 hearts; cases that are there are kept
    python -m studies.imaged_heart --only 0 1
    python -m studies.imaged_heart --quick --out DIR

A heart of FEM's is imaged at the end of diastole, with errors. Its stiffness, contractility,
pressure, fibre angles and unloaded volume are inferred with unloading and unknown fibres; with
fibres taken as known; and with the image taken for the shape at rest. Writes results.json after
each heart, and imaged_heart.png.
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Any

import jax
import numpy as np
from studies.common.output import Case, Results, parser
from studies.imaged_heart import measured
from studies.imaged_heart.figures import LABELS, draw
from studies.imaged_heart.heart import imaged
from studies.imaged_heart.measured import ANGLE, ANGLE_SD, fibre_stress

import calibrate as cal
import emulator as em

HERE = Path(__file__).parent
SEED, HEARTS, CERTIFIED = 61, 20, 2
AT_REST, KNOWN = 2, 8  # hearts that are also inferred by the other ways, which add their time
_DRAWS, _QUICK_DRAWS = 300, 25
# FEM runs of a certificate, and how many it may take until it is decided; none on a finer mesh, on
# which each takes a minute.
_FEM, _MOST = 120, 960
WAYS = {"unloaded": (True, True), "fibres known": (True, False), "image at rest": (False, True)}
"""Way -> whether the image is unloaded, and whether fibre angles are unknown."""


def plan_of(loaded: bool, quick: bool) -> em.Plan:
    """The image at rest is for comparison: a cheaper emulator."""
    runs, order = (12, 1) if quick else (40, 2) if loaded else (30, 2)
    return replace(em.recipe("mechanics"), simulations=runs, order=order, seed=SEED)


def prior_of(scene: em.Scene) -> dict[str, Any]:
    """Angles about the rule's; the rest by the scene's ranges."""
    ranges = {p.name: (p.low, p.high) for p in scene.parameters}
    return {
        name: cal.priors.truncated_normal(rule, ANGLE_SD, *ranges[name])
        for name, rule in ANGLE.items()
    }


def of_heart(number: int, quick: bool) -> Case:
    """One heart by every way."""
    one = measured.heart(SEED + number)
    found: Case = {"truth": one.truth, "sd": one.sd, "ways": {}}
    for loaded in (True, False) if number < AT_REST else (True,):
        scene = imaged(one.mesh, loaded=loaded)
        began = perf_counter()
        with tempfile.TemporaryDirectory() as folder:
            emulator = em.train(scene, plan_of(loaded, quick), folder)
        found["unloading" if loaded else "at rest"] = {"seconds": perf_counter() - began}
        for way, (by_unloading, unknown) in WAYS.items():
            if by_unloading == loaded and (unknown or number < KNOWN):
                certified = number < CERTIFIED and way == "unloaded" and not quick
                found["ways"][way] = posterior(
                    one, scene, emulator.cache(), unknown, quick, certified=certified
                )
        jax.clear_caches()
    return found


def posterior(
    one: measured.Case,
    scene: em.Scene,
    forward: Any,
    unknown: bool,
    quick: bool,
    *,
    certified: bool,
) -> Case:
    """What is inferred by one way: 90 % intervals, and whether they hold the truth."""
    began = perf_counter()
    observe = one.observed(scene)
    noise = {name: cal.GaussianNoise(one.sd[name]) for name in observe}
    data = {name: one.data[name] for name in observe}
    # Data that no shape fits are one of the answers: their size is not refused.
    model = cal.model(
        forward,
        observe,
        noise,
        prior_of(scene) if unknown else None,
        known=None if unknown else ANGLE,
        check_scale=False,
    )
    draws = _QUICK_DRAWS if quick else _DRAWS
    options = cal.samplers.NUTSOptions(warmup=draws, draws=draws, rounds=1 if quick else 2)
    found = cal.sample(model, data, options=options, seed=SEED, predictions=False)
    values = _quantities(found, scene, observe["volume:filling.endocardium"])
    frame = found.predict({}, observe["volume:filling.endocardium"])
    case: Case = {
        "intervals": {
            name: {
                "mean": float(v.mean()),
                "sd": float(v.std()),
                "90": np.quantile(v, (0.05, 0.95)).tolist(),
            }
            for name, v in values.items()
        },
        "frame_off_sd": float(
            (frame.mean() - data["volume:filling.endocardium"]) / measured.VOLUME_SD
        ),
        "r_hat": max(row["r_hat"] for row in found.summary().values()),
        "divergences": found.divergences,
        "seconds": perf_counter() - began,
    }
    if certified:
        began = perf_counter()
        told = cal.certify(found, em.Simulator(scene), draws=_FEM, at_most=_MOST, mesh=0, seed=SEED)
        case["certificate"] = {
            "verdict": told.verdict,
            "reason": told.reason,
            "runs": told.evidence.physics.runs,
            "seconds": perf_counter() - began,
        }
    return case


def _quantities(found: cal.Posterior, scene: em.Scene, volume: cal.CavityVolume) -> dict[str, Any]:
    """What is asked of a heart, a number a draw."""
    theta = dict(zip(scene.parameter_names, np.asarray(found.thetas()).T, strict=True))
    values = {
        "stiffness": fibre_stress(*(theta[n] for n in ("a", "b", "a_f", "b_f"))),
        "tension": theta["tension"],
        "unloaded volume": found.predict({"pressure": 0.0}, volume),
        "endo": theta["endo"],
        "epi": theta["epi"],
    }
    if "imaged" in theta:
        values["pressure in the image"] = theta["imaged"] / em.loads.KPA_PER_MMHG
    return values


def summary(cases: list[Case]) -> Case:
    """By way and quantity: hearts whose 90 % interval holds the truth, and the bias."""
    found: Case = {}
    for way in WAYS:
        tried = [case for case in cases if way in case["ways"]]
        for name in tried[0]["ways"][way]["intervals"] if tried else ():
            rows = [(case["ways"][way]["intervals"][name], _true(case, name)) for case in tried]
            if rows[0][0]["sd"] == 0.0:  # known
                continue
            inside = [row["90"][0] <= true <= row["90"][1] for row, true in rows]
            off = np.array([row["mean"] / true - 1.0 for row, true in rows])
            found.setdefault(way, {})[name] = {
                "inside": int(sum(inside)),
                "hearts": len(rows),
                "median_bias_percent": float(100.0 * np.median(off)),
                "median_sd_percent": float(
                    100.0 * np.median([row["sd"] / abs(true) for row, true in rows])
                ),
            }
    return found


def _true(case: Case, name: str) -> float:
    truth = case["truth"]
    if name == "pressure in the image":
        return truth["imaged"] / em.loads.KPA_PER_MMHG
    return truth[{"unloaded volume": "unloaded"}.get(name, name)]


def main() -> None:
    """Run the study."""
    arguments = parser(__doc__, HERE)
    arguments.add_argument("--only", nargs="*", type=int, help="numbers of hearts")
    words = arguments.parse_args()
    results = Results(words.out, SEED, again=words.again, settings={"quick": words.quick})
    chosen = words.only or range(1 if words.quick else HEARTS)
    for number in chosen:
        results.case(f"heart {number}", lambda number=number: of_heart(number, words.quick))
    told = summary(results.cases)
    results.write(summary=told)
    truth = {name: [_true(case, name) for case in results.cases] for name in LABELS}
    draw(results.cases, told, truth, words.out / "imaged_heart.png")
    if not words.quick and len(results.cases) == HEARTS:
        for name in ("stiffness", "tension", "pressure in the image", "unloaded volume"):
            assert told["unloaded"][name]["inside"] >= 17, (name, told["unloaded"][name])


if __name__ == "__main__":
    main()
