"""A rung's errors and times.

Two errors, each the root mean square over the observed points: against FEM on the same mesh, taken
two Newton steps beyond its tolerance (what the rung adds), and against a mesh so fine that it
stands for the truth (what its user gets). Both solutions are kept in ``references/``.
"""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from studies.accuracy_vs_time.rungs import CLOCK, COMPILED, Place, Rung, Solve
from studies.common.output import Case, replacing
from studies.common.timing import per_call, unseen

import calibrate as cal
import emulator as em

TEST_SEED = 90_210
_FAST, _MANY_CALLS = 1e-3, 1000  # seconds of a call, below which so many are timed


class References(NamedTuple):
    """``tests`` (c, p), and the points' displacements (c, d, 3) mm on the own mesh and in truth.

    truth : NaN where no finer mesh is known.
    """

    tests: np.ndarray
    exact: np.ndarray
    truth: np.ndarray


def references(place: Place, folder: Path) -> References:
    """Those in ``folder`` if they are of this body, else new ones, which are kept there."""
    make = (lambda: place.scene) if place.quick else place.body.truth
    truth = make and make()
    tests = em.fem.sobol(place.scene, 2 if place.quick else place.body.tests, TEST_SEED)
    finest = truth.fingerprint if truth else "none"
    made_of = "/".join((place.scene.fingerprint, finest, str(len(tests))))
    path = folder / f"{place.name.replace(' ', '_')}.npz"
    if path.is_file():
        with np.load(path, allow_pickle=False) as there:
            if str(there["made_of"]) == made_of:
                return References(there["tests"], there["exact"], there["truth"])
    small = len(place.scene.mesh.nodes) < COMPILED
    exact = solved(place.scene, place.at, tests, steps=2 if small else 0)
    if truth is None:
        fine = np.full_like(exact, np.nan)
    else:
        fine = exact if place.quick else solved(truth, place.at, tests)
    found = References(np.asarray(tests), exact, fine)
    with replacing(path) as temporary:
        np.savez_compressed(temporary, made_of=made_of, **found._asdict())
    return found


def solved(scene: em.Scene, at: np.ndarray, tests: jax.Array, *, steps: int = 0) -> np.ndarray:
    """FEM's displacements (c, d, 3) mm of the points, ``steps`` Newton steps beyond tolerance."""
    simulator, observe = em.Simulator(scene), cal.landmarks(scene, at)
    fields = list(em.fem.run_campaign(simulator, tests).displacement)
    if steps:
        beyond = jax.jit(lambda u, theta: _beyond(simulator, u, theta, steps))
        fields = [beyond(u, theta) for u, theta in zip(fields, tests, strict=True)]
    return np.stack([np.asarray(observe(u[observe.nodes], None)) for u in fields])


def _beyond(simulator: em.Simulator, u: jax.Array, theta: jax.Array, steps: int) -> jax.Array:
    """``u`` (n, 3) mm after some Newton steps."""
    for _ in range(steps):
        u = em.newton_step(simulator.system, u, theta)
    return u


def measure(rung: Rung, place: Place, known: References) -> Case:
    """Errors and times of a rung; of one that refuses, its line."""
    try:
        with jax.enable_x64(not rung.narrow):
            return _measured(rung, place, known)
    except em.InputError as error:
        return {"status": f"refused: {error}", "kind": rung.kind, "rung": rung.name}


def _measured(rung: Rung, place: Place, known: References) -> Case:
    value, gradient = rung.solve, jax.grad(lambda theta: jnp.sum(rung.solve(theta) ** 2))
    if rung.compiled:
        value, gradient = jax.jit(value), jax.jit(gradient)
    found = [np.asarray(value(theta)) for theta in map(jnp.asarray, known.tests)]
    if rung.narrow and found[0].dtype != np.float32:
        raise em.InputError(f"computes in {found[0].dtype}")
    # FEM on another mesh has no error of its own to speak of.
    own = rung.scene.fingerprint == place.scene.fingerprint
    return {
        "nodes": len(rung.scene.mesh.nodes),
        "kind": rung.kind,
        "rung": rung.name,
        **errors(rung.scene, place, known, found, full=rung.full, own=own),
        "value_s": _seconds(value, rung),
        "gradient_s": _seconds(gradient, rung),
        "offline_s": rung.offline_s,
        "fem_runs": rung.fem_runs,
    }


def errors(
    scene: em.Scene,
    place: Place,
    known: References,
    found: list[np.ndarray],
    *,
    full: bool,
    own: bool,
) -> Case:
    """Both errors of displacements at the tests, of the observed nodes or of all (``full``)."""
    with jax.enable_x64(True):  # what is measured may be in float32, what measures is not
        observe = cal.landmarks(scene, place.at)
        rows = observe.nodes if full else slice(None)
        wide = [jnp.asarray(np.asarray(u, dtype=float)[rows]) for u in found]
        seen = np.stack([np.asarray(observe(u, None)) for u in wide])
    return {
        "own_mm": _spread(seen - known.exact) if own else None,
        "truth_mm": _spread(seen - known.truth) if np.isfinite(known.truth).all() else None,
    }


def _spread(gap: np.ndarray) -> dict[str, float]:
    """Root mean squares over the points (c, d, 3): median and largest over theta, mm."""
    each = np.sqrt(np.mean(np.sum(gap**2, axis=-1), axis=-1))
    return {"median": float(np.median(each)), "max": float(each.max())}


def _seconds(function: Solve | Callable[..., jax.Array], rung: Rung) -> float:
    """Median seconds of a call, none of which has met its theta before.

    Of calls below a millisecond some thousand: a few differ by a factor of four from run to run.
    """
    seconds = per_call(function, unseen(rung.scene, rung.calls + 1), clock=CLOCK)
    if seconds < _FAST:
        seconds = per_call(function, unseen(rung.scene, _MANY_CALLS), clock=CLOCK)
    return seconds
