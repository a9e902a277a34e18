"""Is our network the published one, and what does its error do to a posterior?

    python -m studies.released_networks --published DIR
    python -m studies.released_networks --published DIR --quick --out DIR

The released networks run in our code and are compared with what the released code predicted, with
the stored solutions and energies, and with our FEM. Then material parameters of the released
ventricle are inferred from FEM's data with the released network and with an emulator of FEM runs,
and FEM certifies both. Writes results.json and posteriors.png.
"""

import argparse
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
from studies.common.figures import pyplot
from studies.common.output import save, study_header, write_json

import calibrate as cal
import emulator as em

HERE = Path(__file__).parent
SEED = 5
MODELS = ("TwistingBeam", "Liver", "LeftVentricle")
NOISES = (0.2, 0.05)  # sd in mm; the volume's is 5 mL per mm
FEM_RUNS = 60
CERTIFIED = 200


def reproduction(model: str, root: Path, fem_runs: int) -> dict[str, Any]:
    """Errors of the released network of ``model`` in our code."""
    emulator, scale = em.released_network(model, root), em.released.units(model).length
    thetas, tests = em.released.published_tests(model, root)
    predict = jax.jit(jax.vmap(emulator.cache()))
    predicted = np.asarray(predict(thetas))
    stored = np.load(root / model / "trained" / "displacement-predicted.npy") * scale
    largest = np.abs(stored).max(axis=(1, 2))
    off = np.abs(predicted[: len(stored)] - stored).max(axis=(1, 2)) / largest
    energy = np.asarray(
        jax.jit(jax.vmap(em.fem.potential_energy(emulator.scene)))(predicted, thetas)
    )
    found: dict[str, Any] = {
        "model": model,
        "off_the_released_code": float(off.max()),
        "err_Pi_percent": 100.0 * float(np.median(np.abs(energy / tests.energy - 1.0))),
        "theta": len(thetas),
    }
    if tests.displacement is not None:
        errors = np.linalg.norm(predicted - tests.displacement, axis=-1)
        found["err_u_stored_mm"] = float(np.median(errors))
    some = thetas[:fem_runs]
    solved = em.fem.run_campaign(em.Simulator(emulator.scene), some)
    assert len(solved.theta) == len(some)
    errors = np.linalg.norm(predicted[: len(some)] - solved.displacement, axis=-1)
    found |= {"err_u_fem_mm": float(np.median(errors)), "fem_runs": len(some)}
    cached = jax.jit(emulator.cache())
    times = []
    for theta in thetas[:20]:
        begin = time.perf_counter()
        cached(theta).block_until_ready()
        times.append(time.perf_counter() - begin)
    return found | {"value_ms": 1e3 * float(np.median(times))}


def ours(scene: em.Scene, runs: int) -> em.Emulator:
    """An emulator of the same scene from ``runs`` FEM runs, without a network."""
    with tempfile.TemporaryDirectory() as folder:
        return em.train(scene, replace(em.recipe("mechanics"), simulations=runs), folder)


def posteriors(root: Path, quick: bool, keep: Any) -> list[dict[str, Any]]:
    """A row for each map and noise."""
    released = em.released_network("LeftVentricle", root)
    scene, simulator = released.scene, em.Simulator(released.scene)
    begin = time.perf_counter()
    emulators = {"released network": released, f"{FEM_RUNS} FEM runs": None}
    emulators[f"{FEM_RUNS} FEM runs"] = ours(scene, 10 if quick else FEM_RUNS)
    trained = time.perf_counter() - begin
    observe = cal.parse_observation(scene, "landmarks:24+volume", SEED)
    theta = scene.centre
    exact = observe(simulator(theta)[observe.nodes][None], theta[None])
    rows = []
    for noise in NOISES[: 1 if quick else None]:
        sd = {"displacement": noise, "volume": 5.0 * noise}
        rng = np.random.default_rng(SEED)  # the same draw at every noise
        data = {n: np.asarray(v) + sd[n] * rng.normal(size=v.shape) for n, v in exact.items()}
        for name, emulator in emulators.items():
            begin = time.perf_counter()
            model = cal.model(
                emulator.cache(), observe, {n: cal.GaussianNoise(sd=s) for n, s in sd.items()}
            )
            options = (
                cal.samplers.NUTSOptions(warmup=100, draws=100, chains=2, rounds=1)
                if quick
                else cal.samplers.NUTSOptions(warmup=300, draws=500, chains=2, rounds=3)
            )
            posterior = cal.sample(model, data, options=options, seed=SEED, predictions=False)
            sampled = time.perf_counter() - begin
            certificate = cal.certify(posterior, simulator, draws=60 if quick else CERTIFIED)
            table = posterior.summary(0.9)
            rows.append(
                {
                    "name": f"{name}, noise {noise:g} mm",
                    "map": name,
                    "noise_mm": noise,
                    "status": certificate.verdict,
                    "reason": certificate.reason,
                    "shift_sd": {n: f.value for n, f in certificate.evidence.draws.shift.items()},
                    "shift_error": {
                        n: f.error for n, f in certificate.evidence.draws.shift.items()
                    },
                    "log_sd": {n: f.value for n, f in certificate.evidence.draws.log_sd.items()},
                    "parameters": table,
                    "truth": dict(zip(scene.parameter_names, map(float, theta), strict=True)),
                    "sampling_s": round(sampled, 1),
                    "training_s": 0.0 if emulator is released else round(trained, 1),
                    "seconds": round(time.perf_counter() - begin, 1),
                }
            )
            keep(rows)
            shifts = certificate.evidence.draws.shift.items()
            told = ", ".join(f"{n} {figure.value:+.2f} sd" for n, figure in shifts)
            print(f"{rows[-1]['name']}: {certificate.verdict}, {told}", flush=True)
    return rows


def draw(rows: list[dict[str, Any]], path: Path) -> None:
    """Shift of each posterior mean by noise and map."""
    plt = pyplot()
    noises = sorted({row["noise_mm"] for row in rows}, reverse=True)
    figure, panels = plt.subplots(
        1, len(noises), figsize=(4.6 * len(noises), 3.8), sharey=True, squeeze=False,
        layout="constrained",
    )  # fmt: skip
    styles = [("tab:red", "^"), ("tab:blue", "o")]
    for axes, noise in zip(panels[0], noises, strict=True):
        some = [row for row in rows if row["noise_mm"] == noise]
        for k, (row, (colour, marker)) in enumerate(zip(some, styles, strict=True)):
            x = np.arange(len(row["shift_sd"])) + 0.16 * (2 * k - 1)
            axes.errorbar(
                x, list(row["shift_sd"].values()), yerr=list(row["shift_error"].values()),
                color=colour, marker=marker, linestyle="none", capsize=3,
                label=f"{row['map']}: {row['status']}",
            )  # fmt: skip
        axes.axhline(0.0, color="black", lw=1)
        axes.set_xticks(range(len(row["shift_sd"])), list(row["shift_sd"]))
        axes.set(title=f"landmarks to {noise:g} mm, volume to {5 * noise:g} mL")
        axes.legend(frameon=False, fontsize=8)
        axes.grid(axis="y", alpha=0.25)
    panels[0, 0].set_ylabel("shift of the mean that FEM finds, posterior sd")
    save(figure, path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--published", type=Path, required=True, help="folder of the released data")
    parser.add_argument("--quick", action="store_true", help="few FEM runs, few draws")
    parser.add_argument("--out", type=Path, default=HERE)
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    path, quick = arguments.out / "results.json", arguments.quick
    header = study_header(HERE, SEED)
    models = []
    for model in MODELS:
        models.append(reproduction(model, arguments.published, 3 if quick else 150))
        print(models[-1], flush=True)
    rows = posteriors(
        arguments.published,
        quick,
        lambda some: write_json(path, {**header, "models": models, "cases": some}),
    )
    draw(rows, arguments.out / "posteriors.png")


if __name__ == "__main__":
    main()
