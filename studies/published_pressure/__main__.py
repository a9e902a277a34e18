"""What does the released pressure work do to parameters inferred from a real ventricle?

    python -m studies.published_pressure
    python -m studies.published_pressure --quick --out DIR

Data of a left ventricle are made by FEM with the exact pressure. The material is inferred at known
pressures with the exact load in the map, as a control, and with ``PublishedPressure``. Each
posterior is certified by FEM of its own map's scene. Writes results.json and
published_pressure.png.
"""

import argparse
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from studies.common.output import save, study_header

import calibrate as cal
from calibrate.figures import pyplot
from calibrate.measurements import parse_observation
from emulator.core.store import write_json
from emulator.fem import Runs, Simulator, sobol
from emulator.scenes.built_in.ventricles import left_ventricle
from emulator.scenes.loads import KPA_PER_MMHG, CavityPressure, Load, PublishedPressure
from emulator.scenes.parameter_space import Parameter
from emulator.scenes.scene import Scene
from emulator.surrogates.emulator import Emulator
from emulator.surrogates.taylor import expand
from emulator.training.mechanics import add_discrepancy

HERE = Path(__file__).parent
SEED = 11
MESH = (6, 12, 2)
QUICK_MESH = (4, 8, 1)
# Wider than the scene's range on the stiff side, where a load that is too large leads.
WIDE = (
    Parameter("a", "kPa", 0.1, 3.0, "log"),
    Parameter("b", "", 0.5, 8.0, "log"),
    Parameter("a_f", "kPa", 2.0, 24.0, "log"),
    Parameter("b_f", "", 0.5, 9.0, "log"),
    Parameter("pressure", "kPa", 4.0 * KPA_PER_MMHG, 8.0 * KPA_PER_MMHG),
)
LOADS = {"exact": CavityPressure("endocardium"), "published": PublishedPressure("endocardium")}
PRESSURES = {"p4": 4.0, "p6": 6.0, "p8": 8.0}  # mmHg
OBSERVED = {
    "24 landmarks and volume at 8 mmHg": ("landmarks:24+volume", ("p8",)),
    "volumes at 4, 6 and 8 mmHg": ("volume", ("p4", "p6", "p8")),
}
NOISE = {"displacement": 0.3, "volume": 1.0}  # mm, mL
MATERIAL = ("a", "b", "a_f", "b_f")
RUNS = 120
MISFIT = 0.005  # p below which a certificate refuses


def scene_of(load: Load, shape: tuple[int, int, int]) -> Scene:
    """The left ventricle under ``load`` over the wide box."""
    return replace(left_ventricle(*shape, order=1), parameters=WIDE, loads=(load,))


def truths(count: int) -> list[dict[str, float]]:
    """Materials in the range of the built-in scene, by name."""
    thetas = np.asarray(sobol(left_ventricle(*QUICK_MESH, order=1), count, SEED))
    return [dict(zip(MATERIAL, map(float, theta), strict=False)) for theta in thetas]


def emulator_of(simulator: Simulator, runs: int, order: int) -> tuple[Emulator, int]:
    """An emulator from up to ``runs`` FEM runs, and how many of them had no equilibrium."""
    scene = simulator.scene
    series = expand(simulator, order=order)
    solved, failed = [], 0
    for theta in jnp.concatenate([scene.centre[None], sobol(scene, runs - 1, SEED)]):
        solution = simulator.solve(theta, series(scene.to_unit(theta)))
        solution = solution if bool(solution.converged) else simulator.solve(theta)
        failed += not bool(solution.converged)
        if bool(solution.converged):
            solved.append((theta, solution.displacement))
    kept, fields = (jnp.stack(part) for part in zip(*solved, strict=True))
    slopes = jnp.stack(
        [simulator.sensitivities(u, theta) for theta, u in zip(kept, fields, strict=True)]
    )
    made = Runs(kept, fields, jnp.zeros(len(kept)), slopes)
    return add_discrepancy(Emulator(scene, taylor=series), made)[0], failed


def data_of(simulator: Simulator, material: Mapping[str, float], k: int) -> dict[str, Any]:
    """FEM's noisy data by observation's name, of every entry of :data:`OBSERVED`."""
    scene, found = simulator.scene, {}
    rng = np.random.default_rng([SEED, k])
    fields = {
        state: (theta, simulator(theta))
        for state, mmhg in PRESSURES.items()
        for theta in [jnp.array([*material.values(), mmhg * KPA_PER_MMHG])]
    }
    for what, (words, states) in OBSERVED.items():
        observe = parse_observation(scene, words, SEED, states)
        thetas = jnp.stack([fields[state][0] for state in states])
        exact = observe(jnp.stack([fields[state][1][observe.nodes] for state in states]), thetas)
        found[what] = {
            name: np.asarray(values) + rng.normal(0.0, NOISE[name.split("@")[0]], values.shape)
            for name, values in exact.items()
        }
    return found


def model_of(emulator: Emulator, what: str) -> cal.Model:
    """The model of an observation, the pressures known."""
    words, states = OBSERVED[what]
    observe = parse_observation(emulator.scene, words, SEED, states)
    noise = {name: cal.GaussianNoise(sd=NOISE[name]) for name in observe.bases}
    known = {f"pressure@{state}": PRESSURES[state] * KPA_PER_MMHG for state in states}
    # A wrong load may predict other magnitudes: the study asks what follows, not whether to refuse.
    return cal.model(emulator.cache(), observe, noise, known=known, check_scale=False)


def one(
    model: cal.Model, simulator: Simulator, data: Any, truth: Mapping[str, float], quick: bool
) -> dict[str, Any]:
    """Posterior, certificate and bias of one data set."""
    options = (
        cal.NUTSOptions(warmup=100, draws=100, chains=2, rounds=1)
        if quick
        else cal.NUTSOptions(warmup=250, draws=300, chains=2, rounds=3, r_hat=1.02, ess=150.0)
    )
    posterior = cal.sample(model, data, options=options, seed=SEED, predictions=False)
    certificate = cal.certify(posterior, simulator, draws=60)
    misfit = {
        name: min(found.p, found.p_worst) for name, found in certificate.evidence.misfit.items()
    }
    table = posterior.summary(0.9)
    return {
        "status": certificate.verdict,
        "reason": certificate.reason,
        "misfit_p": misfit,
        "seen": min(misfit.values()) < MISFIT,
        "truth": dict(truth),
        "parameters": {
            name: {
                **table[name],
                "bias_percent": 100.0 * (table[name]["mean"] / truth[name] - 1.0),
                "bias_sd": (table[name]["mean"] - truth[name]) / table[name]["sd"],
                "covered": bool(table[name]["low"] <= truth[name] <= table[name]["high"]),
            }
            for name in MATERIAL
        },
    }


def study(
    quick: bool, sets: int, runs: int, keep: Callable[[list[dict[str, Any]]], object]
) -> list[dict[str, Any]]:
    """A row for each load of the map, observation and data set; ``keep`` gets all so far."""
    shape = QUICK_MESH if quick else MESH
    materials = truths(sets)
    exact = Simulator(scene_of(LOADS["exact"], shape))
    data = [data_of(exact, material, k) for k, material in enumerate(materials)]
    rows = []
    for load, kind in LOADS.items():
        begin = time.process_time()
        simulator = exact if load == "exact" else Simulator(scene_of(kind, shape))
        emulator, failed = emulator_of(simulator, runs, 1 if quick else 3)
        print(
            f"{load}: emulator from {runs} FEM runs, {failed} without equilibrium, "
            f"{time.process_time() - begin:.0f} s",
            flush=True,
        )
        for what in list(OBSERVED)[: 1 if quick else None]:
            model = model_of(emulator, what)
            for k, material in enumerate(materials):
                begin = time.process_time()
                row = one(model, simulator, data[k][what], material, quick)
                row = {
                    "name": f"{load} pressure in the map, {what}, data set {k}",
                    "load": load,
                    "observed": what,
                    "nodes": len(simulator.scene.mesh.nodes),
                    "failed_runs": failed,
                    **row,
                    "processor_s": round(time.process_time() - begin, 1),
                }
                rows.append(row)
                keep(rows)
                print(
                    f"{row['name']}: {row['status']}, p {min(row['misfit_p'].values()):.3f}, "
                    + "  ".join(
                        f"{n} {e['bias_percent']:+.0f} % {e['bias_sd']:+.1f} sd"
                        for n, e in row["parameters"].items()
                    )
                    + f"  {row['processor_s']:.0f} s",
                    flush=True,
                )
    return rows


def conclude(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """By observation: what the published load changes, and by load: biases, coverage, verdicts.

    ``change_percent`` and ``change_sd`` compare each posterior mean with the control's of the same
    data, in its sd: what the prior does to weakly determined parameters drops out.
    """
    found: dict[str, Any] = {}
    for what in dict.fromkeys(row["observed"] for row in rows):
        some = {
            load: [row for row in rows if (row["load"], row["observed"]) == (load, what)]
            for load in LOADS
        }
        pairs = {
            n: [
                (wrong["parameters"][n], right["parameters"][n])
                for wrong, right in zip(some["published"], some["exact"], strict=True)
            ]
            for n in MATERIAL
        }
        found[what] = {
            "change_percent": {
                n: float(np.mean([100.0 * (w["mean"] / r["mean"] - 1.0) for w, r in each]))
                for n, each in pairs.items()
            },
            "change_sd": {
                n: float(np.mean([(w["mean"] - r["mean"]) / r["sd"] for w, r in each]))
                for n, each in pairs.items()
            },
            **{load: _by_load(each) for load, each in some.items()},
        }
    return found


def _by_load(rows: list[dict[str, Any]]) -> dict[str, Any]:
    entries = {n: [row["parameters"][n] for row in rows] for n in MATERIAL}
    mean = {
        key: {n: float(np.mean([e[key] for e in each])) for n, each in entries.items()}
        for key in ("bias_percent", "bias_sd")
    }
    return {
        **mean,
        "covered": {n: sum(e["covered"] for e in each) for n, each in entries.items()},
        "misfit_seen": sum(row["seen"] for row in rows),
        "verdicts": {v: sum(r["status"] == v for r in rows) for v in {r["status"] for r in rows}},
        "data_sets": len(rows),
    }


def draw(rows: list[dict[str, Any]], path: Path) -> None:
    """Posterior means over the truth, by parameter; 90 % intervals as lines."""
    plt = pyplot()
    observed = dict.fromkeys(row["observed"] for row in rows)
    figure, panels = plt.subplots(
        1, len(observed), figsize=(11, 4.2), sharey=True, squeeze=False, layout="constrained"
    )
    styles = {"exact": ("tab:blue", "o"), "published": ("tab:red", "^")}
    for axes, what in zip(panels[0], observed, strict=True):
        for load, (colour, marker) in styles.items():
            some = [row for row in rows if (row["load"], row["observed"]) == (load, what)]
            for i, name in enumerate(MATERIAL):
                for k, row in enumerate(some):
                    x = i + (-0.3 if load == "exact" else 0.06) + 0.24 * k / max(len(some) - 1, 1)
                    entry, truth = row["parameters"][name], row["truth"][name]
                    ends = [entry["low"] / truth, entry["high"] / truth]
                    axes.plot([x, x], ends, color=colour, lw=1.4, alpha=0.7)
                    label = f"{load} pressure in the map" if i == k == 0 else None
                    axes.plot(x, entry["mean"] / truth, marker, color=colour, ms=5, label=label)
        axes.axhline(1.0, color="black", lw=1)
        axes.set_xticks(range(len(MATERIAL)), MATERIAL)
        axes.set(title=what, yscale="log")
        axes.grid(axis="y", which="both", alpha=0.25)
    panels[0, 0].set_ylabel("inferred / true, mean and 90 % interval")
    panels[0, 0].legend(frameon=False)
    save(figure, path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sets", type=int, default=3, help="data sets")
    parser.add_argument("--runs", type=int, default=RUNS, help="FEM runs of each emulator")
    parser.add_argument(
        "--quick", action="store_true", help="one data set with landmarks, a coarse mesh"
    )
    parser.add_argument("--out", type=Path, default=HERE)
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    quick, path = arguments.quick, arguments.out / "results.json"
    header = study_header(HERE, SEED)
    sets, runs = (1, 30) if quick else (arguments.sets, arguments.runs)
    rows = study(quick, sets, runs, lambda some: write_json(path, {**header, "cases": some}))
    write_json(path, {**header, "summary": conclude(rows), "cases": rows})
    draw(rows, arguments.out / "published_pressure.png")


if __name__ == "__main__":
    main()
