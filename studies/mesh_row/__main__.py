"""What a certificate says a finer mesh would change, against what it changes.

    python -m studies.mesh_row
    python -m studies.mesh_row --quick

Forty posteriors: bodies on meshes from poor to good, noise from that of a good scanner to a tenth,
landmarks and volumes. Each data set is of the body on the next finer mesh. Its posterior on the
mesh is certified, which predicts how far every mean and sd would move on the finer mesh; then it is
sampled there, with an emulator of that mesh (recipe ``two_meshes``). Writes results.json after each
posterior, and mesh_row.png.
"""

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from itertools import product
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from matplotlib.ticker import FixedFormatter, FixedLocator
from studies.common.figures import COLOURS, pyplot
from studies.common.output import Case, Results, parser, save
from studies.common.two_meshes import Pair, on_two_meshes

import calibrate as cal
import emulator as em

HERE = Path(__file__).parent
SEED = 23
OPTIONS = cal.samplers.NUTSOptions(warmup=300, draws=500, chains=2, rounds=4, r_hat=1.02, ess=300.0)
FEM_RUNS = 100  # of a certificate
LIMIT = 0.5  # posterior sd: what a certificate may accept


@dataclass(frozen=True)
class Body:
    """A scene, and what is measured on it.

    landmarks : their number. noise : sd in mm. volume : sd in mL for each mm of the landmarks';
    0 where none is measured.
    """

    scene: Callable[[], em.Scene]
    landmarks: tuple[int, ...]
    noise: tuple[float, ...]
    volume: float = 0.0


BODIES = {
    "cube, linear": Body(lambda: em.scenes.twisting_cube(cells=6, order=1), (10, 40), (0.1, 0.02)),
    "cube": Body(em.scenes.twisting_cube, (10, 40), (0.1, 0.02)),
    "beam, 10 x 1 x 1": Body(lambda: em.scenes.once_clamped_beam((10, 1, 1)), (10, 40), (1.0, 0.2)),
    "beam": Body(em.scenes.once_clamped_beam, (10, 40), (1.0, 0.2)),
    "liver, 3 shells": Body(lambda: em.scenes.liver(shells=3), (10, 40), (2.0, 0.5)),
    "ventricle, linear": Body(
        lambda: em.scenes.left_ventricle(10, 20, 2, order=1), (0, 24), (1.0, 0.3), 3.0
    ),
    "ventricle, 8 x 16 x 1": Body(
        lambda: em.scenes.left_ventricle(8, 16, 1), (0, 24), (1.0, 0.3), 3.0
    ),
}
QUICK = ("cube, linear",)
SETS = {"beam, 10 x 1 x 1": 2, "beam": 2, "liver, 3 shells": 2}  # of each kind of data; others 1


@lru_cache(maxsize=1)
def emulators(name: str) -> Pair:
    """Of a body, on its mesh and on the finer one."""
    with tempfile.TemporaryDirectory() as folder:
        return on_two_meshes(BODIES[name].scene(), Path(folder))


def model_of(emulator: em.Emulator, at: np.ndarray, noise: float, volume: float) -> cal.Model:
    """The model of displacements of points ``at`` (d, 3), and of the volume."""
    scene = emulator.scene
    parts: dict[str, Any] = {}
    sd: dict[str, float] = {}
    if len(at):
        parts["displacement"], sd["displacement"] = cal.landmarks(scene, at), noise
    if volume > 0.0:
        parts["volume"], sd["volume"] = cal.CavityVolume(scene), noise * volume
    told = {name: cal.GaussianNoise(value) for name, value in sd.items()}
    return cal.model(emulator.cache(), cal.Observations(parts), told)


def moments(posterior: cal.Posterior) -> tuple[np.ndarray, np.ndarray]:
    """Means (p,) and standard deviations (p,)."""
    draws = posterior.draws()
    x = np.stack([draws[name] for name in posterior.model.names], axis=1)
    return x.mean(axis=0), x.std(axis=0)


def examine(name: str, count: int, noise: float, r: int) -> Case:
    """One posterior: what its certificate predicts, and what the finer mesh does."""
    body, pair = BODIES[name], emulators(name)
    at = cal.spread_landmarks(pair.coarse.scene, max(count, 1), SEED)[:count]
    here, there = (model_of(each, at, noise, body.volume) for each in pair)
    rng = np.random.default_rng([SEED, r, count, *name.encode()])
    truth = pair.fine.scene.from_unit(jnp.asarray(rng.random(len(here.names))))
    u = pair.fine.cache()(truth)
    exact = there.observe(u[there.observe.nodes][None], truth[None])
    data = {
        n: np.asarray(v)
        + noise * (body.volume if n == "volume" else 1.0) * rng.normal(size=v.shape)
        for n, v in exact.items()
    }
    posterior = cal.sample(here, data, options=OPTIONS, seed=r, predictions=False)
    certificate = cal.certify(posterior, em.Simulator(pair.coarse.scene), draws=FEM_RUNS, seed=r)
    mesh = certificate.evidence.mesh
    (mean, sd), (finer, finer_sd) = (
        moments(posterior),
        moments(cal.sample(there, data, options=OPTIONS, seed=r, predictions=False)),
    )
    names = here.names
    return {
        "body": name,
        "landmarks": count,
        "noise": noise,
        "names": list(names),
        "true": list((finer - mean) / sd),
        "true_log_sd": list(np.log(finer_sd / sd)),
        "predicted": [mesh.shift[n].value for n in names] if mesh.shift else None,
        "error": [mesh.shift[n].error for n in names] if mesh.shift else None,
        "log_sd": [mesh.log_sd[n].value for n in names] if mesh.shift else None,
        "nodes": [len(each.scene.mesh.nodes) for each in pair],
        "verdict": certificate.verdict,
        "reason": certificate.reason,
    }


def furthest(case: Case) -> float:
    """Largest true shift of a mean, in posterior sd."""
    return float(np.max(np.abs(case["true"])))


def summary(cases: list[Case]) -> Case:
    """What the README says."""
    accepted = [c for c in cases if c["verdict"] == "accepted"]
    good = [c for c in cases if furthest(c) <= 0.5 * LIMIT]
    blamed = [c for c in good if "finer mesh" in c["reason"]]
    told = [c for c in cases if c["predicted"]]
    miss = np.concatenate([np.subtract(c["predicted"], c["true"]) for c in told])
    size = np.concatenate([np.abs(c["true"]) for c in told])
    return {
        "verdicts": {
            v: sum(c["verdict"] == v for c in cases) for v in {c["verdict"] for c in cases}
        },
        "accepted_furthest_sd": max(map(furthest, accepted), default=None),
        "small_shifts": len(good),
        "false_alarms": sum(c["verdict"] == "not certified" for c in blamed),
        "open": sum(c["verdict"] == "undecided" for c in blamed),
        "miss_sd_where_below_1": float(np.quantile(np.abs(miss[size < 1.0]), 0.9)),
    }


def draw(cases: list[Case], path: Path) -> None:
    """Predicted shift against the true one, every parameter of every posterior."""
    plt = pyplot()
    figure, axes = plt.subplots(figsize=(6.4, 5.2), layout="constrained")
    marks = {"accepted": "o", "not certified": "X", "undecided": "s"}
    for k, name in enumerate(dict.fromkeys(c["body"] for c in cases)):
        for verdict, mark in marks.items():
            told = [c for c in cases if c["body"] == name and c["verdict"] == verdict]
            told = [c for c in told if c["predicted"]]
            if not told:
                continue
            x, y, e = (
                np.concatenate([c[key] for c in told]) for key in ("true", "predicted", "error")
            )
            axes.errorbar(
                x, y, e, fmt=mark, color=COLOURS[k % len(COLOURS)], ms=5, lw=0.8,
                mfc="none" if verdict == "accepted" else None, label=f"{name}, {verdict}",
            )  # fmt: skip
    ticks = [-100, -10, -1, 0, 1, 10, 100]
    for axis in (axes.xaxis, axes.yaxis):
        axis.axes.set(**{f"{axis.axis_name}scale": "symlog"})
        axis.set_major_locator(FixedLocator(ticks))
        axis.set_major_formatter(FixedFormatter([f"{tick}" for tick in ticks]))
    ends = np.array(axes.get_xlim())
    line = np.sign(ends) * np.geomspace(1e-2, np.abs(ends).max(), 60)[:, None]
    axes.plot(np.sort(line.ravel()), np.sort(line.ravel()), color="0.6", lw=0.8, zorder=0)
    axes.axvspan(-LIMIT, LIMIT, color="0.94", zorder=0)
    axes.axhspan(-LIMIT, LIMIT, color="0.94", zorder=0)
    axes.set(
        xlabel="shift of a mean on the finer mesh, posterior sd",
        ylabel="what the certificate predicts, posterior sd",
    )
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(loc="outside right upper", frameon=False, fontsize=8)
    save(figure, path)


def check(told: Case) -> None:
    """The README's claims."""
    assert told["accepted_furthest_sd"] is None or told["accepted_furthest_sd"] <= LIMIT
    assert told["false_alarms"] <= 0.05 * told["small_shifts"]


def main() -> None:
    """Run the study."""
    words = parser(__doc__, HERE).parse_args()
    results = Results(words.out, SEED, again=words.again, settings={"quick": words.quick})
    for name in QUICK if words.quick else BODIES:
        body = BODIES[name]
        kinds = product(body.landmarks, body.noise, range(1 if words.quick else SETS.get(name, 1)))
        for count, noise, r in kinds:
            label = f"{name}, {count} landmarks, {noise:g} mm, set {r + 1}"
            results.case(label, lambda name=name, c=count, n=noise, r=r: examine(name, c, n, r))
    told = summary(results.cases)
    results.write(summary=told)
    draw(results.cases, words.out / "mesh_row.png")
    check(told)


if __name__ == "__main__":
    main()
