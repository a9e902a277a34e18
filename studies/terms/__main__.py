"""Twenty twins of two to four terms out of twelve: are the true ones found?

    python -m studies.terms                     # four minutes
    python -m studies.terms --quick --out DIR

Each twin has three biaxial tests and three shears with independent errors of 2 % of the stresses'
root mean square. The same twins again: with errors of 10 %, and with the biaxial tests alone.
Writes results.json and terms.png.
"""

from pathlib import Path
from typing import Any

import jax
import numpy as np
from studies.common.figures import BLUE, VERMILION, pyplot
from studies.common.output import Case, Results, parser, save

import calibrate as cal
import emulator as em

HERE = Path(__file__).parent
TERMS = em.find_law("invariant_terms").parameters[:-1]  # the last one is kappa
SEED = 11
TWINS, POINTS = 20, 8
LEAST_SHARE = 0.3  # of a term's part of the stresses, of the largest part
SETTINGS = {
    "all tests, 2 %": (0.02, True),
    "all tests, 10 %": (0.1, True),
    "biaxial alone, 2 %": (0.02, False),
}


def model_of(shears: bool) -> cal.Model:
    """Biaxial tests, and shears where asked."""
    pull, rest = np.linspace(1.02, 1.2, POINTS), np.ones(POINTS)
    half, amount, none = 0.5 + 0.5 * pull, np.linspace(0.05, 0.4, POINTS), np.zeros(POINTS)
    tests = {"equal": (pull, pull, none, none, none), "x twice": (pull, half, none, none, none),
             "y twice": (half, pull, none, none, none)}  # fmt: skip
    if shears:
        tests |= {"xy": (rest, rest, amount, none, none), "yx": (rest, rest, none, amount, none),
                  "xz": (rest, rest, none, none, amount)}  # fmt: skip
    names = ("stretch_x", "stretch_y", "shear_xy", "shear_yx", "shear_xz")
    columns = {
        name: np.concatenate([test[k] for test in tests.values()]) for k, name in enumerate(names)
    }
    scene = em.specimen(
        em.specimens.states(columns, [name for name in tests for _ in range(POINTS)]),
        law=em.find_law("invariant_terms"), constants={"kappa": 1000.0},
        parameters=tuple(em.Parameter(name, "kPa", 0.0, 50.0) for name in TERMS),
        fibres=[1.0, 0.0, 0.0], sheets=[0.0, 1.0, 0.0],
    )  # fmt: skip
    components = "cauchy_x,cauchy_y" + (",cauchy_xy,cauchy_xz" if shears else "")
    observe = cal.stresses(scene, components)
    forward = em.homogeneous(scene, incompressible=True)
    return cal.model(forward, {"stress": observe}, {"stress": cal.GaussianNoise(0.1)})


def examine(model: cal.Model, number: int, error: float) -> Case:
    """One twin: its terms, and the probability of each."""
    rng = np.random.default_rng([SEED, number])
    observe, forward = model.observe.parts["stress"], model.forward
    exact = jax.jit(lambda theta: observe(forward(theta), theta))
    columns = np.stack([np.ravel(exact(row)) for row in np.eye(len(TERMS))])
    sizes = np.sqrt(np.mean(columns**2, axis=1))
    sizes = np.where(sizes > 1e-9 * sizes.max(), sizes, 0.0)  # biaxial tests show no shear
    chosen = rng.choice(len(TERMS), rng.integers(2, 5), replace=False)
    moduli = np.zeros(len(TERMS))
    shares = rng.uniform(LEAST_SHARE, 1.0, len(chosen))
    moduli[chosen] = 5.0 * shares / np.where(sizes > 0.0, sizes, np.inf)[chosen]
    clean = np.asarray(exact(moduli))
    noise = error * np.sqrt(np.mean(clean**2)) * rng.normal(size=clean.shape)
    found = cal.analysis.find_terms(model, clean + noise, held_out=False)
    seen = [TERMS[k] for k in chosen if moduli[k] > 0.0]
    return {
        "true": seen,
        "unseen": [TERMS[k] for k in range(len(TERMS)) if sizes[k] == 0.0],
        "probabilities": dict(found.probabilities),
        "noise_ratio": found.noise * 0.1 / (error * float(np.sqrt(np.mean(clean**2)))),
    }


def split(cases: list[Case]) -> tuple[np.ndarray, np.ndarray]:
    """Probabilities of true terms, and of false ones that the data can show."""
    true = [c["probabilities"][n] for c in cases for n in c["true"]]
    false = [
        p for c in cases for n, p in c["probabilities"].items()
        if n not in c["true"] and n not in c["unseen"]
    ]  # fmt: skip
    return np.array(true), np.array(false)


def summary(cases: list[Case]) -> dict[str, Any]:
    """By setting: how many true terms are above a half, and how large false ones are."""
    out = {}
    for setting in SETTINGS:
        own = [case for case in cases if case["name"].startswith(setting)]
        if own:
            true, false = split(own)
            both = np.concatenate([true, false])
            out[setting] = {
                "twins": len(own), "true": len(true), "found": int((true > 0.5).sum()),
                "false": len(false), "false_above_half": int((false > 0.5).sum()),
                "mean_false": float(false.mean()),
                "false_above_5_percent": int((false > 0.05).sum()),
                "undecided": int(((both > 0.05) & (both < 0.95)).sum()),
            }  # fmt: skip
    return out


def draw(cases: list[Case], path: Path) -> None:
    """Probabilities of true and of false terms, a row a setting."""
    figure, axes = pyplot().subplots(figsize=(7.0, 2.8), layout="constrained")
    shown = [s for s in SETTINGS if any(case["name"].startswith(s) for case in cases)]
    rng = np.random.default_rng(0)
    for row, setting in enumerate(shown):
        for values, colour, up in zip(
            split([c for c in cases if c["name"].startswith(setting)]), (BLUE, VERMILION), (1, -1),
            strict=True,
        ):  # fmt: skip
            y = row + up * rng.uniform(0.08, 0.32, len(values))
            axes.plot(values, y, ".", color=colour, alpha=0.6)
    axes.plot([], [], ".", color=BLUE, label="true")
    axes.plot([], [], ".", color=VERMILION, label="false")
    axes.set(yticks=range(len(shown)), yticklabels=shown, xlabel="probability of a term")
    axes.legend(frameon=False, loc="center")
    save(figure, path)


def main() -> None:
    """Run the study."""
    arguments = parser(__doc__, HERE).parse_args()
    twins = 2 if arguments.quick else TWINS
    results = Results(
        arguments.out, SEED, again=arguments.again, settings={"quick": arguments.quick}
    )
    models = {shears: model_of(shears) for shears in (True, False)}
    for setting, (error, shears) in SETTINGS.items():
        for number in range(twins):
            results.case(
                f"{setting}: {number}",
                lambda n=number, e=error, s=shears: examine(models[s], n, e),
            )
    found = summary(results.cases)
    results.write(summary=found)
    for setting, row in found.items():
        print(setting, row)
    draw(results.cases, arguments.out / "terms.png")
    clear = found["all tests, 2 %"]
    assert clear["found"] >= 0.9 * clear["true"]
    assert clear["mean_false"] < 0.05


if __name__ == "__main__":
    main()
