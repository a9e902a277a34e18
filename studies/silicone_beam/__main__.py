"""A real measurement: how stiff is a silicone beam, and where will it go under a heavier weight?

python -m studies.silicone_beam --data DIR           # the raw recordings (README)
python -m studies.silicone_beam --data DIR --judge OTHER
"""

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from studies.common.figures import pyplot
from studies.common.output import Case, Results, parser, run, save, table
from studies.silicone_beam import beam
from studies.silicone_beam.experiment import BLIND, FORCE, Measured, measured, recordings

import calibrate as cal
import emulator as em

HERE = Path(__file__).parent
SEED = 31
UPSTREAM = 263.824 / 3.0  # kPa, mu of upstream's Young's modulus, incompressible
_QUANTILES = (0.05, 0.5, 0.95)
_AXES = ("along", "across", "up")


def posterior(
    model: cal.Model, seen: Measured, simulator: em.Simulator, draws: int, runs: int
) -> tuple[cal.Posterior, Case]:
    """The posterior of the moduli with its certificate."""
    options = cal.samplers.NUTSOptions(draws=draws)
    data = {name: beam.data(seen)[name] for name in model.observe.parts}
    found = cal.sample(model, data, options=options, seed=SEED)
    certificate = cal.certify(found, simulator, draws=runs, seed=SEED)
    summary = found.summary(0.9)
    return found, {
        "parameters": {n: dict(summary[n]) for n in ("mu", "kappa")},
        "divergences": found.divergences,
        "verdict": certificate.verdict,
        "reason": certificate.reason,
        "mesh": {n: f.value for n, f in certificate.evidence.mesh.shift.items()},
    }


def what_was_unknown(found: cal.Posterior, seen: Measured) -> Case:
    """Posterior mean and sd of hand, rig, pins and the loose marker, in mm and degrees."""
    error = found.model.error
    assert error is not None
    draws = flat(found)
    each = []
    for k in range(0, len(draws["mu"]), max(1, len(draws["mu"]) // 200)):
        means, _ = found.model.predict({n: jnp.asarray(v[k]) for n, v in draws.items()})
        each.append(error.unknowns({n: v - means[n] for n, v in beam.data(seen).items()}))
    mean = np.mean([m for m, _ in each], axis=0)
    spread = np.mean([np.diag(c) for _, c in each], axis=0) + np.var([m for m, _ in each], axis=0)
    scale = [_scale(name) for name in error.names]
    return {
        name: {"mean": float(m * s), "sd": float(np.sqrt(v) * s), "prior_sd": s}
        for name, m, v, s in zip(error.names, mean, spread, scale, strict=True)
    }


def _scale(name: str) -> float:
    who = name.split()[0]
    if who in ("hand", "rig"):
        return (beam.HAND if who == "hand" else beam.RIG)["turn" in name]
    return beam.PIN if who == "pins" else beam.LOOSE


def flat(found: cal.Posterior) -> dict[str, np.ndarray]:
    """Draws of the moduli, all chains."""
    return {name: values for name, values in found.draws().items() if name in ("mu", "kappa")}


def intervals(places: Mapping[str, np.ndarray]) -> Case:
    """90 % intervals and medians of the tip's markers, mm."""
    return {
        name: np.quantile(values, _QUANTILES, axis=0).round(3).tolist()
        for name, values in places.items()
    }


def twins(forward: Any, seen: Measured, count: int, rng: np.random.Generator) -> Case:
    """Experiments like this one, made of the model: do 90 % intervals of mu cover the truth?"""
    model = beam.model(forward, seen)
    covered, z, naive = [], [], []
    for k in range(count):
        truth = {
            "mu": float(rng.uniform(60.0, 130.0)),
            "kappa": float(np.exp(rng.uniform(np.log(3e3), np.log(5e4)))),
        }
        means, _ = model.predict({n: jnp.asarray(v) for n, v in truth.items()})
        twin = {name: np.array(mean) for name, mean in means.items()}
        for error in beam.unknowns(seen):
            q = rng.normal(size=len(error.names))
            for name, modes in error.modes.items():
                twin[name] += np.tensordot(q, modes, axes=1)
        for name, sd in beam.NOISE.items():
            twin[name] += rng.normal(0.0, sd, twin[name].shape)
        for kind, others in ((model, False), (beam.model(forward, seen, known_rig=True), True)):
            options = cal.samplers.NUTSOptions(draws=500, warmup=500, chains=2)
            told = {name: twin[name] for name in kind.observe.parts}
            found = cal.sample(kind, told, options=options, seed=SEED + k, predictions=False)
            mu = flat(found)["mu"]
            low, high = np.quantile(mu, (0.05, 0.95))
            if others:
                naive.append(bool(low <= truth["mu"] <= high))
            else:
                covered.append(bool(low <= truth["mu"] <= high))
                z.append(float((mu.mean() - truth["mu"]) / mu.std()))
    return {
        "twins": count,
        "coverage": float(np.mean(covered)),
        "bias_sd": float(np.mean(z)),
        "z_rms": float(np.sqrt(np.mean(np.square(z)))),
        "coverage_if_nothing_were_unknown": float(np.mean(naive)),
    }


def judge(results: Results, folder: Path) -> Case:
    """The recordings that were kept apart, beside what was written before."""
    told = next((c for c in results.cases if c["name"] == "prediction"), None)
    if told is None:
        raise em.InputError("no prediction in results.json; run the study with --data first")
    others = [p for p in sorted(folder.glob("beam_load*.c3d")) if "load52" not in p.name]
    if not others:
        raise em.InputError(f"{folder} has no recordings of another force, beam_load*.c3d")
    found: Case = {"recordings": [p.name for p in others]}
    places = np.mean([recordings(p.parent, p.name)[0].static for p in others], axis=0)
    for name, (low, _, high) in told["markers"].items():
        inside = (np.array(low) <= places) & (places <= np.array(high))
        found[name] = {"inside": int(inside.sum()), "of": int(inside.size), "each": inside.tolist()}
    return found | {"measured": places.round(3).tolist()}


def _told(case: Case) -> str:
    """The table of :func:`judge`."""
    rows = [
        (name, f"{told['inside']} of {told['of']}", *np.sum(told["each"], axis=0))
        for name, told in case.items()
        if isinstance(told, dict)
    ]
    return table(("prediction", "inside 90 % bands", *_AXES), rows)


def figure(
    cases: Mapping[str, Case], draws: Mapping[str, np.ndarray], seen: Measured, out: Path
) -> None:
    """Posterior of mu; markers measured and predicted, by force."""
    plot = pyplot()
    drawn, (left, right) = plot.subplots(1, 2, figsize=(11, 4.2), constrained_layout=True)
    for name, colour in (("all unknown", "#1f5a94"), ("as if nothing were unknown", "#c2571a")):
        left.hist(draws[name], bins=60, density=True, alpha=0.6, color=colour, label=name)
    left.axvline(UPSTREAM, color="#444444", ls="--", label="upstream's fit")
    left.set_xlabel("shear modulus, kPa")
    left.set_yticks([])
    left.legend(frameon=False)
    low, middle, high = (np.array(v) for v in cases["prediction"]["markers"]["rig where it was"])
    lower, _, upper = (np.array(v) for v in cases["prediction"]["markers"]["rig moved again"])
    for k, colour in enumerate(("#1f5a94", "#2f8f5b", "#c2571a")):
        rest = (seen.rest - seen.shift)[k, 2]
        up = [rest + seen.weight[k, 2], rest + seen.loaded[k, 2]]
        right.plot([0.0, FORCE], up, "o-", color=colour, label=f"marker {k + 1}, measured")
        right.errorbar(
            [BLIND],
            [middle[k, 2]],
            [[middle[k, 2] - low[k, 2]], [high[k, 2] - middle[k, 2]]],
            fmt="s",
            color=colour,
            capsize=4,
        )
        right.plot([BLIND, BLIND], [lower[k, 2], upper[k, 2]], color=colour, lw=1, alpha=0.5)
    right.plot([], [], "ks", label="predicted, 90 %")
    right.set_xlabel("force on the free end, N")
    right.set_ylabel("height of the tip's markers, mm")
    right.legend(frameon=False)
    save(drawn, out)


def main() -> None:
    arguments = parser(__doc__, HERE)
    arguments.add_argument("--data", type=Path, help="folder of the recordings, .c3d")
    arguments.add_argument(
        "--judge", type=Path, help="folder of the recordings that were kept apart"
    )
    arguments.add_argument("--twins", type=int, default=40)
    words = arguments.parse_args()
    results = Results(words.out, SEED, again=words.again, settings={"quick": words.quick})
    if words.judge is not None:
        print(_told(results.case("judged", lambda: judge(results, words.judge))))
        return
    if words.data is None:
        arguments.error("give --data DIR, the folder of the recordings (README)")
    seen = measured(words.data)
    scene = beam.scene((6, 2, 2) if words.quick else (12, 3, 3))
    with tempfile.TemporaryDirectory() as folder:
        trained = em.train(scene, em.recipe("mechanics"), folder)
    forward, simulator = trained.cache(), em.Simulator(scene)
    draws, runs = (250, 50) if words.quick else (1000, 200)
    rng = np.random.default_rng(SEED)

    mu: dict[str, np.ndarray] = {}

    def calibrated() -> Case:
        found, case = posterior(beam.model(forward, seen), seen, simulator, draws, runs)
        mu["all unknown"] = flat(found)["mu"]
        case["unknowns"] = what_was_unknown(found, seen)
        every = slice(None, None, max(1, len(mu["all unknown"]) // 1000))
        some = {name: values[every] for name, values in flat(found).items()}
        places = beam.predict(forward, found.model, seen, some, rng)
        results.case("prediction", lambda: {"force_N": BLIND, "markers": intervals(places)})
        return case

    def naive() -> Case:
        plain = beam.model(forward, seen, known_rig=True)
        found, case = posterior(plain, seen, simulator, draws, runs)
        mu["as if nothing were unknown"] = flat(found)["mu"]
        return case

    results.case("all unknown", calibrated)
    results.case("as if nothing were unknown", naive)
    results.case("twins", lambda: twins(forward, seen, 2 if words.quick else words.twins, rng))
    results.write(repeats_mm=seen.repeats, upstream_mu_kPa=UPSTREAM)
    if len(mu) == 2:
        cases = {case["name"]: case for case in results.cases}
        figure(cases, mu, seen, words.out / "silicone_beam.png")


if __name__ == "__main__":
    run(main)
