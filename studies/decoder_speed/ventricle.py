"""One value with its gradient on the left ventricle: emulator, rival, polish and FEM."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from studies.common.timing import Function, batched, in_loop, milliseconds, per_call, unseen

import emulator as em
from calibrate.measurements import CavityVolume, Observations, landmarks, spread_landmarks
from emulator.fem import run_campaign, sobol
from emulator.surrogates import CachedEmulator
from emulator.surrogates.corrected import corrected
from emulator.surrogates.pod_gp import fit_reduced
from emulator.surrogates.protocol import ForwardMap

SCENE = "left_ventricle"
LANDMARKS = 24
NOISE_MM, NOISE_ML = 0.2, 1.0
AWAY = 0.03  # relative distance of the theta of FEM's start from the one to solve


class Misfit:
    """24 landmarks and the cavity's volume against data: the scalar a sampler differentiates."""

    def __init__(self, forward: ForwardMap, seed: int) -> None:
        scene = forward.scene
        points = spread_landmarks(scene, LANDMARKS, seed)
        self.observe = Observations(
            {"displacement": landmarks(scene, points), "volume": CavityVolume(scene)}
        )
        truth = scene.from_unit(jnp.full(len(scene.parameters), 0.4))
        self.data = self.observe(forward.at(self.observe.nodes)(truth)[None], truth[None])

    def __call__(self, displacement: jax.Array, theta: jax.Array) -> jax.Array:
        """The misfit of the displacement (k, 3) mm of the observed nodes, at ``theta`` (p,)."""
        seen = self.observe(displacement[None], theta[None])
        moved = (seen["displacement"] - self.data["displacement"]) / NOISE_MM
        volume = (seen["volume"] - self.data["volume"]) / NOISE_ML
        return 0.5 * (jnp.sum(moved**2) + volume**2)

    def of(self, forward: ForwardMap) -> Function:
        """Value and gradient in theta through ``forward``, compiled."""
        observed = forward.at(self.observe.nodes)
        return jax.jit(jax.value_and_grad(lambda theta: self(observed(theta), theta)))


def fem_gradients(
    simulator: em.Simulator, misfit: Misfit, thetas: jax.Array, directions: jax.Array
) -> tuple[float, list[jax.Array]]:
    """Median seconds of FEM's value and gradient started 3 % away, and the gradients.

    Outside ``jit``, where the simulator may use CHOLMOD. The first theta warms up.
    """
    nodes = misfit.observe.nodes
    starts = [
        simulator.solve(theta * (1.0 + AWAY * way)).require_converged().displacement
        for theta, way in zip(thetas, directions, strict=True)
    ]
    found: list[jax.Array] = []
    jobs = iter(zip(thetas, starts, strict=True))

    def one(_: Any) -> jax.Array:
        theta, start = next(jobs)

        def scalar(theta: jax.Array) -> tuple[jax.Array, jax.Array]:
            solution = simulator.solve(theta, start)
            return misfit(solution.displacement[nodes], theta), solution.converged

        (value, converged), gradient = jax.value_and_grad(scalar, has_aux=True)(theta)
        assert converged
        found.append(gradient)
        return value

    return per_call(one, thetas), found


def gap(function: Function, thetas: jax.Array, exact: list[jax.Array]) -> float:
    """Median over ``thetas`` of the gradient's relative difference from FEM's."""
    gaps = [
        jnp.linalg.norm(function(theta)[1] - gradient) / jnp.linalg.norm(gradient)
        for theta, gradient in zip(thetas, exact, strict=True)
    ]
    return float(np.median(gaps))


def row(name: str, call: float, loop: float | None, batch: float | None, **more: Any) -> dict:
    print(
        f"{name:44s} call {milliseconds(call):>12s}  in a loop {milliseconds(loop):>10s}"
        f"  in a batch {milliseconds(batch):>10s}",
        flush=True,
    )
    return {
        "name": name,
        "status": "done",
        "call_s": call,
        "loop_s": loop,
        "batch_s": batch,
        **more,
    }


def stages(cached: CachedEmulator, misfit: Misfit, calls: int) -> list[dict]:
    """Times of value and gradient of ever longer parts of the evaluation."""
    trained = cached.emulator
    scene, series, discrepancy = trained.scene, trained.taylor, trained.discrepancy
    parts: dict[str, Function] = {"position in the box": scene.to_unit}
    if series is not None:
        parts["Taylor monomials"] = lambda theta: series.monomials(scene.to_unit(theta))
    if discrepancy is not None:
        parts["kernel's features"] = lambda theta: discrepancy.warp(scene.to_unit(theta))
    parts["all coefficients"] = cached.coefficients
    parts["displacement of the observed nodes"] = cached
    cases = []
    for name, part in parts.items():
        square = jax.jit(jax.value_and_grad(lambda theta, part=part: jnp.sum(part(theta) ** 2)))
        cases.append(row(f"up to: {name}", *_both(square, scene, calls), None))
    return [*cases, row("up to: the misfit", *_both(misfit.of(cached), scene, calls), None)]


def _both(function: Function, scene: em.Scene, calls: int) -> tuple[float, float]:
    return per_call(function, unseen(scene, calls)), in_loop(function, scene, calls)


def study(calls: int, fem_calls: int, runs: int, batch: int, seed: int) -> list[dict]:
    """Times of every method's value and gradient, measured in one run."""
    trained = em.load(SCENE, kind="series")
    scene, whole = trained.scene, trained.cache()
    misfit = Misfit(whole, seed)
    simulator = em.Simulator(scene)
    reduced = fit_reduced(scene, run_campaign(simulator, sobol(scene, runs, seed)))
    polished = corrected(whole, simulator, steps=1)
    thetas = unseen(scene, fem_calls + 1)
    directions = jnp.sign(jax.random.normal(jax.random.key(seed), thetas.shape))
    fem_s, exact = fem_gradients(simulator, misfit, thetas, directions)
    common = {"nodes": len(scene.mesh.nodes), "observed_nodes": len(misfit.observe.nodes)}
    fem_name = "FEM, started 3 % away"
    cases = [row(fem_name, fem_s, None, None, **common, gradient_gap=0.0)]
    for name, forward in (("emulator", whole), (f"POD + GP, {runs} FEM runs", reduced)):
        function = misfit.of(forward)
        seconds = (*_both(function, scene, calls), batched(function, scene, batch))
        cases.append(row(name, *seconds, **common, gradient_gap=gap(function, thetas, exact)))
    function = misfit.of(polished)
    polished_s = per_call(function, unseen(scene, fem_calls + 1))
    polish_gap = gap(function, thetas, exact)
    name = "emulator + 1 Newton step"
    cases.append(row(name, polished_s, None, None, **common, gradient_gap=polish_gap))
    for case in cases:
        case["times_faster_than_fem"] = fem_s / case["call_s"]
    return [*cases, *stages(whole.at(misfit.observe.nodes), misfit, calls)]
