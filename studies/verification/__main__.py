"""Are inferred parameters right? Posteriors of many synthetic FEM data sets.

    python -m studies.verification
    python -m studies.verification --quick

Theta is drawn from the prior, FEM makes data of it with noise, on a mesh finer than any that the
model knows, and an emulator and NUTS give a posterior: how often its 90 % interval covers the
truth, its bias, how much narrower it is than the prior, against noise, number of landmarks and of
pressures; for shipped emulators and for those of two meshes. Then models that are wrong: linear
elements, another law, other fibres; and what the certificate says. Writes results.json after each
case, and verification.png.
"""

import tempfile
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from studies.common.figures import COLOURS, pyplot
from studies.common.output import Case, Results, parser, save
from studies.common.two_meshes import on_mesh, on_two_meshes

import calibrate as cal
import emulator as em

HERE = Path(__file__).parent
SEED = 17
LEVEL = 0.9
OPTIONS = cal.samplers.NUTSOptions(warmup=200, draws=250, chains=2, rounds=4, r_hat=1.03, ess=100.0)
CERTIFIED = 2  # posteriors of a case, where it asks for them
PRESSURES = (0.6, 0.9, 1.2)  # kPa, known, of several states


@dataclass(frozen=True)
class Study:
    """One kind of data.

    body : a shipped emulator, or one of MADE. landmarks : their number. noise : sd of one, mm.
    volume : sd in mL, None where none is measured. states : number of known pressures; 0 for one
    that is inferred. truth : the scene that makes the data. sets : of data. right : whether the
    model is. certify : ``first`` or ``worst``, the posteriors that are certified, if any; the worst
    are furthest from the truth in their own sd.
    """

    body: str
    landmarks: int = 24
    noise: float = 0.3
    volume: float | None = None
    states: int = 0
    truth: str = ""
    sets: int = 60
    right: bool = True
    certify: str = ""


BEAM = Study("once_clamped_beam", 20, 0.2, truth="beam")
LIVER = Study("liver", 20, 0.5, truth="liver", sets=30)
VENTRICLE = Study("left_ventricle", volume=1.0, sets=12, truth="ventricle")
STUDIES = {
    "ventricle": replace(VENTRICLE, sets=60, certify="worst"),
    "ventricle, two meshes": replace(VENTRICLE, body="ventricle_two_meshes", sets=60),
    "ventricle, noise / 3": replace(VENTRICLE, noise=0.1, volume=0.33, certify="worst"),
    "ventricle, noise x 3": replace(VENTRICLE, noise=0.9, volume=3.0),
    "ventricle, 6 landmarks": replace(VENTRICLE, landmarks=6),
    "ventricle, volume alone": replace(VENTRICLE, landmarks=0),
    "ventricle, 1 known pressure": replace(VENTRICLE, states=1),
    "ventricle, 2 known pressures": replace(VENTRICLE, states=2),
    "ventricle, 3 known pressures": replace(VENTRICLE, states=3, certify="worst"),
    "ventricle, linear elements": replace(
        VENTRICLE, body="linear_ventricle", right=False, certify="first"
    ),
    "ventricle, Guccione's law": replace(VENTRICLE, truth="law", right=False, certify="first"),
    "ventricle, other fibres": replace(VENTRICLE, truth="fibres", right=False, certify="first"),
    "beam": replace(BEAM, certify="worst"),
    "beam, two meshes": replace(BEAM, body="beam_two_meshes"),
    "beam, noise / 4": replace(BEAM, noise=0.05, certify="worst"),
    "beam, two meshes, noise / 4": replace(BEAM, body="beam_two_meshes", noise=0.05),
    "beam, noise x 4": replace(BEAM, noise=0.8),
    "beam, 5 landmarks": replace(BEAM, landmarks=5),
    "beam, 80 landmarks": replace(BEAM, landmarks=80),
    "liver": replace(LIVER, certify="worst"),
    "liver, two meshes": replace(LIVER, body="liver_two_meshes", truth="liver of three"),
    "liver, noise / 4": replace(LIVER, noise=0.125, certify="worst"),
    "liver, noise x 4": replace(LIVER, noise=2.0),
}
TOO_COARSE = "liver"  # the shipped one, for its data: its certificates and the README say so
FREE_SETS = {"ventricle": 60}  # data sets of whose pressure nothing is known
QUICK = {"beam": replace(STUDIES["beam"], sets=10)}


def of_default(changes: Callable[[em.Scene], em.Scene]) -> Callable[[], em.Scene]:
    """The default ventricle, changed."""
    return lambda: changes(em.scenes.left_ventricle())


def of_another_law(scene: em.Scene) -> em.Scene:
    """Guccione's law, of about the same stiffness; it shares the pressure alone."""
    ranges = {"C": ("kPa", 0.3, 0.8), "b_f": ("", 10.0, 20.0), "b_t": ("", 3.0, 7.0),
              "b_fs": ("", 3.0, 7.0)}  # fmt: skip
    own = tuple(em.Parameter(name, *ends, "log") for name, ends in ranges.items())
    return replace(
        scene, law=em.find_law("guccione"), parameters=(*own, scene.parameters[-1]), origin={}
    )


def of_other_fibres(scene: em.Scene) -> em.Scene:
    """Fibres turned by 15 degrees throughout: 75 to -45 in place of 60 to -60."""
    fibres, _ = em.scenes.Helix((75.0, -45.0)).directions(scene.mesh)
    return replace(scene, fibres=fibres, origin={})


# Three and a half to five times the nodes of the finest mesh that a model of the body knows.
TRUTHS: dict[str, Callable[[], em.Scene]] = {
    "beam": lambda: em.scenes.once_clamped_beam((60, 6, 6)),
    "liver": lambda: em.scenes.liver(10),
    # A ligament that the coarse and the fine mesh cover exactly.
    "liver of three": lambda: em.scenes.liver(9, ligament_shells=3),
    "ventricle": lambda: em.scenes.left_ventricle(20, 40, 4),
    "law": of_default(of_another_law),
    "fibres": of_default(of_other_fibres),
}


# Emulators that are not shipped.
MADE: dict[str, Callable[[Path], em.Emulator]] = {
    "ventricle_two_meshes": lambda at: on_two_meshes(em.scenes.left_ventricle(8, 16, 1), at).fine,
    "beam_two_meshes": lambda at: on_two_meshes(em.scenes.once_clamped_beam(), at).fine,
    "liver_two_meshes": lambda at: on_two_meshes(em.scenes.liver(3, ligament_shells=3), at).fine,
    "linear_ventricle": lambda at: on_mesh(em.scenes.left_ventricle(order=1), at),
}


@lru_cache(maxsize=1)
def emulator_of(body: str) -> em.Emulator:
    """The emulator called ``body``: shipped, or trained."""
    if body not in MADE:
        return em.load(body, kind="series")
    with tempfile.TemporaryDirectory() as folder:
        return MADE[body](Path(folder))


@lru_cache(maxsize=2)
def fields_of(truth: str, states: bool, sets: int) -> tuple[em.Scene, Any, Any]:
    """The true scene, theta (sets, S, p) and displacement (sets, S, n, 3).

    With ``states``, one for each known pressure.
    """
    scene = TRUTHS[truth]()
    rng = np.random.default_rng([SEED, *truth.encode()])
    each = np.asarray(scene.from_unit(jnp.asarray(rng.random((sets, len(scene.parameters))))))
    thetas = np.repeat(each[:, None], len(PRESSURES) if states else 1, axis=1)
    if states:
        thetas[:, :, scene.parameter_names.index("pressure")] = PRESSURES
    flat = jnp.asarray(thetas.reshape(-1, thetas.shape[-1]))
    found = em.fem.run_campaign(em.Simulator(scene), flat, progress=True).displacement
    return scene, thetas, np.asarray(found).reshape(*thetas.shape[:2], *found.shape[1:])


def names_of(study: Study) -> list[str]:
    """Suffixes of the load states' names."""
    return [f"@{k + 1}" for k in range(study.states)] or [""]


def observed(study: Study, scene: em.Scene, at: np.ndarray) -> cal.Observations:
    """What is measured on ``scene``, in every load state."""
    parts: dict[str, Any] = {}
    for state in names_of(study):
        if study.landmarks:
            parts[f"displacement{state}"] = cal.landmarks(scene, at)
        if study.volume is not None:
            parts[f"volume{state}"] = cal.CavityVolume(scene)
    return cal.Observations(parts)


@dataclass(frozen=True, eq=False)
class Setting:
    """All that data sets of one kind share.

    true : what is measured, on the scene that makes the data. shared : parameters that both have.
    """

    name: str
    study: Study
    model: cal.Model
    scene: em.Scene
    true: cal.Observations
    thetas: Any
    fields: Any

    @property
    def shared(self) -> list[str]:
        found = [name for name in self.scene.parameter_names if name in self.model.names]
        return ["pressure"] if self.study.truth == "law" else found

    def data(self, r: int) -> dict[str, np.ndarray]:
        """Data set ``r``."""
        exact = self.true(
            jnp.asarray(self.fields[r][:, self.true.nodes]), jnp.asarray(self.thetas[r])
        )
        rng = np.random.default_rng([SEED, r, *self.name.encode()])
        sd = {"displacement": self.study.noise, "volume": self.study.volume}
        return {
            n: np.asarray(v) + sd[n.split("@")[0]] * rng.normal(size=v.shape)
            for n, v in exact.items()
        }

    def posterior(self, r: int, options: cal.samplers.NUTSOptions) -> cal.Posterior:
        """Draws given data set ``r``, by NUTS."""
        return cal.sample(self.model, self.data(r), options=options, seed=r, predictions=False)


def setting_of(name: str, study: Study) -> Setting:
    """The model and the true fields of one kind of data."""
    emulator = emulator_of(study.body)
    at = cal.spread_landmarks(emulator.scene, max(study.landmarks, 1), SEED)
    observe = observed(study, emulator.scene, at)
    sd = {"displacement": study.noise, "volume": study.volume}
    noise = {name: cal.GaussianNoise(sd[name.split("@")[0]]) for name in observe.parts}
    known = {f"pressure@{k + 1}": p for k, p in enumerate(PRESSURES[-study.states :])}
    model = cal.model(emulator.cache(), observe, noise, known=known if study.states else {})
    # Cases of a body share their fields.
    sets = study.sets if study.states else max(study.sets, FREE_SETS.get(study.truth, 0))
    scene, thetas, fields = fields_of(study.truth, study.states > 0, sets)
    chosen = slice(None) if not study.states else slice(-study.states, None)
    true = observed(study, scene, at)
    return Setting(name, study, model, scene, true, thetas[:, chosen], fields[:, chosen])


def compare(setting: Setting, r: int) -> tuple[dict[str, tuple], float]:
    """Of each shared parameter: covered, (mean - truth) / sd, sd / prior's; and R-hat."""
    posterior, width, row = setting.posterior(r, OPTIONS), prior_sd(setting.model), {}
    draws = posterior.draws()
    for name in setting.shared:
        truth = setting.thetas[r, 0, setting.scene.parameter_names.index(name)]
        low, high = np.quantile(draws[name], [0.5 - 0.5 * LEVEL, 0.5 + 0.5 * LEVEL])
        mean, spread = draws[name].mean(), draws[name].std()
        row[name] = (bool(low <= truth <= high), (mean - truth) / spread, spread / width[name])
    return row, max(each["r_hat"] for each in posterior.summary().values())


def certified(setting: Setting, furthest: list[float]) -> list[cal.Certificate]:
    """Certificates of some posteriors, sampled again at full length."""
    study = setting.study
    order = np.argsort(furthest)[::-1] if study.certify == "worst" else np.arange(study.sets)
    chosen = [int(r) for r in order[:CERTIFIED]] if study.certify else []
    simulator = em.Simulator(setting.model.forward.scene)
    return [
        cal.certify(setting.posterior(r, cal.samplers.NUTSOptions()), simulator, draws=100, seed=r)
        for r in chosen
    ]


def examine(name: str, study: Study) -> Case:
    """All posteriors of one kind of data."""
    setting = setting_of(name, study)
    rows, agreement = zip(*(compare(setting, r) for r in range(study.sets)), strict=True)
    furthest = [max(abs(row[n][1]) for n in setting.shared) for row in rows]
    certificates = certified(setting, furthest)

    def each(k: int) -> dict[str, np.ndarray]:
        return {n: np.array([row[n][k] for row in rows]) for n in setting.shared}

    return vars(study) | {
        "covered": {n: float(v.mean()) for n, v in each(0).items()},
        "bias_sd": {n: float(v.mean()) for n, v in each(1).items()},
        "z_rms": {n: float(np.sqrt(np.mean(v**2))) for n, v in each(1).items()},
        "sd_over_prior": {n: float(np.median(v)) for n, v in each(2).items()},
        "r_hat": {"median": float(np.median(agreement)), "largest": max(agreement)},
        "furthest_sd": furthest,
        "verdicts": dict(Counter(certificate.verdict for certificate in certificates)),
        "reasons": [certificate.reason for certificate in certificates],
    }


def prior_sd(model: cal.Model) -> dict[str, float]:
    """Standard deviation of each unknown's prior."""
    return {name: float(np.sqrt(model.prior[name].variance)) for name in model.names}


def pooled(cases: list[Case]) -> dict[str, tuple[float, int]]:
    """Coverage of all parameters of a body's right models together, and the intervals' number."""
    found = {}
    for body in dict.fromkeys(case["body"] for case in cases if case["right"]):
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
    names = list(dict.fromkeys(name for case in cases for name in case["covered"]))
    for k, name in enumerate(names):
        style = {"color": COLOURS[k % 7], "marker": marks[k % 7], "ls": "none", "mfc": "none"}
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
        assert 0.85 <= covered <= 0.95 or body == TOO_COARSE, body


def main() -> None:
    """Run the study."""
    words = parser(__doc__, HERE)
    words.add_argument("--only", nargs="+", default=[], help="cases to run; all by default")
    arguments = words.parse_args()
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
