"""Which parameter moves which observation: known functions, and ventricles by emulator and FEM.

    python -m studies.sensitivity
    python -m studies.sensitivity --quick

Sobol' indices of two functions whose indices are known in closed form; those of the ventricle's
volume and landmarks by its emulator and by FEM on the same theta, with the bounds that derivatives
give; the same for a prior that is not uniform, and for groups; every node's displacement; and the
stiffness of the 17 segments by Morris' screening with FEM. Writes results.json after each case, and
three figures.
"""

from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from studies.common.output import Case, Results, parser, save

import calibrate as cal
import emulator as em
from calibrate.analysis.sensitivity import Factors, analyse
from calibrate.figures import BLUE, GREEN, ORANGE, pyplot
from calibrate.figures.sensitivity import body_figure
from calibrate.measurements import CavityVolume, Observations, landmarks, spread_landmarks
from calibrate.priors import truncated_normal
from emulator.surrogates.fem import fem_forward

HERE = Path(__file__).parent
SEED = 2
SCENE = "left_ventricle"
FIRST = {"ishigami": (0.3139, 0.4424, 0.0)}
TOTAL = {"ishigami": (0.5576, 0.4424, 0.2437)}
A_OF_G = np.array([0.0, 1.0, 4.5, 9.0])
SIZES = {"known": 1024, "emulator": 512, "fem": 64, "segments": 24}
QUICK = {"known": 512, "emulator": 64, "fem": 8, "segments": 0}
GROUPS = {"matrix": ("a", "b"), "fibres": ("a_f", "b_f")}


def ishigami(points: np.ndarray) -> np.ndarray:
    """Ishigami and Homma (1990) with a = 7 and b = 0.1."""
    z = np.pi * (2.0 * points - 1.0)
    return np.sin(z[:, 0]) + 7.0 * np.sin(z[:, 1]) ** 2 + 0.1 * z[:, 2] ** 4 * np.sin(z[:, 0])


def sobol_g(points: np.ndarray) -> np.ndarray:
    """Sobol' (1993), a product."""
    return np.prod((np.abs(4.0 * points - 2.0) + A_OF_G) / (1.0 + A_OF_G), axis=1)


def exact_g() -> tuple[np.ndarray, np.ndarray]:
    """First and total indices of :func:`sobol_g`."""
    own = 1.0 / (3.0 * (1.0 + A_OF_G) ** 2)
    variance = np.prod(1.0 + own) - 1.0
    others = [np.prod(1.0 + np.delete(own, k)) for k in range(len(own))]
    return own / variance, own * np.array(others) / variance


def known(name: str, samples: int) -> Case:
    """Indices of a known function, with the exact ones."""
    function, count = (ishigami, 3) if name == "ishigami" else (sobol_g, 4)
    factors = Factors(tuple(f"x{k + 1}" for k in range(count)))
    found = analyse(factors, function, samples=samples, seed=SEED)
    exact = (FIRST[name], TOTAL[name]) if name == "ishigami" else exact_g()
    return {
        **indices(found),
        "exact_first": list(map(float, exact[0])),
        "exact_total": list(map(float, exact[1])),
    }


def indices(found: xr.Dataset) -> Case:
    """Indices of all outputs together and their intervals, as plain JSON."""
    names = ("first", "total")
    data = {"factors": [str(name) for name in found["factor"].values]}
    for name in names:
        data[name] = found[f"{name}_together"].values.tolist()
        data[f"{name}_half_width"] = found[f"{name}_together_half_width"].values.tolist()
    return data | {"evaluations": int(found.attrs["evaluations"])}


def observed(scene: em.Scene) -> Observations:
    """24 landmarks and the cavity's volume."""
    at = spread_landmarks(scene, 24, SEED)
    return Observations({"displacement": landmarks(scene, at), "volume": CavityVolume(scene)})


def normal_prior(scene: em.Scene) -> dict[str, Any]:
    """A prior of 10 % about the centre."""
    return {
        p.name: truncated_normal(float(c), 0.1 * float(c), p.low, p.high)
        for p, c in zip(scene.parameters, scene.centre, strict=True)
    }


def ventricle(results: Results, sizes: dict[str, int]) -> xr.DataTree:
    """All cases of the ventricle; the nodewise indices."""
    trained = em.load(SCENE, kind="series")
    scene, cached = trained.scene, trained.cache()
    observe = observed(scene)
    fem = fem_forward(em.Simulator(scene), start=cached)

    def by(forward: Any, samples: int, **more: Any) -> Case:
        found = cal.sensitivity(forward, observe, samples=samples, seed=SEED, **more)
        return {name: indices(found[name].to_dataset()) for name in observe.parts}

    results.case("ventricle, FEM", lambda: by(fem, sizes["fem"]))
    results.case("ventricle, emulator, FEM's theta", lambda: by(cached, sizes["fem"]))
    results.case("ventricle, emulator", lambda: by(cached, sizes["emulator"]))
    prior = normal_prior(scene)
    results.case("ventricle, prior of 10 %", lambda: by(cached, sizes["emulator"], prior=prior))
    results.case("ventricle, groups", lambda: by(cached, sizes["emulator"], groups=GROUPS))

    def bounds() -> Case:
        found = cal.sensitivity(cached, observe, method="derivatives", samples=256, seed=SEED)
        return {
            name: {
                "factors": list(scene.parameter_names),
                "bound": found[name]["bound_on_total_together"].values.tolist(),
                "active_direction": found[name]["active_direction"].values[:, 0].tolist(),
                "active_share": float(
                    found[name]["active_value"].values[0] / found[name]["active_value"].sum()
                ),
            }
            for name in observe.parts
        }

    results.case("ventricle, bounds by derivatives", bounds)
    return cal.sensitivity(cached, field=True, samples=min(64, sizes["emulator"]), seed=SEED)


def segments(samples: int) -> Case:
    """Morris' screening of 17 stiffnesses and the pressure, by FEM."""
    scene = em.scenes.left_ventricle_segments(order=1)
    found = cal.sensitivity(
        fem_forward(em.Simulator(scene)), observed(scene), method="morris", samples=samples,
        seed=SEED,
    )  # fmt: skip
    return {
        name: {
            "factors": [str(label) for label in data["factor"].values],
            "mu_star": data["mu_star_together"].values.tolist(),
            "unit": data.attrs["unit"],
            "evaluations": int(data.attrs["evaluations"]),
        }
        for name, data in ((n, found[n].to_dataset()) for n in ("displacement", "volume"))
    }


def draw_indices(cases: dict[str, Case], path: Path) -> None:
    """Total indices of volume and landmarks: FEM, emulator, bound; and of a narrow prior."""
    plt = pyplot()
    figure, panels = plt.subplots(1, 2, figsize=(9.5, 3.8), sharey=True, layout="constrained")
    shown = {
        "ventricle, FEM": ("FEM, total", GREEN),
        "ventricle, emulator": ("emulator, total", BLUE),
        "ventricle, prior of 10 %": ("emulator, total, prior of 10 %", ORANGE),
    }
    for axes, name in zip(panels, ("displacement", "volume"), strict=True):
        factors = cases["ventricle, FEM"][name]["factors"]
        y = np.arange(len(factors))
        for k, (case, (label, colour)) in enumerate(shown.items()):
            data = cases[case][name]
            axes.barh(
                y + 0.26 * (k - 1), data["total"], 0.24, xerr=data["total_half_width"],
                color=colour, label=label, error_kw={"lw": 0.8},
            )  # fmt: skip
        bound = cases["ventricle, bounds by derivatives"][name]["bound"]
        axes.vlines(
            bound, y - 0.39, y + 0.13, color="black", lw=1.8, label="bound on both by derivatives"
        )
        axes.set(yticks=y, yticklabels=factors, xlabel="share of the variance", title=name)
        axes.spines[["top", "right"]].set_visible(False)
    panels[0].invert_yaxis()
    panels[1].legend(frameon=False, fontsize="small", loc="upper right")
    save(figure, path)


def draw_segments(case: Case, path: Path) -> None:
    """Mean absolute effects of the segments' stiffness and of the pressure."""
    plt = pyplot()
    figure, panels = plt.subplots(1, 2, figsize=(9.5, 4.6), sharey=True, layout="constrained")
    for axes, name in zip(panels, ("displacement", "volume"), strict=True):
        y = np.arange(len(case[name]["factors"]))
        axes.barh(y, case[name]["mu_star"], color=BLUE)
        axes.set(yticks=y, yticklabels=case[name]["factors"], title=name)
        axes.set_xlabel(f"mean absolute effect over the range, {case[name]['unit']}")
        axes.spines[["top", "right"]].set_visible(False)
    panels[0].invert_yaxis()
    save(figure, path)


def check(cases: dict[str, Case]) -> None:
    """The README's claims."""
    for name in ("ishigami", "sobol g"):
        case = cases[name]
        for index in ("first", "total"):
            off = np.abs(np.subtract(case[index], case[f"exact_{index}"]))
            assert (off <= np.array(case[f"{index}_half_width"]) + 1e-3).all(), (name, index)
    fem, emulator = cases["ventricle, FEM"], cases["ventricle, emulator, FEM's theta"]
    for name in ("displacement", "volume"):
        for index in ("first", "total"):
            off = np.abs(np.subtract(fem[name][index], emulator[name][index]))
            assert (off <= fem[name][f"{index}_half_width"]).all()
            assert (off <= emulator[name][f"{index}_half_width"]).all()
        bound = cases["ventricle, bounds by derivatives"][name]["bound"]
        assert (np.array(bound) >= cases["ventricle, emulator"][name]["total"]).all()


def main() -> None:
    """Run the study."""
    arguments = parser(__doc__, HERE).parse_args()
    sizes = QUICK if arguments.quick else SIZES
    results = Results(arguments.out, SEED, again=arguments.again, settings=sizes)
    for name in ("ishigami", "sobol g"):
        results.case(name, lambda name=name: known(name, sizes["known"]))
    field = ventricle(results, sizes)
    cases = {case["name"]: case for case in results.cases}
    if sizes["segments"]:
        case = results.case("segments, FEM", lambda: segments(sizes["segments"]))
        draw_segments(case, arguments.out / "segments.png")
    draw_indices(cases, arguments.out / "indices.png")
    save(body_figure(field, em.load(SCENE, kind="series").scene), arguments.out / "body.png")
    check(cases)


if __name__ == "__main__":
    main()
