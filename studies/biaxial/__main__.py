"""Biaxial specimens between hooks: what does "homogeneous" do to a posterior?

    python -m studies.biaxial                    # an hour and a half on two cores
    python -m studies.biaxial --quick --out DIR

Twins are FEM's of an arterial wall in three biaxial tests, between five hooks an edge; stretches
are those between marks. Of pieces of 4.5, 7 and 10 mm: how far the homogeneous posterior's means
are from those of the gripped piece, what the certificate's row says of it, and how often 90 %
intervals cover the truth. Writes results.json and biaxial.png.
"""

from functools import lru_cache
from itertools import chain
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from studies.common.figures import BLUE, ORANGE, pyplot
from studies.common.output import Case, Results, parser, save

import calibrate as cal
import emulator as em

HERE = Path(__file__).parent
SEED = 5
SIZES = (4.5, 7.0, 10.0)  # mm
THICKNESS, MARKS, HOOKS = 0.8, 2.0, 5
STRETCHES = np.array([1.04, 1.08, 1.12, 1.16])
RANGES = {"c": (4.0, 25.0), "k_1": (4.0, 25.0), "k_2": (1.0, 10.0)}
CONSTANTS = {"angle": 35.0, "kappa": 1000.0}
NOISE = 0.3  # kPa
RUNS = 60  # from which it is learned what grips do
OF_ROW, OF_COVERAGE = 10, 100  # twins of a size, and of the middle one
LEVEL = 0.9
LIMIT = 0.5  # posterior sd, beyond which the certificate refuses


def scene_of(
    size: float, learned: em.specimens.GripStresses | None = None
) -> em.specimens.Specimen:
    """The specimen: three tests, to equal strains and to half as much along one axis."""
    half, count = 1.0 + 0.5 * (STRETCHES - 1.0), len(STRETCHES)
    columns = {
        "stretch_x": np.concatenate([STRETCHES, STRETCHES, half]),
        "stretch_y": np.concatenate([STRETCHES, half, STRETCHES]),
    }
    names = [name for name in ("equal", "x twice", "y twice") for _ in range(count)]
    law = em.find_law("holzapfel_gasser_ogden")
    units = {quantity.name: quantity.unit for quantity in law.quantities}
    return em.specimen(
        em.specimens.states(columns, names), name=f"wall of {size:g} mm",
        law=law, constants=CONSTANTS,
        parameters=tuple(em.Parameter(n, units[n], *r, "log") for n, r in RANGES.items()),
        fibres=[1.0, 0.0, 0.0], sheets=[0.0, 1.0, 0.0],
        grips=em.specimens.Grips(
            (size, size, THICKNESS), "hooks", HOOKS, marks=MARKS, learned=learned
        ),
    )  # fmt: skip


@lru_cache
def gripped(size: float) -> em.specimens.GrippedSpecimen:
    """FEM of the piece."""
    return em.specimens.GrippedSpecimen(scene_of(size))


@lru_cache
def learned(size: float, runs: int) -> em.specimens.GripStresses:
    """What its grips do."""
    return em.specimens.learn_grips(gripped(size).specimen, runs, seed=SEED, progress=True)


def model_of(scene: em.specimens.Specimen) -> cal.Model:
    """Independent errors of the stresses along x and y; stresses of homogeneous states, or more."""
    observe = cal.stresses(scene, "stress_x,stress_y")
    return cal.model(
        em.homogeneous(scene), {"stress": observe}, {"stress": cal.GaussianNoise(NOISE)}
    )


def twin(size: float, theta: jnp.ndarray, seed: int) -> dict[str, np.ndarray]:
    """Data: FEM of the gripped piece, every state solved, and noise."""
    of = gripped(size)
    P = of.stresses(theta)[:, [0, 1], [0, 1]]
    return {"stress": P + NOISE * np.random.default_rng([SEED, seed]).normal(size=P.shape)}


def sampled(scene: em.specimens.Specimen, data: dict[str, np.ndarray]) -> cal.Posterior:
    """The posterior by the default sampler."""
    return cal.sample(model_of(scene), data, seed=SEED, predictions=False)


def moments(posterior: cal.Posterior) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean, sd and the 90 % interval (2, p) of each unknown, on the scale of its prior."""
    draws = np.log(np.stack([posterior.draws()[name].ravel() for name in RANGES]))
    ends = np.quantile(draws, [0.5 - LEVEL / 2.0, 0.5 + LEVEL / 2.0], axis=1)
    return draws.mean(axis=1), draws.std(axis=1), ends


def in_units(posterior: cal.Posterior) -> tuple[np.ndarray, np.ndarray]:
    """Mean and sd of each unknown in its unit, as the certificate has them."""
    draws = np.stack([posterior.draws()[name].ravel() for name in RANGES])
    return draws.mean(axis=1), draws.std(axis=1)


def of_row(size: float, number: int, runs: int) -> Case:
    """The shift that the certificate's row predicts, and the one of the gripped posterior."""
    theta = em.fem.sobol(gripped(size).specimen, 64, SEED)[number]
    data = twin(size, theta, number)
    plain = sampled(gripped(size).specimen, data)
    certificate = cal.certify(plain, em.homogeneous(gripped(size).specimen), seed=SEED)
    true = sampled(scene_of(size, learned(size, runs)), data)
    (mean, sd), (gripped_mean, _) = in_units(plain), in_units(true)
    row = certificate.evidence.mesh
    return {
        "size": size,
        "verdict": certificate.verdict,
        "predicted": {name: figure.value for name, figure in row.shift.items()},
        "error": {name: figure.error for name, figure in row.shift.items()},
        "solves": row.runs,
        "true": dict(zip(RANGES, ((gripped_mean - mean) / sd).tolist(), strict=True)),
    }


def of_coverage(size: float, number: int, runs: int) -> Case:
    """Whether the intervals of both posteriors have the truth, and how far their means are off."""
    rng = np.random.default_rng([SEED, 1, number])
    scene = gripped(size).specimen
    theta = scene.from_unit(jnp.asarray(rng.random(len(RANGES))))
    data, truth = twin(size, theta, 1000 + number), np.log(np.asarray(theta))
    found: Case = {"size": size}
    for name, of in (("homogeneous", scene), ("gripped", scene_of(size, learned(size, runs)))):
        mean, sd, (low, high) = moments(sampled(of, data))
        found[name] = {
            "covered": ((low <= truth) & (truth <= high)).tolist(),
            "z": ((mean - truth) / sd).tolist(),
        }
    return found


def summary(cases: list[Case]) -> dict[str, Any]:
    """Shifts by size, the row's errors, and coverage."""
    rows = [case for case in cases if "predicted" in case]
    covered = [case for case in cases if "gripped" in case]
    out: dict[str, Any] = {}
    for size in dict.fromkeys(case["size"] for case in rows):
        own = [case for case in rows if case["size"] == size]
        largest = [max(abs(v) for v in case["true"].values()) for case in own]
        out[f"{size:g} mm"] = {
            "twins": len(own),
            "median_largest_shift": float(np.median(largest)),
            "greatest": max(largest),
            "accepted": sum(case["verdict"] == "accepted" for case in own),
        }
    if rows:
        off = [case["predicted"][n] - case["true"][n] for case in rows for n in case["predicted"]]
        out["row_rms_error"] = float(np.sqrt(np.mean(np.square(off))))
        accepted = [case for case in rows if case["verdict"] == "accepted"]
        beyond = (abs(v) for case in accepted for v in case["true"].values())
        out["largest_shift_of_accepted"] = max(beyond, default=0.0)
    for name in ("homogeneous", "gripped") if covered else ():
        every = np.array([case[name]["covered"] for case in covered])
        out[f"coverage_{name}"] = {"all": float(every.mean()), "twins": len(every)}
        out[f"coverage_{name}"] |= dict(zip(RANGES, every.mean(axis=0).tolist(), strict=True))
    return out


def draw(cases: list[Case], path: Path) -> None:
    """Predicted against true shifts, and shifts against size."""
    rows = [case for case in cases if "predicted" in case]
    figure, axes = pyplot().subplots(1, 2, figsize=(8.4, 3.8), layout="constrained")
    for k, (name, mark) in enumerate(zip(RANGES, "os^", strict=True)):
        known = [case for case in rows if name in case["predicted"]]
        true, predicted = ([case[key][name] for case in known] for key in ("true", "predicted"))
        errors = [2.0 * case["error"][name] for case in known]
        axes[0].errorbar(true, predicted, errors, fmt=mark, ms=4, color=f"C{k}", label=name, lw=0.8)
        axes[1].plot(
            [case["size"] for case in rows], [case["true"][name] for case in rows], mark, ms=4,
            color=f"C{k}", mfc="none",
        )  # fmt: skip
    ends = [*axes[0].get_xlim(), *axes[0].get_ylim()]
    axes[0].plot([min(ends), max(ends)], [min(ends), max(ends)], color="0.6", lw=0.8, zorder=0)
    axes[0].set(xlabel="shift of a mean by the gripped posterior (sd)",
                ylabel="shift by the certificate's row (sd)")  # fmt: skip
    axes[0].legend(frameon=False)
    for sign in (-LIMIT, LIMIT):
        axes[1].axhline(sign, color=ORANGE, lw=0.8)
    axes[1].axhline(0.0, color=BLUE, lw=0.6)
    axes[1].set(xlabel="length between the hooks (mm)", ylabel="shift of a mean (sd)", xticks=SIZES)
    save(figure, path)


def check(results: dict[str, Any]) -> None:
    """The README's claims."""
    assert results.get("largest_shift_of_accepted", 0.0) < LIMIT
    if "coverage_gripped" in results and results["coverage_gripped"]["twins"] >= OF_COVERAGE:
        assert 0.85 <= results["coverage_gripped"]["all"] <= 0.95


def main() -> None:
    """Run the study."""
    words = parser(__doc__, HERE)
    words.add_argument("--sizes", nargs="+", type=float, default=SIZES, help="mm")
    words.add_argument("--only", choices=("row", "coverage"), help="one of the two questions")
    arguments = words.parse_args()
    quick = arguments.quick
    results = Results(arguments.out, SEED, again=arguments.again, settings={"quick": quick})
    runs, counts = (12, (1, 2)) if quick else (RUNS, (OF_ROW, OF_COVERAGE))
    sizes = SIZES[1:2] if quick else arguments.sizes
    of_rows = ((f"row {size:g} {k}", of_row, size, k) for size in sizes for k in range(counts[0]))
    of_covers = (
        (f"coverage {k}", of_coverage, SIZES[1], k) for k in range(counts[1]) if SIZES[1] in sizes
    )
    for name, make, size, k in chain(of_covers, of_rows):
        if arguments.only and not name.startswith(arguments.only):
            continue
        results.case(name, lambda make=make, size=size, k=k: make(size, k, runs))
    found = summary(results.cases)
    results.write(summary=found)
    for name, value in found.items():
        print(name, value)
    draw(results.cases, arguments.out / "biaxial.png")
    check(found)


if __name__ == "__main__":
    main()
