"""Simulation-based calibration of forward maps, noise models and the default sampler.

``python -m studies.sbc [--replicates N] [--only NAME ...]``. FEM makes the data, the emulator's
posterior is ranked. Writes results.json and a figure a case beside itself, or under --out, after
each case; rows of other cases stay. Asserts what the README says.
"""

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpyro.distributions as dist
from studies.common.output import study_header, write_json

import calibrate as cal
import emulator as em

HERE = Path(__file__).parent
SEED = 11


def shipped(name: str, observe: str, sd: dict[str, float]) -> cal.Model:
    """The model of a built-in body by its emulator."""
    forward = em.load(name).cache()
    observed = cal.parse_observation(forward.scene, observe)
    return cal.model(forward, observed, {key: cal.GaussianNoise(sd[key]) for key in observed.parts})


beam = partial(shipped, "once_clamped_beam", "landmarks:20", {"displacement": 0.2})
ventricle = partial(
    shipped, "left_ventricle", "landmarks:24+volume", {"displacement": 0.3, "volume": 1.0}
)


def noisier(model: cal.Model) -> cal.Model:
    """Data with 1.5 times the noise that the model takes it to have."""
    return replace(model, noise=dict.fromkeys(model.noise, cal.GaussianNoise(sd=0.3)))


def stiffer(model: cal.Model) -> cal.Model:
    """Bodies from the upper half of the prior's range of lam, which the data says little about.

    A prior that the data overrules cannot be found wrong by it: of mu it would pass.
    """
    prior = {**model.prior, "lam": dist.Uniform(75.0, 100.0)}
    return cal.model(model.full, model.observe, model.noise, prior, check_scale=False)


def biased(model: cal.Model) -> cal.Model:
    """Data of a body that moves 2 % more than the map says."""
    return replace(model, forward=Biased(model.forward))


@dataclass(frozen=True, eq=False)
class Biased:
    """A forward map whose displacements are 2 % too large."""

    inner: Any

    def __getattr__(self, name: str) -> Any:
        return getattr(self.inner, name)

    def evaluate(self, theta: Any) -> Any:
        """Displacement and validity."""
        found = self.inner.evaluate(theta)
        return found._replace(displacement=1.02 * found.displacement)


def specimen() -> cal.Model:
    """Three biaxial tests of a wall with two families of dispersed fibres, incompressible."""
    strains = np.linspace(0.02, 0.2, 10)
    stretches = np.concatenate([1.0 + np.outer(strains, r) for r in ((1, 1), (1, 0.5), (0.5, 1))])
    scene = em.specimen(
        {"stretch_x": stretches[:, 0], "stretch_y": stretches[:, 1]},
        ordered=False,
        law=em.find_law("gasser_ogden_holzapfel"),
        parameters=(
            em.Parameter("c", "kPa", 5.0, 50.0),
            em.Parameter("k_1", "kPa", 5.0, 50.0),
            em.Parameter("k_2", "", 1.0, 15.0),
            em.Parameter("dispersion", "", 0.02, 0.3),
        ),
        constants={"angle": 35.0, "kappa": 1e4},
        fibres=[1.0, 0.0, 0.0],
        sheets=[0.0, 1.0, 0.0],
    )
    forward = em.homogeneous(scene, incompressible=True)
    return cal.model(forward, cal.stresses(scene, "cauchy_x,cauchy_y"), cal.GaussianNoise(sd=2.0))


def relaxing() -> cal.Model:
    """A tissue that relaxes, pulled at two rates, held and let go, incompressible."""
    held = np.array([1.3, 2.0, 4.0, 8.0, 15.0, 30.0])
    columns, stretches = [], []
    for rate in (1.0, 0.1):
        pulled, end = np.linspace(0.2, 1.0, 5) / rate, held + 1.0 / rate
        columns.append(np.concatenate([pulled, end, end[-1:] + np.array([0.5, 1.0]) / rate]))
        stretches.append(1.0 + 0.15 * np.array([*np.linspace(0.2, 1.0, 5), *np.ones(6), 0.5, 0.0]))
    scene = em.specimen(
        {
            "protocol": ["fast"] * 13 + ["slow"] * 13,
            "time": np.concatenate(columns),
            "stretch_x": np.concatenate(stretches),
        },
        viscosity={"kind": "prony", "terms": 1},
        law=em.find_law("yeoh"),
        parameters=(
            em.Parameter("c_1", "kPa", 1.0, 20.0),
            em.Parameter("c_2", "kPa", 1.0, 40.0),
            em.Parameter("relaxation_1", "", 0.1, 0.9),
            em.Parameter("tau_1", "s", 0.3, 30.0, "log"),
        ),
        constants={"c_3": 1.0, "kappa": 1e4},
    )
    forward = em.homogeneous(scene, incompressible=True)
    return cal.model(forward, cal.stresses(scene, "stress_x"), cal.GaussianNoise(sd=0.2))


@dataclass(frozen=True)
class Case:
    """A model, who makes its data, and whether the check should pass."""

    title: str
    make: Callable[[], cal.Model]
    truth: Callable[[cal.Model], cal.Model]
    passes: bool


CASES = {
    "beam": Case("beam", beam, cal.by_fem, passes=True),
    "ventricle": Case("left ventricle", ventricle, cal.by_fem, passes=True),
    "specimen": Case("biaxial specimen", specimen, lambda model: model, passes=True),
    "relaxing": Case("specimen that relaxes", relaxing, lambda model: model, passes=True),
    "noise": Case("beam, 1.5 times the model's noise", beam, noisier, passes=False),
    "prior": Case("beam, lam from the upper half of its range", beam, stiffer, passes=False),
    "map": Case("beam, 2 % more displacement", beam, biased, passes=False),
}


def examine(name: str, replicates: int, out: Path) -> dict[str, Any]:
    """Ranks of one case, with its figure."""
    case, began = CASES[name], time.process_time()
    model = case.make()
    options = cal.samplers.AutoOptions(
        200, 250, 2, rounds=1
    )  # importance sampling, NUTS where that fails
    found = cal.sbc(model, replicates, truth=case.truth(model), options=options, seed=SEED)
    cal.calibration_figure(found, case.title, out / f"{name}.png")
    result = found.to_json()
    seconds = time.process_time() - began
    verdict = "calibrated" if found.passed else "not calibrated"
    print(f"{case.title:45s} {found.replicates} data sets, {seconds:4.0f} s: {verdict}", flush=True)
    return {
        "name": name,
        "title": case.title,
        "status": verdict,
        "as_expected": found.passed == case.passes,
        "processor_s": round(seconds, 1),
        **{key: result[key] for key in ("replicates", "outside", "coverage", "ranks")},
    }


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--replicates", type=int, default=200)
    parser.add_argument("--only", nargs="+", choices=tuple(CASES), default=tuple(CASES))
    parser.add_argument("--out", type=Path, default=HERE)
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    path = arguments.out / "results.json"
    rows = (
        {row["name"]: row for row in json.loads(path.read_text())["cases"]} if path.exists() else {}
    )
    for name in arguments.only:
        rows[name] = examine(name, arguments.replicates, arguments.out)
        ordered = [rows[case] for case in CASES if case in rows]
        write_json(path, {**study_header(HERE, SEED), "cases": ordered})
    assert all(rows[name]["as_expected"] for name in arguments.only)


if __name__ == "__main__":
    main()
