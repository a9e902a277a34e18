"""Any ventricle, at once: what does a network know of one it has never seen?

    python -m studies.any_ventricle                                # unseen ones, judged by FEM
    python -m studies.any_ventricle --sweeps 20                    # and sweeps that start there
    python -m studies.any_ventricle --posteriors 7                 # and posteriors, certified ones
    python -m studies.any_ventricle --curve --runs DIR             # error against bodies learned
    python -m studies.any_ventricle --train --runs DIR --out DIR   # how the network was trained
    python -m studies.any_ventricle --quick --out DIR

Twenty ellipsoids, twenty irregular ventricles, four more on a coarser, a finer and a Gmsh mesh, and
the measured heart's left ventricle at two times, meshed by Gmsh. Writes results.json, after each
case, and any_ventricle.png; cases that are there are kept. The heart is left out where its surfaces
or Gmsh are absent.
"""

from __future__ import annotations

import argparse
import tempfile
from functools import partial
from pathlib import Path

import numpy as np
from studies.any_ventricle.bodies import test_bodies
from studies.any_ventricle.figures import draw
from studies.any_ventricle.judge import one, swept
from studies.any_ventricle.posteriors import first_posterior
from studies.any_ventricle.runs import GROUPS, RUNS_A_BODY, body_runs
from studies.common.output import Case, Results, hardware, parser, versions

import emulator as em

HERE = Path(__file__).parent
SEED, TESTS = 0, 5
MEMBERS = 2
# The first five of each group are kept to watch the training.
LEARNED = {
    "ordinary": [*range(5, 571), *range(572, 605, 2)],
    "thin": [*range(5, 64), *range(64, 357, 2)],
}
CURVE, CURVE_STEPS, CURVE_WATCHED = (75, 150, 300, 575), 3000, 30
SERIES, REDUCED = 6, 2  # ellipsoids and irregular ones judged by one run and by twenty, too


def train(given: argparse.Namespace) -> None:
    """Train the networks, one seed each, and write them as one emulator under --out.

    They may be trained side by side by ``--member``, and then be put together by ``--resume``.
    """
    runs = [
        each
        for group, numbers in LEARNED.items()
        for each in body_runs(given.runs, group, numbers, progress=True)
    ]
    home, digest = em.scenes.left_ventricle(), em.families.digest_of(runs)
    family = em.families.family_of(runs, GROUPS["ordinary"].bodies()[0].scene())
    trained = []
    for seed in range(MEMBERS) if given.member is None else (given.member,):
        plan = em.families.FamilyPlan(steps=given.steps, seed=seed)
        folder = given.out / f"member_{seed}"
        resume = given.resume and folder.is_dir()
        trained.append(
            em.families.train_family(
                family, digest, plan, folder, home, progress=True, resume=resume
            )
        )
    if given.member is not None:
        return
    record = {
        **trained[-1].record,
        "seconds": sum(member.record["seconds"] for member in trained),
        "command": "python -m studies.any_ventricle --train --runs DIR --out DIR",
        "fem_runs": len(runs) * RUNS_A_BODY,
        "hardware": hardware(),
        "versions": versions(),
    }
    em.save_emulator(em.families.ensemble(trained, record), given.out / "ventricle_family")


def learned_from(count: int, given: argparse.Namespace) -> Case:
    """What a network that has learned ``count`` bodies leaves on others, at equal steps."""
    numbers = range(CURVE_WATCHED, CURVE_WATCHED + count)
    runs = body_runs(given.runs, "ordinary", numbers, progress=True)
    watched = body_runs(given.runs, "ordinary", range(CURVE_WATCHED))
    family = em.families.family_of(runs, GROUPS["ordinary"].bodies()[0].scene())
    plan, home = em.families.FamilyPlan(steps=CURVE_STEPS), em.scenes.left_ventricle()
    with tempfile.TemporaryDirectory() as folder:
        trained = em.families.train_family(family, "", plan, folder, home, progress=True)
    errors = [em.families.median_error(trained, each) for each in watched]
    return {"bodies": count, "steps": CURVE_STEPS, "err_u_mm": float(np.median(errors))}


def main() -> None:
    """Train, or run the study."""
    arguments = parser(__doc__, HERE)
    arguments.add_argument("--train", action="store_true", help="solve the family and train on it")
    arguments.add_argument("--curve", action="store_true", help="train on parts of the family")
    arguments.add_argument("--runs", type=Path, help="folder of the FEM runs to train on")
    arguments.add_argument("--steps", type=int, default=em.families.FamilyPlan.steps)
    arguments.add_argument("--member", type=int, help="train this one of the networks alone")
    arguments.add_argument("--resume", action="store_true", help="go on from the checkpoint")
    arguments.add_argument("--sweeps", type=int, default=0, help="bodies to sweep from the network")
    arguments.add_argument("--posteriors", type=int, default=0, help="bodies to calibrate")
    arguments.add_argument("--fem", type=Path, help="folder that keeps FEM's part of the cases")
    given = arguments.parse_args()
    if (given.train or given.curve) and given.runs is None:
        arguments.error("--train and --curve want --runs, the folder of the FEM runs")
    if given.train:
        train(given)
        return
    tests = 2 if given.quick else TESTS
    settings = {"tests": tests, "quick": given.quick}
    results = Results(given.out, SEED, again=given.again, settings=settings)
    for count in CURVE if given.curve else ():
        results.case(f"learned from {count} bodies", partial(learned_from, count, given))
    made = test_bodies(1 if given.quick else 20)
    with tempfile.TemporaryDirectory() as folder:
        kept = given.fem or Path(folder)
        for number, (name, make) in enumerate(made.items()):
            kind, *which = name.split()
            first = int(which[0]) if kind in ("ellipsoid", "irregular") else SERIES
            more = first < SERIES and not given.quick, first < REDUCED and not given.quick
            case = partial(one, make, number, tests, more, kept / f"{name}.safetensors")
            if not given.quick or number == 0:
                results.case(name, case)
        irregular = [name for name in made if name.startswith("irregular")]
        for way, count, judge in (
            ("posterior", given.posteriors, first_posterior),
            ("sweeps", given.sweeps, swept),
        ):
            for name in irregular[:count]:
                place = kept / f"{name}.safetensors"
                case = partial(judge, made[name], list(made).index(name), tests, place)
                results.case(f"{way}, {name}", case)
    draw(results.cases, given.out / "any_ventricle.png")


if __name__ == "__main__":
    main()
