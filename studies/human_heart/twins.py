"""Twins: hearts of FEM whose truth is known, inferred as the heart is."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from studies.common.output import Case
from studies.human_heart.heart import SURFACES

import calibrate as cal
import emulator as em

_SD, _SPATIAL_SD = 0.3, 1.2  # mm, of what a fitted surface misses
AT_REST = {"pressure": 0.0, "right_pressure": 0.0}


def unloaded_volumes(
    found: cal.Posterior, scene: em.Scene, cavities: tuple[str, ...] = SURFACES[:2]
) -> dict[str, np.ndarray]:
    """Draws of the volume in mL of each cavity without pressure."""
    state = next(iter(found.model.states.states))
    at_rest = {name: 0.0 for name in AT_REST if name in scene.parameter_names}
    return {
        f"unloaded {name}": found.predict(at_rest, cal.CavityVolume(scene, name), state=state)
        for name in cavities
    }


def twin(
    number: int,
    model: cal.Model,
    scene: em.Scene,
    sample: Callable[[cal.Model, dict[str, np.ndarray]], cal.Posterior],
) -> Case:
    """Intervals of one twin, and its truth; one that FEM does not solve is drawn again."""
    simulator, rng = em.Simulator(scene), np.random.default_rng(number)
    for attempt in range(20):
        drawn = model.prior_draws(jax.random.key(100 * number + attempt), 1)
        truth = {name: float(values[0]) for name, values in drawn.items()}
        thetas = model.states.thetas({name: jnp.asarray(value) for name, value in truth.items()})
        try:
            u = jnp.stack([_solved(simulator, theta) for theta in thetas])
            empty = thetas[0]
            for load, value in AT_REST.items():
                empty = empty.at[scene.parameter_names.index(load)].set(value)
            at_rest = _solved(simulator, empty)
            break
        except em.SolverError:
            continue
    data = {}
    for name, mean in model.observe(u[:, model.observe.nodes], thetas).items():
        noise = model.noise[name]
        if isinstance(noise, cal.CorrelatedNoise):
            known = cal.CorrelatedNoise(noise.length, sd=_SD, spatial_sd=_SPATIAL_SD)
            noise = known.at(noise.sites)
        data[name] = np.asarray(mean) + noise.simulate(rng, np.shape(mean))
    for name in SURFACES[:2]:
        cavity = cal.CavityVolume(scene, name)
        truth[f"unloaded {name}"] = float(cavity(at_rest[cavity.nodes], empty))
    found = sample(*model.given(data))
    held: Case = {}
    for name, values in {**found.draws(), **unloaded_volumes(found, scene)}.items():
        if name not in truth:  # noise
            continue
        low, high = (float(x) for x in np.quantile(values, (0.05, 0.95)))
        held[name] = {"truth": truth[name], "low": low, "high": high}
        held[name]["inside"] = bool(low <= truth[name] <= high)
    r_hat = max(row["r_hat"] for row in found.summary().values())
    return {"inside": held, "divergences": found.divergences, "r_hat": r_hat}


def _solved(simulator: em.Simulator, theta: jax.Array) -> jax.Array:
    return simulator.solve(theta).require_converged().displacement


def coverage(cases: list[Case]) -> Case:
    """How many twins' intervals hold the truth, by unknown."""
    names = cases[0]["inside"] if cases else ()
    return {
        name: {"inside": sum(c["inside"][name]["inside"] for c in cases), "twins": len(cases)}
        for name in names
    }
