"""Twins: skins of FEM whose truth is known, inferred with errors that correlate and without."""

import jax
import jax.numpy as jnp
import numpy as np
from studies.common.output import Case, Results
from studies.living_skin.bands import ALONG, FORCE_SD, LENGTH, SD
from studies.living_skin.skin import FORCE, Measured

import calibrate as cal
import emulator as em
from calibrate.measurements.full_field import field_data
from calibrate.statistical_model.errors import with_described_errors
from emulator.core.errors import SolverError
from emulator.scenes import Scene
from emulator.surrogates.protocol import ForwardMap

SIZE = 0.05  # mm, of the twins' errors that correlate
_ERROR = {
    "kind": "field", "of": "displacement", "along": "pull", "length": LENGTH, "along_length": ALONG,
}  # fmt: skip


def twins_of(
    scene: Scene, forward: ForwardMap, measured: Measured, frames: tuple[str, ...], count: int,
    results: Results,
) -> list[Case]:  # fmt: skip
    """Inference of ``count`` skins without a field of stiffness, seen as the keloid was."""
    seen = measured.field.only(frames, measured.chosen)
    observe, shapes = field_data(scene, seen, measured.amounts)
    parts = {
        **observe.parts,
        **{f"{FORCE}@{frame}": cal.Reaction(scene, "moving", "x") for frame in frames},
    }
    known = {f"pull@{frame}": measured.amounts[frame] for frame in frames}

    def model(sd: dict[str, float]) -> cal.Model:
        noise = {"displacement": cal.GaussianNoise(**sd), FORCE: cal.GaussianNoise(sd=FORCE_SD)}
        return cal.model(forward, parts, noise, known=known)

    plain = model({"sd": SD})
    stand_in = {name: np.asarray(values) for name, values in shapes.items()}
    stand_in |= {f"{FORCE}@{f}": np.array(measured.force(measured.amounts[f])) for f in frames}
    # Modes of the error do not depend on data: one model, and its programs, serve all twins.
    truth_of, _ = with_described_errors(plain, stand_in, {"missed": {**_ERROR, "sd": SIZE}})
    told, _ = with_described_errors(plain, stand_in, {"missed": {**_ERROR, "sd_scale": 0.1}})
    independent = model({"sd_scale": 0.1}).given(stand_in)[0]
    simulator = em.Simulator(scene)

    def twin(number: int) -> Case:
        rng, key = np.random.default_rng(number), jax.random.key(number)
        for attempt in range(20):
            drawn = plain.prior_draws(jax.random.fold_in(key, attempt), 1)
            truth = {name: float(values[0]) for name, values in drawn.items()}
            draw = {name: jnp.asarray(value) for name, value in truth.items()}
            thetas = truth_of.states.thetas(draw)
            try:
                fields = [simulator.solve(t).require_converged().displacement for t in thetas]
                break
            except SolverError:
                continue
        u = jnp.stack(fields)[:, truth_of.observe.nodes]
        means = truth_of.fem_means(key, draw, truth_of.observe(u, thetas))
        data = {
            name: np.asarray(mean) + truth_of.noise[name].simulate(rng, np.shape(mean))
            for name, mean in means.items()
        }
        return {
            "truth": truth,
            "correlated": _inside(told, data, truth),
            "independent": _inside(independent, data, truth),
        }

    return [results.case(f"twin {k}", lambda k=k: twin(k)) for k in range(count)]


def _inside(model: cal.Model, data: dict[str, np.ndarray], truth: dict[str, float]) -> Case:
    # A hundred thousand forces, as importance sampling asks for, would take four minutes a twin.
    options = cal.LaplaceOptions(draws=300, starts=2)
    found = cal.sample(model, data, sampler="laplace", options=options, seed=1, predictions=False)
    rows = {}
    for name, values in found.draws().items():
        if name in truth:
            low, high = (float(x) for x in np.quantile(values, (0.05, 0.95)))
            rows[name] = {"low": low, "high": high, "inside": bool(low <= truth[name] <= high)}
    return rows


def coverage(cases: list[Case]) -> Case:
    """The share of twins whose 90 % interval holds the truth, by the errors that were assumed."""
    return {
        way: {
            name: float(np.mean([case[way][name]["inside"] for case in cases]))
            for name in cases[0][way]
        }
        for way in ("correlated", "independent")
        if cases
    }
