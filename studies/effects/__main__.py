"""What each effect changes in displacement, volume and posterior, and what it costs.

    python -m studies.effects
    python -m studies.effects --quick

Three scenes that have every effect (:mod:`studies.effects.scenes`); each effect is left out alone.
FEM on the whole scene makes data; the scene without the effect, through an emulator of its own,
gives a posterior from it. Then ``calibrate effects``'s recommendation on built-in scenes. Writes
results.json after each effect, and effects.png.
"""

from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from studies.common.output import Case, Results, parser, save
from studies.effects.scenes import SCENES, observed, other_choices, points, published

import calibrate as cal
import emulator as em
from calibrate.analysis.effects import Measured, WithoutTerms, recommend
from calibrate.figures import BLUE, GREEN, VERMILION, pyplot
from calibrate.measurements import CavityVolume, Observations, landmarks, spread_landmarks
from calibrate.samplers import NUTSOptions
from emulator.fem import run_campaign
from emulator.fem.campaign.designs import design
from emulator.scenes import Scene
from emulator.scenes.built_in import BUILT_IN
from emulator.scenes.effects import effects_of, leave_out
from emulator.scenes.scene import cavity_sets
from emulator.surrogates.emulator import Emulator
from emulator.surrogates.taylor import expand
from emulator.training.mechanics import add_discrepancy

HERE = Path(__file__).parent
SEED = 3
SAMPLES = 4  # theta of the comparison by FEM
RUNS = 15  # FEM runs of a posterior's emulator, the centre's included
ORDER = 2  # of its series
NOISE = {"displacement": 0.2, "volume": 1.0}  # mm, mL
TRUTH = (0.55, 0.45, 0.5, 0.5, 0.6)  # in the unit box
# Tolerance of a landmark in mm, of a volume in mL, of scenes to recommend for.
ADVISED = {
    "left_ventricle": (0.5, 1.0),
    "traction_beam_holzapfel_ogden": (0.5, 1.0),
    "liver": (0.5, 1.0),
    "sheet": (1.0, 1.0),
}
OPTIONS = NUTSOptions(warmup=300, draws=500, chains=2, rounds=2)


def by_kind(names: Any, values: dict[str, float]) -> dict[str, float]:
    """Values of ``displacement`` and ``volume`` for observations called like them."""
    return {name: values[name.split()[0]] for name in names}


def emulator_of(scene: Scene) -> Emulator:
    """A series about the centre and what FEM runs leave of its error."""
    simulator = em.Simulator(scene)
    series = expand(simulator, order=ORDER)
    thetas = jnp.concatenate([scene.centre[None], design(scene, RUNS - 1, SEED)])
    runs = run_campaign(simulator, thetas, sensitivities=True, predictor=series)
    return add_discrepancy(Emulator(scene, taylor=series), runs)[0]


def posterior_of(scene: Scene, data: dict[str, np.ndarray], at: np.ndarray) -> Case:
    """Means and standard deviations, from data that another scene may have made."""
    observe = observed(scene, at)
    noise = {name: cal.GaussianNoise(sd) for name, sd in by_kind(observe.parts, NOISE).items()}
    forward = emulator_of(scene).cache(observe.nodes)
    posterior = cal.sample(
        cal.model(forward, observe, noise), data, sampler="nuts", options=OPTIONS, seed=SEED
    )
    draws = posterior.draws()
    return {
        "mean": {name: float(values.mean()) for name, values in draws.items()},
        "sd": {name: float(values.std()) for name, values in draws.items()},
    }


def data_of(scene: Scene, at: np.ndarray) -> dict[str, np.ndarray]:
    """What FEM on the whole scene and the noise make."""
    theta = scene.from_unit(jnp.array(TRUTH))
    field = em.Simulator(scene).solve(theta).require_converged("the data").displacement
    observe = observed(scene, at)
    rng = np.random.default_rng(SEED)
    noise = by_kind(observe.parts, NOISE)
    exact = observe(field[observe.nodes][None], theta[None])
    return {n: np.asarray(v) + noise[n] * rng.normal(size=v.shape) for n, v in exact.items()}


def plain(measured: Measured) -> Case:
    """As JSON; infinite changes, where FEM failed, are None."""
    changes = {n: v if np.isfinite(v) else None for n, v in measured.changes.items()}
    return vars(measured) | {"left_out": list(measured.left_out), "changes": changes}


def one_scene(name: str, results: Results, *, quick: bool) -> None:
    """All effects of one scene."""
    scene = SCENES[name]()
    at = points(scene)
    others = {} if quick else other_choices(scene)
    linear = leave_out(scene, ("quadratic elements",))
    parts: dict[str, tuple[Scene, Any]] = {"": (scene, lambda: scene)}
    names = list(effects_of(scene))
    names = [n for n in names if not quick or n in ("gravity", "quadratic elements")]
    parts |= {n: (scene, lambda n=n: leave_out(scene, (n,))) for n in names}
    parts |= {n: (scene, lambda other=other: other) for n, other in others.items()}
    if not quick:
        # Defined on linear elements alone, so compared with the exact pressure on these.
        parts["published pressure, linear elements"] = (linear, lambda: published(scene))
    data: dict[str, np.ndarray] = {}
    comparisons = {
        id(whole): WithoutTerms(whole, observed(whole, at), SAMPLES, SEED)
        for whole in (scene, linear)
    }

    def make(effect: str) -> Case:
        whole, other = parts[effect]
        comparison = comparisons[id(whole)]
        measured = comparison.of((effect,), other) if effect else comparison.without(())
        found = {"scene": name, "effect": effect, "status": measured.status} | plain(measured)
        if quick:
            return found
        if not data:
            data.update(data_of(scene, at))
        return found | {"posterior": posterior_of(other(), data, at)}

    for effect in parts:
        results.case(f"{name}, {'without ' + effect if effect in names else effect or 'whole'}",
                     lambda effect=effect: make(effect))  # fmt: skip


def advise(name: str) -> Case:
    """What ``calibrate effects`` recommends for a built-in scene, or one of the study's."""
    scene = (BUILT_IN.get(name) or SCENES[name])()
    parts: dict[str, Any] = {"displacement": landmarks(scene, spread_landmarks(scene, 24, SEED))}
    if cavity_sets(scene):
        parts["volume"] = CavityVolume(scene)
    tolerance = dict(zip(("displacement", "volume"), ADVISED[name], strict=True))
    limits = {part: tolerance[part] for part in parts}
    given = recommend(scene, Observations(parts), limits, samples=SAMPLES, seed=SEED + 1)
    alone = [plain(each) for each in given.alone]
    found = {"scene": name, "effect": "recommended", "tolerance": limits, "alone": alone}
    return found | plain(given.chosen) | {"whole_s": given.whole.seconds}


def shifts(case: Case, whole: Case) -> dict[str, float]:
    """Shift of each parameter's mean, in sd of the whole scene's posterior."""
    mine, its = case["posterior"], whole["posterior"]
    return {n: (mine["mean"][n] - its["mean"][n]) / its["sd"][n] for n in mine["mean"]}


def with_shifts(cases: list[Case]) -> None:
    """Add to each case how far it moves the posterior."""
    for case in cases:
        for old in ("shift_in_sd", "largest_shift"):
            case.pop(old, None)
        # Data of quadratic elements: on linear ones both pressures are wrong.
        if "posterior" not in case or "published" in case["effect"]:
            continue
        whole = next(c for c in cases if c["name"] == f"{case['scene']}, whole")
        moved = shifts(case, whole)
        case["shift_in_sd"] = moved
        case["largest_shift"] = max(abs(v) for v in moved.values())


def label(effect: str) -> str:
    """Without the facet set's name, so that the scenes share rows."""
    return effect.split(" '")[0]


def draw(cases: list[Case], path: Path) -> None:
    """Change of the displacement, shift of the posterior, and time, by effect and scene."""
    plt = pyplot()
    rows = [c for c in cases if c["effect"] not in ("", "recommended")]
    effects = list(dict.fromkeys(label(c["effect"]) for c in rows))[::-1]
    scenes = list(dict.fromkeys(c["scene"] for c in rows))
    values = {
        "largest change of a landmark, mm": lambda c: c["changes"]["displacement"],
        "largest shift of a mean, whole posterior sd": lambda c: c.get("largest_shift"),
        "time of a solve without it, over with it": lambda c: c["ratio"],
    }
    figure, panels = plt.subplots(
        1, 3, figsize=(12.5, 1.4 + 0.42 * len(effects)), sharey=True, layout="constrained"
    )
    marks = dict(zip(scenes, (("o", BLUE), ("s", VERMILION), ("^", GREEN)), strict=False))
    for axes, (title, value) in zip(panels, values.items(), strict=True):
        for scene, (mark, colour) in marks.items():
            there = [c for c in rows if c["scene"] == scene and value(c) is not None]
            height = [effects.index(label(c["effect"])) for c in there]
            axes.plot(
                [value(c) for c in there], height, mark, color=colour, label=scene, mfc="none"
            )
        axes.set(xlabel=title, xscale="log")
        axes.grid(color="0.9")
        axes.spines[["top", "right"]].set_visible(False)
    panels[0].axvline(NOISE["displacement"], color="0.5", ls=":", label="noise of a landmark")
    panels[1].axvline(1.0, color="0.5", ls=":")
    panels[2].axvline(1.0, color="0.5", ls=":")
    panels[0].set_yticks(range(len(effects)), effects)
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper center", ncols=4)
    save(figure, path)


def check(cases: list[Case], *, quick: bool) -> None:
    """The README's claims."""
    found = {case["name"]: case for case in cases}
    for case in cases:
        assert case["status"] == "converged", case["name"]
    for scene in {case["scene"] for case in cases if case["effect"] != "recommended"}:
        whole, linear = found[f"{scene}, whole"], found[f"{scene}, without quadratic elements"]
        assert linear["unknowns"] < whole["unknowns"] / 4
        # A dead load costs the energy nothing: one sum of forces, with it or without.
        light = found[f"{scene}, without gravity"]
        assert light["operations"] <= whole["operations"]
    for advised in (case for case in cases if case["effect"] == "recommended"):
        assert advised["ratio"] <= 1.0
        for name, change in advised["changes"].items():
            assert change <= advised["tolerance"][name]
    if not quick:
        assert found["sheet, recommended"]["ratio"] < 0.5


def main() -> None:
    """Run the study."""
    arguments = parser(__doc__, HERE).parse_args()
    quick = arguments.quick
    settings = {"samples": SAMPLES, "runs": RUNS, "order": ORDER, "quick": quick}
    results = Results(arguments.out, SEED, again=arguments.again, settings=settings)
    for name in list(SCENES)[-1:] if quick else SCENES:
        one_scene(name, results, quick=quick)
    for name in () if quick else ADVISED:
        results.case(f"{name}, recommended", lambda name=name: advise(name))
    with_shifts(results.cases)
    results.write()
    draw(results.cases, arguments.out / "effects.png")
    check(results.cases, quick=quick)


if __name__ == "__main__":
    main()
