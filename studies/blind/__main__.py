"""What do laws say beyond the data they have seen, and how often are their bands right?

    python -m studies.blind --data DIR             # DIR as ../shared/measured; an hour of two cores
    python -m studies.blind --data DIR --quick --out OUT
    python -m studies.blind --judge DIR            # DIR has what was kept apart, laid out as --data

The first part of each curve of real tests is given to three laws, by the commands that a user
takes, and the rest is predicted. ``--judge`` runs that of every study of real data that wrote bands
before anybody saw the rest, and prints all.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from functools import partial
from pathlib import Path

import numpy as np
from studies.common.figures import BLUE, ORANGE, pyplot
from studies.common.output import Case, Results, parser, run, save
from studies.common.pieces import SETS, Piece
from studies.common.processes import calibrate

import emulator as em

HERE = Path(__file__).parent
SEED = 84
SHARES = {"two thirds": 2.0 / 3.0, "half": 0.5}
WAYS = ("stacking", "equal")
MISS = 0.1  # of the mass outside of a band
QUANTILE = 1.645  # sds from the middle of a normal band of 90 % to its end
# Studies whose bands were written before anybody saw the rest, and the folder of their data.
JUDGES = {
    "silicone_beam": "silicone_beam",
    "sheep_myocardium": "ovine_myocardium",
    "blood_clots": "blood_clots",
    "living_skin": "living_skin",
    "human_heart": "human_heart",
    "human_myocardium": "myocardium_tables",
    "muscle": "muscle",
}


def fold(piece: Piece, share: float) -> Case:
    """What was said of the states beyond ``share`` of each test's motion, and what is inside."""
    seen, ratio = piece.reached(share)
    names = [name.split()[0] for name in piece.stresses]
    with tempfile.TemporaryDirectory() as place:
        folder, noise, evidence = Path(place), {}, {}
        piece.write(folder / "seen.csv", seen)
        piece.write(folder / "all.csv", np.ones(len(seen), bool))
        for law in piece.laws:
            calibrate(folder, "init", "seen.csv", "--law", law, "--out", f"{law}.toml")
            words = ("--no-certify", "--seed", str(SEED), "--out", law)
            told = calibrate(folder, "infer", f"{law}.toml", *words)
            sds = [row["mean"] for n, row in told["parameters"].items() if n.endswith("_sd")]
            noise[law], evidence[law] = float(np.linalg.norm(sds)), told.get("log_evidence")
        known = [law for law in piece.laws if evidence[law] is not None] or piece.laws
        best = max(known, key=lambda law: evidence[law] or 0.0)
        scene = (folder / f"{piece.laws[0]}_scene.toml").read_text().replace("seen.csv", "all.csv")
        (folder / "all.toml").write_text(scene)
        asked = ("--scene", "all.toml", "--observe", f"stress:{','.join(names)}", "--draws", "1000")
        told = {
            way: calibrate(folder, "predict", *piece.laws, *asked, "--weights", way) for way in WAYS
        }
    measured, held = piece.measured, ~seen[:, None] & np.isfinite(piece.measured)
    scale = float(np.abs(measured[held]).mean())
    bands: dict[str, Case] = {}
    for way, of in told.items():
        bands[way] = judged(of["numbers"], "", measured, held, noise[best], scale)
        bands[f"{way}, outer"] = judged(of["numbers"], "outer_", measured, held, noise[best], scale)
    bands["likeliest law"] = judged(
        told["equal"]["by_law"][best], "", measured, held, noise[best], scale
    )
    last, line = simple(piece, seen)
    points = {"last value stays": last, "straight on": line}
    return {
        "status": "done",
        "group": piece.group,
        "laws": told["stacking"]["laws"],
        "likeliest": best,
        "log_evidence": evidence,
        "ratio": np.broadcast_to(ratio[:, None], held.shape)[held].tolist(),
        "bands": bands,
        "scores_of_points": {
            name: float(np.mean(2.0 / MISS * np.abs(y - measured)[held]) / scale)
            for name, y in points.items()
        },
    }


def judged(
    numbers: dict[str, dict[str, float]],
    kind: str,
    measured: np.ndarray,
    held: np.ndarray,
    noise: float,
    scale: float,
) -> Case:
    """Which held points are in a band, and its interval score over the mean stress ``scale``.

    numbers : the prediction's, in the order of ``measured`` (m, c). kind : before low and high.
    noise : the sd of measured points about the law, which is added to the band.
    """
    rows = list(numbers.values())
    median = np.array([row["median"] for row in rows]).reshape(measured.shape)
    ends = []
    for end, side in (("low", -1.0), ("high", 1.0)):
        values = np.array([row[f"{kind}{end}"] for row in rows]).reshape(measured.shape)
        ends.append(median + side * np.hypot(values - median, QUANTILE * noise))
    low, high = (end[held] for end in ends)
    y = measured[held]
    outside = np.maximum(low - y, 0.0) + np.maximum(y - high, 0.0)
    return {
        "inside": ((low <= y) & (y <= high)).tolist(),
        "score": float(np.mean(high - low + 2.0 / MISS * outside) / scale),
    }


def simple(piece: Piece, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Stresses (m, c) that stay at the last one seen, and that go straight on from rest to it."""
    last, line = np.array(piece.measured), np.array(piece.measured)
    tests, motion = np.array(piece.tests), np.array(piece.motions)
    for test in dict.fromkeys(piece.tests):
        rows = np.flatnonzero(tests == test)
        end = rows[seen[rows]][np.argmax(motion[rows[seen[rows]]])]
        last[rows] = piece.measured[end]
        line[rows] = piece.measured[end] * (motion[rows] / motion[end])[:, None]
    return last, line


def conclude(cases: list[Case]) -> Case:
    """Coverage by band and distance, and scores by set."""
    summary: Case = {"inside": {}, "scores": {}}
    for band in cases[0]["bands"]:
        parts: dict[str, list[bool]] = {"up to 1.5": [], "up to twice": []}
        for case in cases:
            for ratio, hit in zip(case["ratio"], case["bands"][band]["inside"], strict=True):
                parts["up to 1.5" if ratio <= 1.5 + 1e-6 else "up to twice"].append(hit)
        summary["inside"][band] = {n: [int(np.sum(hits)), len(hits)] for n, hits in parts.items()}
    for group in dict.fromkeys(case["group"] for case in cases):
        own = [case for case in cases if case["group"] == group]
        scores = {b: np.mean([case["bands"][b]["score"] for case in own]) for b in own[0]["bands"]}
        for name in own[0]["scores_of_points"]:
            scores[name] = np.mean([case["scores_of_points"][name] for case in own])
        summary["scores"][group] = {name: round(float(score), 3) for name, score in scores.items()}
    return summary


def draw(summary: Case, path: Path) -> None:
    """Shares inside of each band, by distance."""
    figure, axis = pyplot().subplots(figsize=(7.0, 3.0), layout="constrained")
    bands = list(summary["inside"])
    for k, (part, colour) in enumerate((("up to 1.5", BLUE), ("up to twice", ORANGE))):
        counts = [summary["inside"][band][part] for band in bands]
        shares = [inside / max(points, 1) for inside, points in counts]
        axis.barh(np.arange(len(bands)) + 0.4 * k, shares, 0.4, color=colour, label=part)
    axis.axvline(0.9, color="0.3", ls="--", lw=1)
    axis.set_yticks(np.arange(len(bands)) + 0.2, bands)
    axis.set(xlabel="share of held points inside of a 90 % band", xlim=(0.0, 1.0))
    axis.invert_yaxis()
    axis.legend(
        frameon=False, title="motion over the data's", loc="upper left", bbox_to_anchor=(1.0, 1.0)
    )
    save(figure, path)


def judge(folder: Path) -> None:
    """Print what every study's bands, written before, say of what was kept apart."""
    for name, part in JUDGES.items():
        place = folder / part
        print(f"== {name}", flush=True)
        if not place.is_dir():
            print(f"{place} is not there", flush=True)
            continue
        words = [sys.executable, "-m", f"studies.{name}", "--judge", str(place)]
        done = subprocess.run(words, capture_output=True, text=True, check=False)
        print(done.stdout.rstrip() or done.stderr.strip().splitlines()[-1], flush=True)


def main() -> None:
    """Run the study."""
    words = parser(__doc__, HERE)
    words.add_argument("--data", type=Path, help="folder of the measurements")
    words.add_argument("--judge", type=Path, metavar="DIR", help="folder of what was kept apart")
    arguments = words.parse_args()
    if arguments.judge is not None:
        judge(arguments.judge)
        return
    if arguments.data is None:
        raise em.InputError("give --data DIR, the folder of the measurements")
    results = Results(arguments.out, SEED, again=arguments.again)
    for pieces in SETS[: 1 if arguments.quick else None]:
        for piece in list(pieces(arguments.data))[: 1 if arguments.quick else None]:
            for part, share in list(SHARES.items())[: 1 if arguments.quick else None]:
                name = f"{piece.group}, {piece.name}, {part}"
                results.case(name, partial(fold, piece, share))
    summary = conclude(results.cases)
    results.write(summary=summary)
    draw(summary, arguments.out / "blind.png")
    print(json.dumps(summary, indent=2))


if __name__ == "__main__":
    run(main)
