"""The tests of muscle as specimens: time, stretch and stress, and laws with and without time."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import calibrate as cal
import emulator as em

DIRECTIONS = ("A", "B")
_NAME = re.compile(r"([AB])_(\d+)_([\d.]+)")
SPAN = (0.3, 1000.0)  # s, of the relaxation times that terms share, in equal ratios
NOISE = cal.CorrelatedNoise(length=0.1, sd_scale=0.03, spatial_sd_scale=0.05)  # kPa


@dataclass(frozen=True)
class Curve:
    """A direction pressed by ``percent`` at ``rate`` (% a second), and held.

    time (s), stretch, stress (Cauchy, kPa) : of each point, (k,).
    """

    direction: str
    percent: float
    rate: float
    time: np.ndarray
    stretch: np.ndarray
    stress: np.ndarray

    @property
    def name(self) -> str:
        """As the files are called."""
        return f"{self.direction}_{self.percent:g}_{self.rate:g}"


def read(folder: Path, every: int = 1) -> list[Curve]:
    """The curves of a folder, each ``every``-th point of them."""
    paths = sorted(path for path in folder.glob("*.csv") if _NAME.fullmatch(path.stem))
    if not paths:
        raise em.InputError(f"{folder} has no tables such as A_30_1.csv; give --data DIR")
    curves = []
    for path in paths:
        direction, percent, rate = _NAME.fullmatch(path.stem).groups()  # type: ignore[union-attr]
        table = np.loadtxt(path, delimiter=",", skiprows=1)[::every]
        time, stretch, stress = table[np.maximum.accumulate(table[:, 0]) <= table[:, 0]].T
        curves.append(Curve(direction, float(percent), float(rate), time, stretch, stress))
    return curves


def pressed(direction: str, percent: float, rate: float, hold: float = 300.0) -> Curve:
    """A curve that nobody measured: a ramp in steps of 1/20, and a hold in growing steps."""
    end = percent / rate
    time = np.concatenate([np.linspace(0.0, end, 21), end + np.geomspace(0.05 * end, hold, 20)])
    stretch = 1.0 - 0.01 * np.minimum(rate * time, percent)
    return Curve(direction, percent, rate, time, stretch, np.full(len(time), np.nan))


def _ratios(count: int) -> list[tuple[float, float]]:
    """Ranges of relaxation times, one after the other."""
    ends = np.geomspace(*SPAN, count + 1)
    return [(float(low), float(high)) for low, high in pairwise(ends)]


def parameters(model: str) -> tuple[Any, ...]:
    """Entries of theta: of an isotropic exponential, and of its relaxation."""
    law = (em.Parameter("a", "kPa", 0.05, 10.0, "log"), em.Parameter("b", "", 0.05, 20.0, "log"))
    if model == "elastic":
        return law
    if model == "spectrum":
        return (
            *law,
            em.Parameter("spectrum", "", 0.01, 10.0, "log"),
            em.Parameter("tau_1", "s", 0.01, 10.0, "log"),
            em.Parameter("tau_2", "s", 30.0, 1e5, "log"),
        )
    terms = []
    for k, (low, high) in enumerate(_ratios(int(model)), 1):
        terms.append(em.Parameter(f"relaxation_{k}", "", 0.01, 0.99))
        terms.append(em.Parameter(f"tau_{k}", "s", low, high, "log"))
    return (*law, *terms)


def scene_of(model: str, curves: Sequence[Curve]) -> Any:
    """The specimen in the states of some curves."""
    viscosity: dict[str, Any] | None = {"kind": "prony", "terms": None}
    if model == "elastic":
        viscosity = None
    elif model == "spectrum":
        viscosity = {"kind": "spectrum", "terms": 8}
    elif viscosity is not None:
        viscosity["terms"] = int(model)
    tests = [curve.name for curve in curves for _ in curve.time]
    stretch = np.concatenate([curve.stretch for curve in curves])
    # An isotropic law shortens along x and widens evenly; said, it leaves nothing to solve for.
    columns = {"stretch_x": stretch, "stretch_y": stretch**-0.5}
    return em.specimen(
        em.specimens.states(columns, tests, timed=True),
        name=f"muscle, {model}",
        times=np.concatenate([curve.time for curve in curves]),
        viscosity=viscosity,
        law=em.find_law("holzapfel_ogden_isotropic"),
        parameters=parameters(model),
        constants={"kappa": 1e4},  # which an incompressible map does not read
    )


def posterior_of(model: str, curves: Sequence[Curve], seed: int, quick: bool) -> cal.Posterior:
    """The posterior of some curves, with the errors' sds."""
    scene = scene_of(model, curves)
    forward = em.homogeneous(scene, incompressible=True)
    data = np.concatenate([curve.stress for curve in curves])[:, None]
    statistical = cal.model(forward, cal.stresses(scene, "cauchy_x"), NOISE)
    options = cal.samplers.ImportanceOptions(draws=100 if quick else 1000)
    return cal.sample(statistical, data, sampler="importance", options=options, seed=seed)


def stresses(model: str, thetas: np.ndarray, curves: Sequence[Curve]) -> list[np.ndarray]:
    """Cauchy stresses (s, k) in kPa along each curve, at ``thetas`` (s, p)."""
    scene = scene_of(model, curves)
    forward, observe = em.homogeneous(scene, incompressible=True), cal.stresses(scene, "cauchy_x")
    one = lambda theta: observe(forward(theta), theta)[:, 0]  # noqa: E731
    program = jax.jit(lambda thetas: jax.lax.map(one, thetas, batch_size=50))
    ends = np.cumsum([len(curve.time) for curve in curves])[:-1]
    return np.split(np.asarray(program(jnp.asarray(thetas))), ends, axis=1)
