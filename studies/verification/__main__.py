"""Are inferred parameters right? Posteriors of many synthetic FEM data sets.

    python -m studies.verification
    python -m studies.verification --quick

Theta is drawn from the prior, FEM makes data of it with noise, and the shipped emulator and NUTS
give a posterior: how often its 90 % interval covers the truth, its bias, how much narrower it is
than the prior, against noise, number of landmarks and of pressures. Then data that the model is
wrong about: another mesh, another law, other fibres; and what the certificate says. Writes
results.json after each case, and verification.png.
"""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from studies.common.output import Case, Results, parser, save

import calibrate as cal
import emulator as em
from calibrate.figures.drawing import pyplot
from calibrate.observations import CavityVolume, Observations, landmarks, spread_landmarks
from calibrate.samplers import NUTSOptions
from emulator.fem import Simulator, run_campaign
from emulator.geometry.bodies.ellipsoid import HUMAN, truncated_ellipsoid
from emulator.geometry.fibres import rule_based_fibres
from emulator.mechanics.laws import find_law
from emulator.scenes import Parameter, Scene
from emulator.scenes.left_ventricle import HELIX, PRESSURE

HERE = Path(__file__).parent
SEED = 17
LEVEL = 0.9
OPTIONS = NUTSOptions(warmup=200, draws=250, chains=2, rounds=4, r_hat=1.03, ess=100.0)
CERTIFIED = 2  # posteriors of a case, where it asks for them
PRESSURES = (0.6, 0.9, 1.2)  # kPa, known, of several states


@dataclass(frozen=True)
class Study:
    """One kind of data.

    body : a shipped emulator. landmarks : their number. noise : sd of one, mm. volume : sd in mL,
    None where none is measured. states : number of known pressures; 0 for one that is inferred.
    truth : the scene that makes the data, the body's by default. sets : of data. right : whether
    the model is.
    """

    body: str
    landmarks: int = 24
    noise: float = 0.3
    volume: float | None = None
    states: int = 0
    truth: str = ""
    sets: int = 100
    right: bool = True
    certify: bool = False


VENTRICLE = Study("left_ventricle", volume=1.0, sets=12)
STUDIES = {
    "beam": Study("once_clamped_beam", 20, 0.2),
    "beam, noise / 4": Study("once_clamped_beam", 20, 0.05),
    "beam, noise x 4": Study("once_clamped_beam", 20, 0.8),
    "beam, 5 landmarks": Study("once_clamped_beam", 5, 0.2),
    "beam, 80 landmarks": Study("once_clamped_beam", 80, 0.2),
    "liver": Study("liver", 20, 0.5),
    "liver, noise / 4": Study("liver", 20, 0.125),
    "liver, noise x 4": Study("liver", 20, 2.0),
    "ventricle": replace(VENTRICLE, sets=20, certify=True),
    "ventricle, noise / 3": replace(VENTRICLE, noise=0.1, volume=0.33),
    "ventricle, noise x 3": replace(VENTRICLE, noise=0.9, volume=3.0),
    "ventricle, 6 landmarks": replace(VENTRICLE, landmarks=6),
    "ventricle, volume alone": replace(VENTRICLE, landmarks=0),
    "ventricle, 1 known pressure": replace(VENTRICLE, states=1),
    "ventricle, 2 known pressures": replace(VENTRICLE, states=2),
    "ventricle, 3 known pressures": replace(VENTRICLE, states=3),
    "ventricle, another mesh": replace(VENTRICLE, truth="mesh", right=False, certify=True),
    "ventricle, Guccione's law": replace(VENTRICLE, truth="law", right=False, certify=True),
    "ventricle, other fibres": replace(VENTRICLE, truth="fibres", right=False, certify=True),
}
QUICK = {"beam": replace(STUDIES["beam"], sets=10)}


def on_another_mesh(scene: Scene) -> Scene:
    """The same ventricle in quadratic elements with mean dilatation, which do not lock."""
    mesh = truncated_ellipsoid(HUMAN, 10, 20, 2, 2)
    return replace(
        scene, mesh=mesh, fibres=rule_based_fibres(mesh, angles=HELIX), dilatation="mean", origin={}
    )


def of_another_law(scene: Scene) -> Scene:
    """Guccione's law, of about the same stiffness; it shares the pressure alone."""
    ranges = {"C": ("kPa", 0.3, 0.8), "b_f": ("", 10.0, 20.0), "b_t": ("", 3.0, 7.0),
              "b_fs": ("", 3.0, 7.0)}  # fmt: skip
    own = tuple(Parameter(name, *ends, "log") for name, ends in ranges.items())
    return replace(scene, law=find_law("guccione"), parameters=(*own, PRESSURE), origin={})


def of_other_fibres(scene: Scene) -> Scene:
    """Fibres turned by 15 degrees throughout: 75 to -45 in place of 60 to -60."""
    fibres = rule_based_fibres(scene.mesh, angles=(HELIX[0] + 15.0, HELIX[1] + 15.0))
    return replace(scene, fibres=fibres, origin={})


TRUTHS: dict[str, Callable[[Scene], Scene]] = {
    "": lambda scene: scene,
    "mesh": on_another_mesh,
    "law": of_another_law,
    "fibres": of_other_fibres,
}


@lru_cache(maxsize=1)
def fields_of(body: str, truth: str, states: int, sets: int, name: str) -> tuple[Scene, Any, Any]:
    """The true scene, theta (sets, S, p) and displacement (sets, S, n, 3), of each case its own."""
    scene = TRUTHS[truth](em.load(body).scene)
    rng = np.random.default_rng([SEED, *name.encode()])
    each = np.asarray(scene.from_unit(jnp.asarray(rng.random((sets, len(scene.parameters))))))
    thetas = np.repeat(each[:, None], max(states, 1), axis=1)
    if states:
        thetas[:, :, scene.parameter_names.index("pressure")] = PRESSURES[-states:]
    flat = jnp.asarray(thetas.reshape(-1, thetas.shape[-1]))
    found = run_campaign(Simulator(scene), flat).displacement
    return scene, thetas, np.asarray(found).reshape(*thetas.shape[:2], *found.shape[1:])


def names_of(study: Study) -> list[str]:
    """Suffixes of the load states' names."""
    return [f"@{k + 1}" for k in range(study.states)] or [""]


def observed(study: Study, scene: Scene, at: np.ndarray) -> Observations:
    """What is measured on ``scene``, in every load state."""
    parts: dict[str, Any] = {}
    for state in names_of(study):
        if study.landmarks:
            parts[f"displacement{state}"] = landmarks(scene, at)
        if study.volume is not None:
            parts[f"volume{state}"] = CavityVolume(scene)
    return Observations(parts)


def examine(name: str, study: Study) -> Case:
    """All posteriors of one kind of data."""
    emulator = em.load(study.body)
    at = spread_landmarks(emulator.scene, max(study.landmarks, 1), SEED)
    observe = observed(study, emulator.scene, at)
    sd = {"displacement": study.noise, "volume": study.volume}
    noise = {name: cal.GaussianNoise(sd[name.split("@")[0]]) for name in observe.parts}
    known = {f"pressure@{k + 1}": p for k, p in enumerate(PRESSURES[-study.states :])}
    known = known if study.states else {}
    model = cal.model(emulator.cache(), observe, noise, known=known)
    scene, thetas, fields = fields_of(study.body, study.truth, study.states, study.sets, name)
    true = observed(study, scene, at)
    shared = [n for n in scene.parameter_names if n in model.names] if study.right else (
        [n for n in scene.parameter_names if n in model.names and study.truth != "law"]
        or ["pressure"])  # fmt: skip
    width = prior_sd(model)
    rows, verdicts, reasons, agreement = [], [], [], []
    for r in range(study.sets):
        exact = true(jnp.asarray(fields[r][:, true.nodes]), jnp.asarray(thetas[r]))
        rng = np.random.default_rng([SEED, r, *name.encode()])
        data = {n: np.asarray(v) + noise[n].sd * rng.normal(size=v.shape)
                for n, v in exact.items()}  # fmt: skip
        certified = study.certify and r < CERTIFIED
        posterior = cal.sample(
            model, data, sampler="nuts", seed=r, predictions=False,
            options=NUTSOptions() if certified else OPTIONS,
        )  # fmt: skip
        draws = posterior.draws()
        agreement.append(max(each["r_hat"] for each in posterior.summary().values()))
        row = {}
        for n in shared:
            truth = thetas[r, 0, scene.parameter_names.index(n)]
            low, high = np.quantile(draws[n], [0.5 - 0.5 * LEVEL, 0.5 + 0.5 * LEVEL])
            mean, spread = draws[n].mean(), draws[n].std()
            row[n] = (bool(low <= truth <= high), (mean - truth) / spread, spread / width[n])
        rows.append(row)
        if certified:
            simulator = Simulator(emulator.scene)
            certificate = cal.certify(posterior, simulator, draws=100, seed=r)
            verdicts.append(certificate.verdict)
            reasons.append(certificate.reason)
    told = {k: v for k, v in vars(study).items() if k != "certify"}
    return told | {
        "covered": {n: float(np.mean([row[n][0] for row in rows])) for n in shared},
        "bias_sd": {n: float(np.mean([row[n][1] for row in rows])) for n in shared},
        "z_rms": {n: float(np.sqrt(np.mean([row[n][1] ** 2 for row in rows]))) for n in shared},
        "sd_over_prior": {n: float(np.median([row[n][2] for row in rows])) for n in shared},
        "r_hat": {"median": float(np.median(agreement)), "largest": max(agreement)},
        "verdicts": dict(Counter(verdicts)),
        "reasons": reasons,
    }


def prior_sd(model: cal.Model) -> dict[str, float]:
    """Standard deviation of each unknown's prior."""
    return {name: float(np.sqrt(model.prior[name].variance)) for name in model.names}


def pooled(cases: list[Case]) -> dict[str, tuple[float, int]]:
    """Coverage of all parameters of a body's right models together, and the intervals' number."""
    found = {}
    for body in dict.fromkeys(case["body"] for case in cases):
        right = [c for c in cases if c["body"] == body and c["right"]]
        hits = sum(c["sets"] * v for c in right for v in c["covered"].values())
        count = sum(c["sets"] * len(c["covered"]) for c in right)
        found[body] = (hits / count, count)
    return found


def draw(cases: list[Case], path: Path) -> None:
    """Coverage and width of each kind of data."""
    plt = pyplot()
    figure, panels = plt.subplots(
        1, 2, figsize=(11.0, 1.5 + 0.33 * len(cases)), sharey=True, layout="constrained"
    )
    y = np.arange(len(cases))
    marks = "osv^DXP"
    colours = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
    names = list(dict.fromkeys(name for case in cases for name in case["covered"]))
    for k, name in enumerate(names):
        style = {"color": colours[k % 7], "marker": marks[k % 7], "ls": "none", "mfc": "none"}
        style["label"] = name
        shift = 0.12 * (k % 5 - 2)
        for axes, key in zip(panels, ("covered", "sd_over_prior"), strict=True):
            axes.plot([c[key].get(name, np.nan) for c in cases], y + shift, **style)
    panels[0].axvline(LEVEL, color="0.4", ls="--")
    panels[0].axvspan(0.85, 0.95, color="0.93")
    panels[0].set(xlabel="share of data sets whose 90 % interval covers the truth")
    panels[1].set(xlabel="posterior sd over prior sd, median", xscale="log")
    panels[0].set_yticks(y, [c["name"] + ("" if c["right"] else " (model wrong)") for c in cases])
    panels[0].invert_yaxis()
    for axes in panels:
        axes.grid(color="0.92")
        axes.spines[["top", "right"]].set_visible(False)
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside right upper", frameon=False)
    save(figure, path)


def check(cases: list[Case], *, quick: bool) -> None:
    """The README's claims."""
    if quick:
        assert cases[0]["covered"]["mu"] >= 0.6
        return
    for body, (covered, _) in pooled(cases).items():
        assert 0.85 <= covered <= 0.95, body


def main() -> None:
    """Run the study."""
    arguments = parser(__doc__, HERE)
    arguments.add_argument("--only", nargs="+", default=[], help="cases to run; all by default")
    arguments = arguments.parse_args()
    results = Results(
        arguments.out, SEED, again=arguments.again, settings={"quick": arguments.quick}
    )
    for name, study in (QUICK if arguments.quick else STUDIES).items():
        if name in arguments.only or not arguments.only:
            results.case(name, lambda name=name, study=study: examine(name, study))
    if arguments.only:
        return
    found = {body: {"covered": c, "intervals": n} for body, (c, n) in pooled(results.cases).items()}
    results.write(summary=found)
    draw(results.cases, arguments.out / "verification.png")
    check(results.cases, quick=arguments.quick)


if __name__ == "__main__":
    main()
