"""The guide's code does what the guide says."""

import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from emulator.fem import Status
from emulator.mechanics.kinematics import Strain
from emulator.mechanics.laws import LAWS

GUIDE = Path(__file__).resolve().parents[3] / "docs" / "adding_a_law.md"


@pytest.fixture(scope="module")
def written():
    """What the guide's code defines, run from top to bottom."""
    names = {}
    for code in re.findall(r"```python\n(.*?)```", GUIDE.read_text(encoding="utf-8"), re.DOTALL):
        exec(compile(code, GUIDE.name, "exec"), names)
    return names


def test_the_law_of_the_guide_equals_its_formula(written):
    a, b, kappa = 3.0, 2.0, 40.0
    F = np.eye(3) + 0.1 * np.random.default_rng(0).normal(size=(3, 3))
    J = np.linalg.det(F)
    I1 = J ** (-2 / 3) * np.trace(F.T @ F)
    expected = a / (2 * b) * (np.exp(b * (I1 - 3)) - 1) + kappa / 2 * (J - 1) ** 2
    law = written["DEMIRAY"]
    assert law.name not in LAWS  # the guide stays an example
    H = jnp.asarray(F - np.eye(3))
    assert law.energy(Strain(H), a, b, kappa) == pytest.approx(expected, rel=1e-12)
    stress = jax.grad(lambda H: law.energy(Strain(H), a, b, kappa))
    np.testing.assert_allclose(stress(jnp.zeros((3, 3))), 0.0, atol=1e-14)


def test_the_scene_of_the_guide_is_solved(written):
    assert Status(int(written["solution"].status)) is Status.CONVERGED
    assert written["solution"].displacement[:, 2].min() < -0.1
