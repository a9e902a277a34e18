"""A Neo-Hookean block of 18 375 unknowns under a dead pressure that rises in ten increments.

The size, the law and the number of increments are those of a case that torch-fem publishes, 14 to
25 s forward and adjoint on fast desktops; its body is of hexahedra, ours of linear tetrahedra. Each
increment starts at the last one's solution, and the adjoint goes through all ten.
"""

import jax
import jax.numpy as jnp
from studies.common.output import Case
from studies.common.timing import clocked

import emulator as em

CELLS = (34, 24, 6)  # 6125 nodes
INCREMENTS = 10
PRESSURE = 8.0  # kPa at the end


def block(cells: tuple[int, int, int]) -> em.Scene:
    """A block clamped at one end and pressed from below: it bends up by half its length."""
    return em.Scene(
        name="pressed_block",
        mesh=em.generators.box((34.0, 24.0, 6.0), cells),
        law=em.find_law("neo_hookean"),
        parameters=(
            em.Parameter("mu", "kPa", 100.0, 400.0, "log"),
            em.Parameter("lam", "kPa", 100.0, 800.0, "log"),
            em.Parameter("pressure", "kPa", 0.0, PRESSURE),
        ),
        loads=(em.loads.DeadPressure("bottom"),),
        supports=(em.Support("left"),),
    )


def climb(simulator: em.Simulator, constants: jax.Array) -> tuple[jax.Array, list[em.fem.Solution]]:
    """Sum of the end's displacements over the increments in mm, and the solutions."""
    end = simulator.scene.mesh.node_set("right")
    total, found, start = jnp.zeros(()), [], None
    for k in range(1, INCREMENTS + 1):
        theta = jnp.append(constants, PRESSURE * k / INCREMENTS)
        solution = simulator.solve(theta, start)
        found.append(solution)
        start = jax.lax.stop_gradient(solution.displacement)
        total = total + jnp.mean(solution.displacement[end, 2])
    return total, found


def measured(cells: tuple[int, int, int] = CELLS) -> Case:
    """Seconds of ten increments, and of them with their adjoints, at constants not met before."""
    scene = block(cells)
    simulator = em.Simulator(scene)

    def value(constants: jax.Array) -> tuple[jax.Array, jax.Array]:
        total, found = climb(simulator, constants)
        return total, jnp.stack([solution.status for solution in found])

    both = jax.value_and_grad(value, has_aux=True)
    constants = jnp.array([200.0, 300.0])
    clocked(both, constants * 0.99)  # compiles
    forward, (_, solutions) = clocked(lambda c: climb(simulator, c), constants)
    whole, ((_, statuses), gradient) = clocked(both, constants * 1.01)
    step = jnp.array([1e-4, 0.0]) * constants
    ahead, behind = (value(constants * 1.01 + sign * step)[0] for sign in (1.0, -1.0))
    end = scene.mesh.node_set("right")
    return {
        "status": "converged" if not statuses.any() else "failed",
        "unknowns": 3 * len(scene.mesh.nodes),
        "nodes": len(scene.mesh.nodes),
        "elements": len(scene.mesh.elements),
        "increments": INCREMENTS,
        "iterations": sum(int(solution.iterations) for solution in solutions),
        "end_mm": float(jnp.mean(solutions[-1].displacement[end, 2])),
        "forward_s": forward,
        "forward_and_adjoint_s": whole,
        "gradient_error": float(jnp.abs(0.5 * (ahead - behind) / (gradient @ step) - 1.0)),
    }
