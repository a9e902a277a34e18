"""The code of docs/extending.md does what the page says."""

import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from calibrate.measurements import OBSERVATIONS
from calibrate.samplers import SAMPLERS
from emulator.fem import Status
from emulator.mechanics.kinematics import Strain
from emulator.mechanics.laws import LAWS

GUIDE = Path(__file__).resolve().parents[1] / "docs" / "extending.md"


@pytest.fixture(scope="module")
def written():
    """What the guide's code defines, run from top to bottom; the registries are then as before."""
    names = {}
    kept = [(registry, dict(registry)) for registry in (OBSERVATIONS, SAMPLERS)]
    try:
        for k, code in enumerate(
            re.findall(r"```python\n(.*?)```", GUIDE.read_text(encoding="utf-8"), re.DOTALL)
        ):
            exec(compile(code, f"{GUIDE.name}, block {k + 1}", "exec"), names)
    finally:
        for registry, before in kept:
            registry.clear()
            registry.update(before)
    return names


def test_the_law_of_the_guide_equals_its_formula(written):
    a, b, kappa = 3.0, 2.0, 40.0
    F = np.eye(3) + 0.1 * np.random.default_rng(0).normal(size=(3, 3))
    J = np.linalg.det(F)
    I1 = J ** (-2 / 3) * np.trace(F.T @ F)
    expected = a / (2 * b) * (np.exp(b * (I1 - 3)) - 1) + kappa / 2 * (J - 1) ** 2
    law = written["DEMIRAY"]
    assert law in written["LAWS"]
    assert law.name not in LAWS  # the guide stays an example
    H = jnp.asarray(F - np.eye(3))
    assert law.energy(Strain(H), a, b, kappa) == pytest.approx(expected, rel=1e-12)
    stress = jax.grad(lambda H: law.energy(Strain(H), a, b, kappa))
    np.testing.assert_allclose(stress(jnp.zeros((3, 3))), 0.0, atol=1e-14)


def test_the_scene_of_the_guide_is_solved(written):
    assert Status(int(written["solution"].status)) is Status.CONVERGED
    assert written["solution"].displacement[:, 2].min() < -0.1


def test_the_observation_of_the_guide_is_an_area(written):
    emulator = written["emulator"]
    x = emulator.scene.mesh.nodes + np.asarray(emulator(emulator.scene.theta(mu=73.0, lam=61.0)))
    sides = [np.linalg.norm(x[i] - x[j]) for i, j in ((12, 300), (300, 380), (380, 12))]
    half = 0.5 * sum(sides)  # Heron's formula
    area = np.sqrt(half * np.prod([half - side for side in sides]))
    assert float(written["data"]["area:12,300,380"]) == pytest.approx(area, rel=1e-9)
    assert written["model"].noise["area:12,300,380"].sd == 5.0


def test_the_sampler_of_the_guide_finds_the_truth(written):
    posterior = written["posterior"]
    assert posterior.tree.attrs["sampler"] == "random_walk"
    rates = np.asarray(posterior.tree["sample_stats"]["acceptance_rate"])
    assert 0.05 < rates.mean() < 0.95
    draws = posterior.draws()["mu"]
    assert abs(draws.mean() - 73.0) < 3.0 * draws.std()
    assert draws.std() < 5.0
