"""``jax.vmap(simulator.solve)`` under ``jit``, each scene in a process with a time limit.

It used to hang for ever on a ventricle, which only another process can find out.
"""

import subprocess
import sys

import pytest

from emulator.scenes.built_in import BUILT_IN

COARSE = {
    "once_clamped_beam": "cells=(4, 2, 2), order=1",
    "twice_clamped_beam": "cells=(4, 2, 2), order=1",
    "turned_beam": "cells=(4, 2, 2), order=1",
    "traction_beam_holzapfel_ogden": "cells=(4, 2, 2), order=1",
    "traction_beam_guccione": "cells=(4, 2, 2), order=1",
    "twisting_cube": "cells=3, order=1",
    "liver": "shells=3, order=1",
    "left_ventricle": "rings=4, around=8, layers=1, order=1",
    "left_ventricle_neo_hookean": "rings=4, around=8, layers=1, order=1",
    "left_ventricle_segments": "rings=6, around=12, layers=1, order=1",
    "biventricle": "rings=6, around=12, layers=(1, 1), order=1",
}

CODE = """
import sys
import jax
import jax.numpy as jnp
import numpy as np
import emulator as em

scene = em.scenes.{name}({options})
simulator = em.Simulator(scene)
thetas = em.fem.sobol(scene, {count}, seed=3)
together = jax.jit(jax.vmap(simulator.solve))(thetas)
assert together.converged.all(), together.status
alone = jax.jit(simulator.solve)
for theta, u in zip(thetas, together.displacement, strict=True):
    expected = alone(theta).displacement
    scale = float(jnp.abs(expected).max())
    np.testing.assert_allclose(u, expected, rtol=0.0, atol=1e-9 * scale)
"""


def run(name, options, count, limit):
    code = CODE.format(name=name, options=options, count=count)
    subprocess.run([sys.executable, "-c", code], check=True, timeout=limit)


def test_a_coarse_beam_by_vmap():
    run("once_clamped_beam", COARSE["once_clamped_beam"], 2, 300)


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(BUILT_IN))
def test_every_built_in_scene_by_vmap(name):
    run(name, COARSE[name], 4, 600)


@pytest.mark.slow
def test_a_linear_ventricle_of_daily_size_by_vmap():
    """Where it was found: 4 theta on two cores."""
    run("left_ventricle", "order=1", 4, 900)
