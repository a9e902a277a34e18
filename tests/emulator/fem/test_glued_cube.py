"""A loading curve of a cube of tissue that is glued between two plates."""

from time import perf_counter

import jax.numpy as jnp
import numpy as np
import pytest

import emulator as em
from emulator.fem.reactions import SupportForce
from emulator.geometry.generators.box import box, toward_ends
from emulator.mechanics.laws import find_law
from emulator.scenes import Parameter, Scene, Support


def glued_cube(cells):
    """Orthotropic tissue of 1 cm between glued plates, sheared; cells are shorter at the plates."""
    values = {"b": 9.0, "a_f": 1.0, "b_f": 16.0, "a_s": 0.5, "b_s": 9.0, "a_fs": 0.3, "b_fs": 9.0}
    mesh = box((10.0,) * 3, (cells,) * 3, 2, toward_ends(cells, 1.5, ("left", "right")))
    fibre, sheet = (np.tile(axis, (len(mesh.elements), 1)) for axis in np.eye(3)[:2])
    return Scene(
        "glued cube",
        mesh,
        find_law("holzapfel_ogden_orthotropic"),
        (Parameter("a", "kPa", 0.1, 5.0, "log"), Parameter("shear", "", -0.5, 0.5)),
        constants=values | {"kappa": 100.0},
        supports=(
            Support("left"),
            Support("right", components="xz"),
            Support("right", (0.0, 10.0, 0.0), "y", amount="shear"),
        ),
        fibres=fibre,
        sheets=sheet,
        dilatation="mean",
    )


@pytest.mark.slow
def test_a_hundred_points_of_a_glued_cube(capsys):
    """To 1 % of the force by 343 nodes, in less than 30 s."""
    forces = {}
    for cells in (3, 6):
        simulator = em.Simulator(glued_cube(cells))
        force = SupportForce(simulator.scene, "right", (0.0, 1.0, 0.0))
        amounts = jnp.linspace(0.0, 0.4, 101 if cells == 3 else 11)
        thetas = jnp.stack([jnp.full_like(amounts, 0.8), amounts], axis=1)
        simulator.path(thetas[:2])  # compiles
        began = perf_counter()
        found = simulator.path(thetas)
        seconds = perf_counter() - began
        assert found.converged.all()
        forces[cells] = np.asarray(force(found.displacement[:, force.nodes], thetas))
        with capsys.disabled():
            told = (
                f"{len(simulator.scene.mesh.nodes)} nodes: {len(amounts)} points in {seconds:.1f} s"
            )
            print(f"\n{told}, {forces[cells][-1]:.2f} mN at 0.4")
        assert seconds < 30.0 or cells != 3
    np.testing.assert_allclose(forces[3][10::10], forces[6][1:], rtol=0.01)
