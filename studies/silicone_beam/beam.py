"""The beam as a scene, and what is not known of its measurements."""

from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np
from studies.silicone_beam.experiment import (
    BLIND,
    CLAMP,
    DENSITY,
    FORCE,
    LENGTH,
    WIDTH,
    Measured,
)

import calibrate as cal
import emulator as em

TIP = "markers:right"
WEIGHT, LOADED, BASE = f"{TIP}@weight", f"{TIP}@loaded", "markers:left@loaded"
KNOWN = {"hung@weight": 0.0, "hung@loaded": FORCE}
NOISE = {WEIGHT: 0.1, LOADED: 0.3, BASE: 0.3}
"""Sd in mm: repeats differ by 0.05 and 0.4 mm, and the three pins of the tip do not keep their
distances under the force, to 0.2 mm."""
HAND = (1.0, 1.0)  # mm and degrees to which a hand holds the tip straight
RIG = (2.0, 1.5)  # mm and degrees by which camera or clamp moved between the experiments
PIN = 1.0  # mm, where the markers are in the mesh's frame
LOOSE = 1.0  # mm: one of the clamp's markers does not fit the others' distances


def rotation_of(points: np.ndarray, displacement: np.ndarray) -> np.ndarray:
    """Return the rotation (3, 3) that fits the displacement of ``points`` (d, 3) best."""
    deformed = points + displacement
    U, _, V = np.linalg.svd((deformed - deformed.mean(axis=0)).T @ (points - points.mean(axis=0)))
    return U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ V))]) @ V


def scene(cells: tuple[int, int, int] = (12, 3, 3)) -> em.Scene:
    """Nearly incompressible silicone, clamped at x = 0, a force on the free end's upper edge."""
    mesh = em.generators.box(
        (LENGTH, WIDTH, WIDTH), cells, 2, em.generators.toward_ends(cells[0], 1.5, ("left",))
    )
    edge = np.intersect1d(mesh.node_set("right"), mesh.node_set("top"))
    return em.Scene(
        name="silicone beam",
        mesh=replace(mesh, node_sets={**mesh.node_sets, "edge": edge}),
        law=em.find_law("neo_hookean_split"),
        parameters=(
            em.Parameter("mu", "kPa", 40.0, 200.0, "log"),
            em.Parameter("kappa", "kPa", 1e3, 1e5, "log"),
            em.Parameter("hung", "", 0.0, 1.05),
        ),
        loads=(
            em.loads.Gravity(density=DENSITY, direction=(0.0, 0.0, -1.0), acceleration=9.81),
            em.loads.Force("edge", (0.0, 0.0, -1.0), amount="hung"),
        ),
        supports=(em.Support("left"),),
        dilatation="mean",
    )


def hand(observed: Iterable[str], seen: Measured) -> cal.model_error.Systematic:
    """Displacements are from where a hand held the tip: its error is the same in all of them."""
    return cal.model_error.rigid_motion("hand", dict.fromkeys(observed, seen.rest), *HAND)


def rig(places: Mapping[str, np.ndarray]) -> cal.model_error.Systematic:
    """Camera or clamp, seen at ``places`` (d, 3) mm, have moved since the first experiment."""
    return cal.model_error.rigid_motion("rig", places, *RIG, about=CLAMP.mean(axis=0))


def pins(displacements: Mapping[str, np.ndarray], seen: Measured) -> cal.model_error.Systematic:
    """A marker that stands elsewhere by d moves by (R - I) d more where the tip has turned by R."""
    modes = {
        name: np.stack(
            [np.tile(PIN * row, (3, 1)) for row in (rotation_of(seen.rest, u) - np.eye(3)).T]
        )
        for name, u in displacements.items()
    }
    return cal.model_error.Systematic(tuple(f"pins {axis}" for axis in "xyz"), modes)


def unknowns(seen: Measured) -> tuple[cal.model_error.Systematic, ...]:
    """What is not known of the measurement besides its noise."""
    tip = {WEIGHT: seen.weight, LOADED: seen.loaded}
    moved = rig({LOADED: seen.rest + seen.loaded, BASE: CLAMP + seen.clamp})
    second = LOOSE * np.eye(3)[:, None] * np.array([0.0, 1.0, 0.0])[:, None]
    loose = cal.model_error.Systematic(tuple(f"loose {axis}" for axis in "xyz"), {BASE: second})
    return hand(tip, seen), moved, pins(tip, seen), loose


def model(forward: em.ForwardMap, seen: Measured, *, known_rig: bool = False) -> cal.Model:
    """Modulus and bulk modulus from both experiments.

    known_rig : leave out all that is not known of the measurement, and with it the clamp's markers,
        as a fit does that knows of noise only.
    """
    beam = forward.scene
    tip = cal.rigid_markers(beam, "right", seen.rest)
    observe = {WEIGHT: tip, LOADED: tip, BASE: cal.rigid_markers(beam, "left", CLAMP)}
    if known_rig:
        del observe[BASE]
    noise = {name: cal.GaussianNoise(sd=NOISE[name]) for name in observe}
    plain = cal.model(forward, observe, noise, known=KNOWN)
    return plain if known_rig else cal.with_systematic(plain, *unknowns(seen))


def data(seen: Measured) -> dict[str, np.ndarray]:
    """The measurements by the observations' names."""
    return {WEIGHT: seen.weight, LOADED: seen.loaded, BASE: seen.clamp}


def predict(
    forward: em.ForwardMap,
    calibrated: cal.Model,
    seen: Measured,
    draws: Mapping[str, np.ndarray],
    rng: np.random.Generator,
) -> dict[str, np.ndarray]:
    """Tip markers under 1.00062 N, (draws, 3, 3) mm in the laboratory's frame, in the beam's axes.

    ``rig where it was``: had camera and clamp stayed as with 0.51 N; ``rig moved again``: as far as
    between the first two experiments, and independently.
    """
    import jax
    import jax.numpy as jnp

    tip = cal.rigid_markers(forward.scene, "right", seen.rest)
    near = forward.at(tip.nodes)

    @jax.jit
    def under(mu: jax.Array, kappa: jax.Array) -> jax.Array:
        theta = jnp.array([mu, kappa, BLIND])
        return tip(near(theta), theta)

    stayed, moved = [], []
    error = calibrated.error
    assert error is not None
    for k in range(len(draws["mu"])):
        draw = {name: jnp.asarray(values[k]) for name, values in draws.items()}
        means, _ = calibrated.predict(draw)
        mean, covariance = error.unknowns({n: v - means[n] for n, v in data(seen).items()})
        q = dict(zip(error.names, rng.multivariate_normal(mean, covariance), strict=True))
        u = np.asarray(under(draw["mu"], draw["kappa"]))
        moving = rig({TIP: seen.rest + u})
        own = seen.rest + u + _sum(hand([TIP], seen), q) + _sum(pins({TIP: u}, seen), q)
        own = own + rng.normal(0.0, NOISE[LOADED], own.shape) - seen.shift
        again = {name: rng.normal() for name in moving.names}
        stayed.append(own + _sum(moving, q))
        moved.append(own + _sum(moving, again))
    return {"rig where it was": np.array(stayed), "rig moved again": np.array(moved)}


def _sum(error: cal.model_error.Systematic, values: Mapping[str, float]) -> np.ndarray:
    (modes,) = error.modes.values()
    return np.tensordot([values[name] for name in error.names], modes, axes=1)
