"""Unload then load, load then unload, two methods, slopes, and a sphere known in closed form."""

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import quad
from scipy.optimize import brentq
from studies.common.output import Case
from studies.unloading.bodies import direction, farthest, some_theta

import emulator as em
from emulator.fem import NewtonOptions, Status
from emulator.fem.loaded import LoadedEquilibrium
from emulator.fem.unloading import scene_at_rest
from emulator.geometry.generators.sphere import sphere_octant
from emulator.mechanics.laws.neo_hookean import bulk_modulus
from emulator.scenes import Scene
from emulator.verify.incompressible import INNER, MU, NU, OUTER, pressure_at, sphere_scene

MET = 1e-8  # mm


class Body:
    """A scene with its three programs, compiled."""

    def __init__(self, scene: Scene) -> None:
        self.simulator = em.Simulator(scene)
        # Unloads by the pressure that it then loads by, so that nothing should move. One program
        # loads all shapes, from rest.
        own = replace(scene, loaded_by={"pressure": "pressure"}, origin={})
        self.both = LoadedEquilibrium(own, NewtonOptions())
        jax.block_until_ready(self.both.solve(scene.centre, None).displacement)
        jax.block_until_ready(self.simulator.solve(scene.centre).displacement)

    def row(self, theta: jax.Array) -> Case:
        """One theta: unloaded, loaded again, and a cold solve of the same body."""
        seconds, unloaded = timed(self.both.unloaded, theta)
        cold_seconds, cold = timed(self.simulator.solve, theta)
        again = self.both.solve(theta, None)  # of the shape just found
        found: Case = {
            "theta": [float(value) for value in theta],
            "unloading": name(unloaded.status),
            "loading": name(again.status) if unloaded.converged else "",
            "cold": name(cold.status),
            "load_reached": float(unloaded.load_reached),
            "moved_mm": farthest(unloaded.displacement),
            "missed_mm": farthest(again.displacement),
            "residual": float(unloaded.residual),
            "factorisations": int(unloaded.factorisations),
            "cold_factorisations": int(cold.factorisations),
            "seconds": seconds,
            "cold_seconds": cold_seconds,
        }
        found["outcome"] = outcome(found)
        if found["outcome"] == "loads elsewhere":
            # Is the mesh a stable equilibrium of the shape it came of?
            shape = em.Simulator(unloaded.scene)
            found["stable"] = shape.is_stable(unloaded.start, theta)
        return found


def outcome(row: Case) -> str:
    """In words."""
    if row["unloading"] != "converged":
        return f"unloading: {row['unloading']}"
    if row["loading"] != "converged":
        return f"loading: {row['loading']}"
    return "met" if row["missed_mm"] <= MET else "loads elsewhere"


def name(status: jax.Array) -> str:
    """Of a status."""
    return Status(int(status)).name.lower()


def timed(function: Callable[..., Any], *arguments: Any) -> tuple[Case, Any]:
    """Seconds of a call by the wall's clock and of the processor, and what it gave."""
    begin, worked = time.perf_counter(), time.process_time()
    found = function(*arguments)
    jax.block_until_ready(found.displacement)
    passed = time.perf_counter() - begin
    return {"wall": passed, "processor": time.process_time() - worked}, found


def itself(scene: Scene, count: int, seed: int) -> Case:
    """Loaded, taken for an image, and unloaded: the distance from the body it was, mm.

    The tissue's fibres are carried along with it.
    """
    simulator, missed = em.Simulator(scene), []
    for theta in some_theta(scene, count, seed):
        u = simulator.solve(theta).require_converged().displacement
        image = scene_at_rest(scene, u)  # the scene on the mesh x + u
        unloaded = em.unload(image, theta).require_converged()
        missed.append(farthest(unloaded.displacement + u))
    return {"missed_mm": missed}


def as_a_scene(scene: Scene, count: int, seed: int) -> Case:
    """Unloaded shapes made scenes of their own and loaded from rest: distance from the mesh, mm."""
    unloader, missed = em.Unloader(scene), []
    for theta in some_theta(scene, count, seed):
        unloaded = unloader.solve(theta).require_converged()
        again = em.Simulator(unloaded.scene).solve(theta).require_converged()
        missed.append(farthest(again.displacement - unloaded.start))
    return {"missed_mm": missed}


def two_methods(scene: Scene, count: int, seed: int) -> Case:
    """Inverse motion and the fixed point at the same theta."""
    inverse, fixed = (em.Unloader(scene, method) for method in ("inverse", "fixed_point"))
    for unloader in (inverse, fixed):
        jax.block_until_ready(unloader.solve(scene.centre).displacement)
    rows = []
    for theta in some_theta(scene, count, seed):
        seconds, found = timed(inverse.solve, theta)
        fixed_seconds, again = timed(fixed.solve, theta)
        rows.append(
            {
                "inverse": name(found.status),
                "fixed_point": name(again.status),
                "apart_mm": farthest(found.displacement - again.displacement),
                "factorisations": [int(found.factorisations), int(again.factorisations)],
                "seconds": [seconds, fixed_seconds],
            }
        )
    return {"rows": rows}


def slopes(scene: Scene, count: int, seed: int) -> Case:
    """Derivatives along random directions against central differences, relative to the largest."""
    unloader, rng, step = em.Unloader(scene), np.random.default_rng(seed), 1e-4
    off = []
    for theta in some_theta(scene, count, seed):
        way = direction(scene, rng)
        rows = unloader.sensitivities(unloader.solve(theta).require_converged(), theta)
        along = jnp.tensordot(way, rows, 1)
        ends = [unloader.solve(theta + s * step * way).require_converged() for s in (1, -1)]
        difference = (ends[0].displacement - ends[1].displacement) / (2.0 * step)
        off.append(float(jnp.abs(along - difference).max() / jnp.abs(difference).max()))
    return {"relative": off}


def unloaded_radii(inner: float, outer: float, pressure: float) -> tuple[float, float]:
    r"""Radii in mm at rest of an incompressible neo-Hookean sphere known under ``pressure`` kPa.

    With the hoop stretch :math:`\lambda = r/R` radial equilibrium is
    :math:`p = \int_a^b 2\mu(\lambda^2 - \lambda^{-4})/r\,dr`, and
    :math:`R^3 = r^3 - a^3 + A^3`. A is the root of it.
    """

    def missing(A: float) -> float:
        def hoop(r: float) -> float:
            stretch = r / (r**3 - inner**3 + A**3) ** (1.0 / 3.0)
            return 2.0 * MU * (stretch**2 - stretch**-4) / r

        return quad(hoop, inner, outer, epsabs=1e-12)[0] - pressure

    A = brentq(missing, 0.6 * inner, inner, xtol=1e-12)
    return A, (outer**3 - inner**3 + A**3) ** (1.0 / 3.0)


def sphere(cells: tuple[int, int], stretch: float) -> Case:
    """A loaded sphere unloaded, and its radii by the integral.

    stretch : of its inner surface; the tissue is all but incompressible.
    """
    inner = stretch * INNER
    outer = (OUTER**3 + inner**3 - INNER**3) ** (1.0 / 3.0)
    pressure = pressure_at(stretch)
    scene = replace(sphere_scene(cells), mesh=sphere_octant(inner, outer, cells, 1.5, order=2))
    unloaded = em.unload(scene, jnp.array([MU, bulk_modulus(MU, NU), pressure]))
    mesh = unloaded.scene.mesh
    exact = dict(zip(("inner", "outer"), unloaded_radii(inner, outer, pressure), strict=True))
    found = {n: float(np.linalg.norm(mesh.nodes[mesh.node_set(n)], axis=1).mean()) for n in exact}
    return {
        "loaded_mm": [inner, outer],
        "pressure_kPa": pressure,
        "unloaded_mm": list(found.values()),
        "exact_mm": list(exact.values()),
        "relative": [found[n] / exact[n] - 1.0 for n in exact],
        "nodes": len(mesh.nodes),
    }
