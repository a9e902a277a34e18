"""Blood clots in simple shear: one population, and what it says of clots that are not in it.

    python -m studies.blood_clots --data DIR           # C10|C40_T60|T90|T120_x|y|z.csv
    python -m studies.blood_clots --judge DIR          # DIR has C20_T60_x.csv and so on
    python -m studies.blood_clots --data DIR --quick --out OUT

Writes results.json, with 90 % bands of clots of another calcium that nobody here has seen, and
blood_clots.png.
"""

import json
from collections.abc import Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from studies.common.figures import BLUE, ORANGE, pyplot
from studies.common.output import Case, Results, parser, run, save

import calibrate as cal
import emulator as em

HERE = Path(__file__).parent
SEED = 4
CALCIUM, MINUTES, REPLICAS = (10, 40), (60, 90, 120), "xyz"  # mM
SIDE = 10.0  # mm of a cube, told by the articles; an error of its area is one of both moduli
AMOUNTS = np.array([*np.arange(0.05, 0.46, 0.05), 0.475])
SIGNS = np.array([-1.0, 1.0])  # of shear and normal stress, sheared back, to that sheared forth
FORCES = ("shear", "normal")
# Exponents of both signs: shear stress is the same for alpha and -alpha, normal stress is not.
ALPHA_2 = -18.0
PARAMETERS = (
    em.Parameter("mu_1", "kPa", 0.01, 2.0, "log"),
    em.Parameter("alpha_1", "", 4.0, 40.0, "log"),
    em.Parameter("mu_2", "kPa", 0.0005, 0.5, "log"),
)
# What two terms miss of a curve, 3 % of the largest stress over a fifth of the range of shear.
NOISE = cal.CorrelatedNoise(length=0.1, sd=0.003, spatial_sd=0.02)  # kPa

Clots = dict[str, np.ndarray]


def model_of_clots(grips: em.specimens.Grips | None = None) -> cal.Model:
    """The stresses of a clot at all amounts of shear."""
    held = np.ones(len(AMOUNTS))
    given = em.specimens.states({"shear_xz": AMOUNTS, "stretch_x": held, "stretch_z": held})
    scene = em.specimen(
        given, name="clot", law=em.find_law("ogden_2"), parameters=PARAMETERS,
        constants={"alpha_2": ALPHA_2, "kappa": 500.0}, grips=grips,
    )  # fmt: skip
    forward = em.homogeneous(scene, incompressible=True)
    return cal.model(forward, cal.stresses(scene, "stress_xz,stress_zz"), NOISE)


def read(path: Path) -> np.ndarray:
    """Shear and normal stress (m, 2) in kPa at the amounts of shear: the mean of forth and back."""
    if not path.is_file():
        raise em.InputError(f"{path} does not exist; --data names the folder of the tables")
    table = np.genfromtxt(path, delimiter=",", names=True)
    forth, back = (
        np.stack(
            [np.interp(sign * AMOUNTS, table["Strain"], table[n]) for n in ("Fx", "Fz")], axis=1
        )
        for sign in (1.0, -1.0)
    )
    return 0.5e3 * (forth + SIGNS * back) / SIDE**2


def clots_in(folder: Path, calcium: Sequence[int] = CALCIUM) -> Clots:
    """The stresses of every clot, by calcium, minutes and replica."""
    names = [f"C{c}_T{t}_{r}" for c in calcium for t in MINUTES for r in REPLICAS]
    return {name: read(folder / f"{name}.csv") for name in names}


def together(model: cal.Model, clots: Clots, quick: bool) -> cal.population.Hierarchy:
    """The population of clots, of which some have no normal stress."""
    draws = 50 if quick else 300
    options = cal.samplers.NUTSOptions(
        warmup=draws, draws=draws, chains=2, rounds=1 if quick else 2
    )
    members = {name: (model, values) for name, values in clots.items()}
    return cal.population.hierarchy(
        members, options=options, alone="laplace", seed=SEED, progress=True
    )


def band(model: cal.Model, draws: dict[str, np.ndarray]) -> np.ndarray:
    """90 % band (2, m, 2) of the stresses of clots with these parameters, errors included."""
    some = {n: jnp.asarray(values[:: max(len(values) // 500, 1)]) for n, values in draws.items()}

    def one(draw: dict[str, jax.Array], key: jax.Array) -> jax.Array:
        means, _ = model.predict(draw)
        return model.distributions(draw, means)["stress"].sample(key)

    keys = jax.random.split(jax.random.key(SEED), len(next(iter(some.values()))))
    return np.quantile(np.asarray(jax.jit(jax.vmap(one))(some, keys)), [0.05, 0.95], axis=0)


def inside(given: np.ndarray, clots: Clots) -> dict[str, dict[str, float]]:
    """Share of the measured points of each clot within a band (2, m, 2), by force."""
    return {
        name: dict(
            zip(FORCES, np.mean((given[0] <= y) & (y <= given[1]), axis=0).tolist(), strict=True)
        )
        for name, y in clots.items()
    }


def as_case(given: np.ndarray) -> Case:
    """A band by force."""
    ends = dict(zip(("low", "high"), given, strict=True))
    return {
        "amount": AMOUNTS.tolist(),
        **{f"{f}_{e}_kpa": y[:, k].tolist() for e, y in ends.items() for k, f in enumerate(FORCES)},
    }


def held_out(clots: Clots, replica: str, quick: bool) -> Case:
    """Third replicas from the two others, and their normal force from their shear force."""
    model = model_of_clots()
    known = {name: y for name, y in clots.items() if not name.endswith(replica)}
    new = {name: y for name, y in clots.items() if name.endswith(replica)}
    unseen = band(model, together(model, known, quick).new_member())
    sheared = {
        name: np.stack([y[:, 0], np.full(len(y), np.nan)], axis=1) for name, y in new.items()
    }
    # Their model leaves out what is missing, so it is another one than that of the known.
    found = together(model, known | sheared, quick)
    conditional = {name: band(model, found.member(name)) for name in new}
    return {
        "by_two_replicas": inside(unseen, new),
        "normal_by_shear": {n: inside(b, {n: new[n]})[n]["normal"] for n, b in conditional.items()},
        "width_kpa": {
            "by_two_replicas": np.mean(unseen[1] - unseen[0], axis=0).tolist(),
            "normal_by_shear": float(
                np.mean([np.mean(b[1, :, 1] - b[0, :, 1]) for b in conditional.values()])
            ),
        },
    }


def population(clots: Clots, quick: bool) -> Case:
    """All clots as one population, each group against it, and the bands of clots not seen."""
    model = model_of_clots()
    found = together(model, clots, quick)
    means = {
        name: {k: float(np.mean(np.log(found.member(name)[k]))) for k in found.shared}
        for name in found.members
    }
    spread = {k: float(np.std([each[k] for each in means.values()])) for k in found.shared}
    by_group = {n.rpartition("_")[0]: [m for m in means if m[:-2] == n[:-2]] for n in means}
    groups = {
        group: {k: float(np.mean([means[m][k] for m in own])) for k in found.shared}
        for group, own in by_group.items()
    }
    theta = {n: {k: float(np.exp(v)) for k, v in each.items()} for n, each in means.items()}
    missed = [np.asarray(model.predict(theta[name])[0]["stress"]) - y for name, y in clots.items()]
    return {
        "population": {
            n: row
            for n, row in found.summary().items()
            if n.endswith("]") and not any(n.endswith(f"[{member}]") for member in found.members)
        },
        "warnings": list(found.warnings()),
        "logs_of_groups": groups,
        "sd_of_logs": spread,
        "missed_rms_kpa": np.sqrt(np.mean(np.square(missed), axis=(0, 1))).tolist(),
        "bands": as_case(band(model, found.new_member())),
        "inside_own": inside(band(model, found.new_member()), clots),
    }


def plates(clots: Clots, quick: bool) -> Case:
    """What the plates do to the posterior of one clot, by FEM of the cube between them."""
    model = model_of_clots(em.specimens.Grips((SIDE, SIDE, SIDE), cells=2 if quick else 4))
    posterior = cal.sample(model, clots["C10_T90_y"], seed=SEED)
    certificate = cal.certify(posterior, em.homogeneous(model.full.scene), mesh=True, seed=SEED)
    mesh = certificate.to_json()["mesh"]
    return {"posterior": posterior.summary(), "row": mesh, "verdict": certificate.verdict}


def judged(results: Case, folder: Path) -> Case:
    """The share of points of each clot of the kept calcium in the bands."""
    bands = next(case for case in results["cases"] if case["name"] == "population")["bands"]
    ends = [[bands[f"{force}_{end}_kpa"] for force in FORCES] for end in ("low", "high")]
    given = np.moveaxis(np.array(ends), 1, 2)
    return inside(given, clots_in(folder, (20,)))


def draw(cases: dict[str, Case], clots: Clots, path: Path) -> None:
    """The bands of clots not seen, over the clots that made them."""
    figure, axes = pyplot().subplots(1, 2, figsize=(9.0, 3.6), layout="constrained")
    bands = cases["population"]["bands"]
    for k, (axis, force) in enumerate(zip(axes, FORCES, strict=True)):
        ends = bands[f"{force}_low_kpa"], bands[f"{force}_high_kpa"]
        axis.fill_between(bands["amount"], *ends, color=BLUE, alpha=0.2, lw=0)
        for name, y in clots.items():
            color = ORANGE if name.startswith("C40") else BLUE
            axis.plot(AMOUNTS, y[:, k], color=color, lw=0.8, alpha=0.8)
        axis.set(xlabel="amount of shear", ylabel=f"{force} stress, kPa")
        axis.spines[["top", "right"]].set_visible(False)
    save(figure, path)


def main() -> None:
    """Run the study."""
    words = parser(__doc__, HERE)
    words.add_argument("--data", type=Path, help="folder of the tables")
    words.add_argument("--judge", type=Path, metavar="DIR", help="folder of the clots kept apart")
    arguments = words.parse_args()
    if arguments.judge is not None:
        there = json.loads((arguments.out / "results.json").read_text())
        print(json.dumps(judged(there, arguments.judge), indent=2))
        return
    if arguments.data is None:
        raise em.InputError("give --data DIR, the folder of the tables")
    quick = arguments.quick
    clots = clots_in(arguments.data, CALCIUM[:1] if quick else CALCIUM)
    results = Results(arguments.out, SEED, again=arguments.again, settings={"quick": quick})
    results.case("population", lambda: population(clots, quick))
    for replica in REPLICAS[:1] if quick else REPLICAS:
        results.case(f"without {replica}", lambda r=replica: held_out(clots, r, quick))
    if not quick:
        results.case("plates", lambda: plates(clots, quick))
    results.write()
    draw({case["name"]: case for case in results.cases}, clots, arguments.out / "blood_clots.png")


if __name__ == "__main__":
    run(main)
