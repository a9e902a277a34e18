"""Real tissue: what do nine modes say of a heart, and seven hearts of an eighth?

python -m studies.sheep_myocardium --data DIR           # the raw files (README)
python -m studies.sheep_myocardium --data DIR --runs DIR  # FEM's runs are kept, and taken up again
python -m studies.sheep_myocardium --judge DIR          # hearts that were kept apart
"""

from __future__ import annotations

from pathlib import Path
from time import perf_counter

import jax.numpy as jnp
import numpy as np
from studies.common.output import Case, Results, parser, run, table
from studies.sheep_myocardium import cube, figures, population, twins
from studies.sheep_myocardium.campaign import QUICK, Campaign, Plan, of_law
from studies.sheep_myocardium.checked import decided, told
from studies.sheep_myocardium.curves import Fit, cubes
from studies.sheep_myocardium.doubts import doubts, known_to
from studies.sheep_myocardium.experiment import MODES, Heart, heart, hearts
from studies.sheep_myocardium.held_out import Prediction, held_out, replicated, summed
from studies.sheep_myocardium.inference import (
    ANGLE_SD,
    LAWS,
    ORTHOTROPIC,
    Found,
    parameters,
    settled,
)
from studies.sheep_myocardium.solver import finer, without_mesh
from tqdm import tqdm

import emulator as em

HERE = Path(__file__).parent
SEED = 32
_KEPT = 48  # draws of an eighth heart that results.json keeps
_MESHES = 2  # of which are solved on a finer mesh, too
_MADE, _TAIL = 32, 0.05  # what would be measured at each draw; outside either end of a band
_BLOCKS = 8  # of draws, after each of which modes may be decided


def described(found: Found, fitted: Fit, apart: dict[str, Prediction]) -> Case:
    """A posterior in numbers, with the modes held out of it.

    known_to : what log likelihoods are known to at its draws, which FEM's runs need not be at.
    """
    omega = found.draws["omega"]
    case: Case = {
        "parameters": {
            n: {"mean": float(x.mean()), "median": float(np.median(x)), "sd": float(x.std())}
            for n, x in ((n, found.theta(n)) for n in parameters(found.law))
        },
        "omega": {"mean": float(omega.mean()), "sd": float(omega.std())},
        "rhat": found.worst_rhat,
        "ess": found.least_ess,
        "divergences": found.divergences,
        "known_to": float(known_to(doubts(fitted, found)).max()),
        "held_out": summed(apart),
        "R2": _explained(found),
    }
    if found.of.turned:
        degrees = cube.ANGLES[0].high * found.draws["turned"]
        case["angles_deg"] = {
            "mean": degrees.mean(axis=0).round(1).tolist(),
            "sd": degrees.std(axis=0).round(1).tolist(),
        }
    return case


def _explained(found: Found) -> dict[str, float]:
    """R2 of each mode's forces by the posterior's mean forces."""
    force = np.asarray(found.of.data)
    left = ((force - found.draws["means"].mean(axis=0)) ** 2).sum(axis=1)
    total = ((force - force.mean(axis=1, keepdims=True)) ** 2).sum(axis=1)
    return dict(zip(MODES, (1.0 - left / total).round(3).tolist(), strict=True))


def of_heart(found: Campaign, plan: Plan, kept: Path | None) -> Case:
    """Laws, angles known and unknown, held-out modes, FEM's check and the mesh's."""
    began = perf_counter()
    cut = settled(found.heart, found.cubes, SEED, angles=False, steps=plan.steps)
    fitted = found.learned.fitted
    made = {law: of_law(found, law, plan, kept, SEED) for law in LAWS if law != ORTHOTROPIC}
    made |= {ORTHOTROPIC: (found.explored, fitted), "angles known": (cut, fitted)}
    laws: Case = {}
    for law, (each, by) in made.items():
        apart = held_out(each, SEED, None if plan is QUICK else by)
        laws[law] = described(each, by, apart)
        if law == ORTHOTROPIC:
            bands = {mode: p.bands.round(4).tolist() for mode, p in apart.items()}
    return {
        "laws": laws,
        "held_out_bands_N": bands,
        **told(found),
        "mesh_correction": float(np.mean(np.asarray(found.cubes.finer)) - 1.0),
        "seconds": found.seconds + perf_counter() - began,
    }


def of_twins(found: Campaign, plan: Plan) -> Case:
    """Coverage of a heart's twins."""
    return twins.covered(twins.ranks(found, SEED, plan.steps))


def of_population(found: list[Campaign], quick: bool) -> Case:
    """The population, its hearts, and an eighth."""
    size = {"draws": 20, "warmup": 20} if quick else {}
    of = population.sampled(found, SEED, **size)
    draws = of.draws
    new = population.eighth(draws, SEED)
    logs = draws["mean"][:, None] + draws["spread"][:, None] * draws["z"]
    rows = np.linspace(0, len(new) - 1, min(_KEPT, len(new))).astype(int)
    return {
        "names": population.NAMES,
        "median": np.exp(draws["mean"]).mean(axis=0).tolist(),
        "median_90": np.quantile(np.exp(draws["mean"]), (0.05, 0.95), axis=0).tolist(),
        "spread_of_logarithms": draws["spread"].mean(axis=0).tolist(),
        "hearts": {
            each.heart.name: {
                "median": np.median(np.exp(logs[:, k]), axis=0).tolist(),
                "sd_of_logarithm": logs[:, k].std(axis=0).tolist(),
            }
            for k, each in enumerate(found)
        },
        "eighth": new[rows].tolist(),
        "divergences": of.divergences,
        "rhat": of.worst_rhat,
        "ess": of.least_ess,
    }


def judge(results: Results, folder: Path) -> Case:
    """Hearts that were kept apart, beside the 90 % bands of the population's eighth heart."""
    known = next((c for c in results.cases if c["name"] == "population"), None)
    if known is None:
        raise em.InputError("no population in results.json; run the study with --data first")
    draws = np.asarray(known["eighth"])
    rng = np.random.default_rng(SEED)
    cases: Case = {}
    apart = [each for each in hearts(folder) if each.name not in known["hearts"]]
    for each in apart:
        cases[each.name] = _judged(each, draws, rng)
    if not cases:
        raise em.InputError(f"{folder} has no heart that the population was not made of")
    return cases


def _judged(one: Heart, draws: np.ndarray, rng: np.random.Generator) -> Case:
    """Points of each mode inside the 90 % band of what would be measured.

    A point with a twentieth of all that is made below it, and a twentieth above, is inside whatever
    the rest: FEM goes on, block by block of draws, only with modes that have another point.
    """
    inside, omega = {}, np.repeat(draws[:, -1], _MADE)
    enough = int(np.ceil(_TAIL * (len(omega) - 1))) + 1
    for body in cubes(one, sloping=False):
        x = np.asarray([population.positions(jnp.log(row[:-1])) for row in draws])
        turned = np.clip(rng.normal(0.0, ANGLE_SD, (len(draws), 2)), -1.0, 1.0)
        x = np.concatenate([x, turned], axis=1)
        z = rng.normal(size=(3, len(omega), body.amounts.shape[1]))
        curves, made = body.curves, {mode: z[mode][:0] for mode in range(3)}
        open_modes, factors = [*made], np.ones(body.amounts.shape)
        with tqdm(total=len(x), desc=f"{one.name}, cube {body.number + 1}", unit="draw") as bar:
            for rows in np.array_split(np.arange(len(x)), _BLOCKS):
                if not open_modes:
                    break
                forces = body.runs(x[rows], open_modes).force
                if not rows[0]:
                    fine = finer(body).runs(x[:_MESHES]).force
                    factors = without_mesh(forces[:_MESHES], fine).reshape(factors.shape)
                several = np.arange(_MADE * rows[0], _MADE * (rows[-1] + 1))
                parts = np.split(forces, len(open_modes), axis=1)
                for mode, mean in zip(open_modes, parts, strict=True):
                    many = np.repeat(mean * factors[mode], _MADE, axis=0)
                    new = replicated(curves[mode].amount, many, omega[several], z[mode][several])
                    made[mode] = np.concatenate([made[mode], new])
                open_modes = [
                    mode
                    for mode in open_modes
                    if min(_beside(made[mode], curves[mode].force)) < enough
                ]
                bar.update(len(rows))
        for mode, values in made.items():
            low, high = np.nanquantile(values, (_TAIL, 1.0 - _TAIL), axis=0)
            force = curves[mode].force
            within = (low <= force) & (force <= high)
            inside[curves[mode].mode] = int(within.sum()) if mode in open_modes else len(force)
    points = sum(len(c.force) for c in one.curves.values())
    return {"inside": sum(inside.values()), "points": points, "by_mode": inside}


def _beside(made: np.ndarray, force: np.ndarray) -> np.ndarray:
    """How many of ``made`` (d, j) are below each force (j,), and above it, (2 j,)."""
    return np.concatenate([(made <= force).sum(axis=0), (made >= force).sum(axis=0)])


def _told(cases: Case) -> str:
    """The table of :func:`judge`."""
    rows = [
        (name, f"{case['inside']} of {case['points']}", *case["by_mode"].values())
        for name, case in cases.items()
        if isinstance(case, dict)
    ]
    return table(("heart", "inside 90 % bands", *MODES), rows)


def main() -> None:
    arguments = parser(__doc__, HERE)
    arguments.add_argument("--data", type=Path, help="folder of the hearts TSL1, TSL2, ...")
    arguments.add_argument("--runs", type=Path, help="folder in which FEM's runs are kept")
    arguments.add_argument("--only", nargs="+", help="these hearts")
    arguments.add_argument("--judge", type=Path, help="folder of hearts that were kept apart")
    words = arguments.parse_args()
    results = Results(words.out, SEED, again=words.again, settings={"quick": words.quick})
    if words.judge is not None:
        print(_told(results.case("judged", lambda: judge(results, words.judge))))
        return
    if words.data is None:
        arguments.error("give --data DIR, the folder of the hearts (README)")
    plan = QUICK if words.quick else Plan()
    given = [heart(words.data / name) for name in words.only] if words.only else hearts(words.data)
    given = given[:2] if words.quick else given
    campaigns = []
    for each in given:
        found = decided(each, plan, words.runs, SEED)
        campaigns.append(found)
        results.case(each.name, lambda found=found: of_heart(found, plan, words.runs))
        results.case(f"{each.name}, twins", lambda found=found: of_twins(found, plan))
    results.case("population", lambda: of_population(campaigns, words.quick))
    results.write(**_together(results.cases))
    figures.modes(given, results.cases, words.out / "held_out_modes.png")
    figures.overview(results.cases, words.out / "sheep_myocardium.png")


def _together(cases: list[Case]) -> Case:
    """All hearts by law: points inside held-out bands, and the sum of log densities."""
    found: Case = {}
    each = [case for case in cases if "laws" in case]
    for law in each[0]["laws"]:
        apart = [case["laws"][law]["held_out"] for case in each]
        found[law] = {
            "inside": sum(a["inside"] for a in apart) / sum(a["points"] for a in apart),
            "log_density": sum(a["log_density"] for a in apart),
            "inside_by_mode": {
                mode: sum(a["inside_by_mode"][mode] for a in apart) for mode in MODES
            },
        }
    made = [below for case in cases if case["name"].endswith(", twins") for below in case["below"]]
    return {"held_out": found, "twins": {**twins.covered(made), "below": None}}


if __name__ == "__main__":
    run(main)
