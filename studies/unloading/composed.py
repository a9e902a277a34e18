"""Emulators: of unloading and loading together beside loading alone, and of the unloaded shape."""

import tempfile
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from studies.common.output import Case
from studies.unloading.bodies import farthest, imaged, some_theta

import emulator as em
from emulator.accuracy.comparison import quantiles
from emulator.scenes import Scene
from emulator.scenes.loads import KPA_PER_MMHG
from emulator.scenes.scene import find_cavity
from emulator.surrogates.taylor import expand
from emulator.training import recipe

IMAGE = 8.0 * KPA_PER_MMHG  # kPa, of the image


def narrow(scene: Scene) -> Scene:
    """``scene`` with the paper's 4 to 10 mmHg, which the emulator shipped for it has."""
    parameters = (*scene.parameters[:-1], replace(scene.parameters[-1], high=10.0 * KPA_PER_MMHG))
    return replace(scene, parameters=parameters)


def emulated(scene: Scene, runs: int, tests: int, order: int, seed: int) -> Case:
    """Errors over held-out theta of an emulator of ``runs`` FEM runs.

    order : of the series it may stand on; 0 for none.
    """
    plan = replace(recipe("mechanics"), simulations=runs, order=order)
    with tempfile.TemporaryDirectory() as folder:
        trained = em.train(scene, plan, folder)
    simulator, forward = em.Simulator(scene), jax.jit(trained.cache())
    cavity = find_cavity(scene)
    volume = jax.jit(lambda u: cavity(u[cavity.nodes]))
    err_u, err_V, size = [], [], []
    for theta in some_theta(scene, tests, seed):
        exact = simulator.solve(theta).require_converged().displacement
        found = forward(theta)
        err_u.append(np.linalg.norm(np.asarray(found - exact), axis=-1))
        err_V.append(100.0 * abs(float(volume(found) / volume(exact)) - 1.0))
        size.append(farthest(exact))
    return {
        "runs": runs,
        "tests": tests,
        "on": trained.record["discrepancy"]["on"],
        "err_u_mm": quantiles(np.array(err_u)),
        "err_V_percent": quantiles(np.array(err_V)),
        "farthest_mm": quantiles(np.array(size)),
        "seconds": trained.record["seconds"],
    }


def composed(scene: Scene, order: int, runs: int, tests: int, seed: int) -> Case:
    """The two scenes' emulators of the same recipe."""
    plain = narrow(scene)
    found = {
        name: emulated(each, runs, tests, order, seed)
        for name, each in (("at rest", plain), ("imaged", imaged(plain, IMAGE)))
    }
    ratio = {
        error: found["imaged"][error]["median"] / found["at rest"][error]["median"]
        for error in ("err_u_mm", "err_V_percent")
    }
    return {"kind": "emulators", "order": order, **found, "imaged_by_at_rest": ratio}


def unloaded_by_series(scene: Scene, highest: int, tests: int, seed: int) -> Case:
    """The series of the unloaded shape about the centre, against FEM, mm.

    One unloading, at the centre, is all that it rests on. Of each theta: mean and largest distance
    of the nodes, and the Hausdorff distance of the two clouds of nodes.
    """
    unloader = em.Unloader(scene)
    series = expand(unloader, order=highest)
    rows: dict[str, list[list[float]]] = {str(order): [] for order in range(highest + 1)}
    moved = []
    for theta in some_theta(scene, tests, seed):
        exact = np.asarray(unloader.solve(theta).require_converged().displacement)
        moved.append(float(np.linalg.norm(exact, axis=-1).mean()))
        x = scene.to_unit(theta)
        kept = np.sum(series.indices >= 0, axis=1)
        for order, each in rows.items():
            terms = jnp.where(jnp.asarray(kept <= int(order)), series.monomials(x), 0.0)
            w = np.asarray(series.displacement + jnp.tensordot(terms, series.derivatives, axes=1))
            away = np.linalg.norm(w - exact, axis=-1)
            nodes = scene.mesh.nodes
            each.append([away.mean(), away.max(), hausdorff(nodes + w, nodes + exact)])
    table = {
        order: dict(zip(("mean", "farthest", "hausdorff"), np.median(r, axis=0), strict=True))
        | {"mean_at_worst": float(np.max(np.array(r)[:, 0]))}
        for order, r in rows.items()
    }
    return {"kind": "series", "tests": tests, "mean_move_mm": quantiles(np.array(moved))} | {
        "orders": {o: {k: float(v) for k, v in row.items()} for o, row in table.items()}
    }


def hausdorff(one: np.ndarray, other: np.ndarray) -> float:
    """Of two clouds of points (n, 3) and (m, 3), mm."""
    from scipy.spatial.distance import directed_hausdorff

    return max(directed_hausdorff(one, other)[0], directed_hausdorff(other, one)[0])
