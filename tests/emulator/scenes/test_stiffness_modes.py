"""Modes of stiffness: the energy by hand, derivatives, files, finer meshes."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import emulator as em
from emulator.core.errors import InputError
from emulator.fem.energy import strain_energy
from emulator.fem.fields import element_fields
from emulator.geometry.io import write_mesh
from emulator.scenes import Parameter
from emulator.scenes.effects import leave_out
from emulator.scenes.finer import finer
from emulator.scenes.loads import Gravity
from scene_support import block, slope

SIZES = tuple(Parameter(f"stiffness_mode_{k}", "", -2.0, 2.0) for k in (1, 2))


def uneven(scene=None):
    """A block with two modes: one everywhere, one that grows along x."""
    scene = block() if scene is None else scene
    x = scene.mesh.nodes[scene.mesh.corners].mean(axis=1)[:, 0]
    modes = np.column_stack([np.full(len(x), 0.3), x - 1.0])
    return replace(scene, stiffness_modes=modes, parameters=(*scene.parameters, *SIZES))


def test_a_uniform_deformation_has_the_energy_of_each_element():
    scene = uneven()
    F = np.eye(3) + 0.2 * np.random.default_rng(1).normal(size=(3, 3))
    u = jnp.asarray(scene.mesh.nodes @ (F - np.eye(3)).T)
    J, mu, lam, z = np.linalg.det(F), 2.0, 5.0, np.array([0.7, -1.1])
    shape = 0.5 * mu * (np.sum(F * F) - 3.0) - mu * np.log(J)
    volumes = scene.discretisation.weights.sum(axis=1)
    factors = np.exp(scene.stiffness_modes @ z)
    expected = volumes @ factors * shape + volumes.sum() * 0.5 * lam * np.log(J) ** 2
    theta = scene.theta(mu=mu, lam=lam, stiffness_mode_1=z[0], stiffness_mode_2=z[1])
    assert jax.jit(strain_energy(scene))(u, theta) == pytest.approx(expected, rel=1e-12)
    np.testing.assert_allclose(element_fields(scene, u, theta)["stiffness"], factors, rtol=1e-12)


def test_they_multiply_the_factors_of_regions():
    scene = uneven()
    regions = (np.arange(len(scene.mesh.elements)) % 2).astype(int)
    constants = {"stiffness_0": 2.0, "stiffness_1": 0.5}
    both = replace(scene, regions=regions, constants=constants)
    theta = scene.theta(mu=2.0, lam=5.0, stiffness_mode_1=0.4, stiffness_mode_2=0.9)
    u = jnp.asarray(0.05 * np.random.default_rng(2).normal(size=scene.held.shape))
    found = element_fields(both, u, theta)["stiffness"]
    alone = element_fields(scene, u, theta)["stiffness"]
    np.testing.assert_allclose(found, alone * np.where(regions == 0, 2.0, 0.5), rtol=1e-12)


def test_solutions_in_theta_taylor():
    scene = uneven(block(loads=(Gravity(density=500.0),)))
    simulator = em.Simulator(scene)
    weights = jnp.asarray(np.random.default_rng(6).normal(size=scene.held.shape))
    theta = scene.theta(mu=3.0, lam=5.0, stiffness_mode_1=0.5, stiffness_mode_2=-0.6)
    direction = jnp.array([0.0, 0.0, 1.0, -0.7])
    u = simulator(theta)
    gradient = jnp.tensordot(simulator.sensitivities(u, theta), weights, axes=2)
    assert (jnp.abs(gradient[2:]) > 1e-3).all()
    steps = 0.2 / 2.0 ** np.arange(4)
    ahead = np.array([jnp.vdot(weights, simulator(theta + h * direction)) for h in steps])
    left = np.abs(ahead - jnp.vdot(weights, u) - steps * (gradient @ direction))
    assert slope(steps, left) == pytest.approx(2.0, abs=0.15)


def test_files_finer_meshes_and_effects_have_them(tmp_path):
    scene = uneven()
    write_mesh(tmp_path / "block.vtu", scene.mesh, stiffness_modes=scene.stiffness_modes)
    (tmp_path / "block.toml").write_text(
        """
law = "neo_hookean"
mesh = "block.vtu"
stiffness_modes = "stiffness_modes"
[[supports]]
node_set = "left"
[[loads]]
kind = "gravity"
[constants]
lam = 5.0
[parameters.mu]
unit = "kPa"
range = [1.0, 10.0]
[parameters.stiffness_mode_1]
range = [-2.0, 2.0]
[parameters.stiffness_mode_2]
range = [-2.0, 2.0]
"""
    )
    read = em.find_scene(str(tmp_path / "block.toml"))
    np.testing.assert_array_equal(read.stiffness_modes, scene.stiffness_modes)
    fine = finer(read).scene
    theta = read.theta(mu=3.0, stiffness_mode_1=0.5, stiffness_mode_2=1.0)
    coarse_factors = element_fields(read, jnp.zeros(read.held.shape), theta)["stiffness"]
    fine_factors = element_fields(fine, jnp.zeros(fine.held.shape), theta)["stiffness"]
    np.testing.assert_array_equal(np.unique(coarse_factors), np.unique(fine_factors))
    other = replace(read, stiffness_modes=read.stiffness_modes[:, ::-1])
    assert not other.identity.agrees(read.identity)
    without = leave_out(read, ("a field of stiffness",))
    assert without.stiffness_modes is None
    assert without.parameter_names == ("mu",)


@pytest.mark.parametrize(
    ("modes", "words"),
    [
        (np.ones(48), r"shape \(48,\); expected \(48, k\)"),
        (np.ones((3, 2)), r"shape \(3, 2\)"),
        (np.full((48, 2), np.nan), "not finite"),
    ],
)
def test_modes_that_cannot_be_are_refused_in_a_line(modes, words):
    with pytest.raises(InputError, match=words):
        replace(uneven(), stiffness_modes=modes)
