"""An emulator of a finer mesh from one on the coarser mesh and a few runs."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import emulator as em
from emulator.catalogue import find_scene, finer_of
from emulator.core.errors import InputError
from emulator.fem import simulator as fem_simulator
from emulator.fem import sobol
from emulator.scenes.finer import finer
from emulator.surrogates import load, save_emulator
from emulator.training import recipe, train

PLAN = replace(recipe("two_meshes"), simulations=5)
MECHANICS = replace(recipe("mechanics"), simulations=12)


@pytest.fixture(scope="module")
def body():
    return finer(em.scenes.once_clamped_beam(cells=(4, 1, 1), order=1))


@pytest.fixture(scope="module")
def coarse(body, tmp_path_factory):
    return train(body.coarse, MECHANICS, tmp_path_factory.mktemp("coarse"))


@pytest.fixture(scope="module")
def fine(body, coarse, tmp_path_factory):
    return train(body.scene, PLAN, tmp_path_factory.mktemp("fine"), start=coarse)


@pytest.mark.slow
def test_a_few_runs_take_it_to_the_finer_mesh(body, fine):
    simulator, cached = em.Simulator(body.scene), fine.cache()
    without = replace(fine, discrepancy=None).cache()
    for theta in sobol(body.scene, 4, seed=7):
        exact = simulator(theta)
        size = jnp.linalg.norm(without(theta) - exact)
        assert jnp.linalg.norm(cached(theta) - exact) < 0.01 * size


@pytest.mark.slow
def test_the_coarse_part_is_the_same_function_of_place(body, coarse, fine):
    theta = body.scene.from_unit(jnp.array([0.2, 0.7]))
    below = body.refinement.carry(np.asarray(coarse.cache()(theta)))
    position = body.scene.to_unit(theta)
    part = fine.parts["coarse"]
    np.testing.assert_allclose(part(position), below, atol=1e-12)
    some = np.array([3, 30, 7])
    cached = part.cache(some)
    at = cached.offset + np.tensordot(cached.coefficients(position), cached.modes, axes=1)
    np.testing.assert_allclose(at, below[some], atol=1e-12)


@pytest.mark.slow
def test_it_is_kept_and_found_again(body, fine, tmp_path):
    save_emulator(fine, tmp_path)
    again = load(tmp_path)
    assert again.fingerprint == fine.fingerprint
    assert again.scene.fingerprint == body.scene.fingerprint
    theta = body.scene.centre
    np.testing.assert_array_equal(
        jax.jit(again.cache())(theta),
        jax.jit(fine.cache(np.arange(len(body.scene.mesh.nodes))))(theta),
    )


def test_a_finer_scene_has_a_name():
    refined = find_scene("finer:twisting_cube")
    assert refined.mesh.order == 2
    assert finer_of(refined).coarse.fingerprint == find_scene("twisting_cube").fingerprint


@pytest.mark.slow
def test_what_it_cannot_stand_on_is_refused(body, coarse, tmp_path):
    with pytest.raises(InputError, match="not on a mesh made finer; name it finer:"):
        train(body.coarse, PLAN, tmp_path, start=coarse)
    sweeps = replace(recipe("sweeps"), sweeps=5)
    with pytest.raises(InputError, match="not on a mesh made finer; name it finer:"):
        train(body.coarse, sweeps, tmp_path, start=coarse)
    with pytest.raises(InputError, match="and a series of order 3 to begin at; give one"):
        train(body.scene, replace(sweeps, order=3), tmp_path, start=coarse)
    other = finer(em.scenes.once_clamped_beam(cells=(3, 1, 1), order=1)).scene
    with pytest.raises(InputError, match="expected one of the mesh that finer:"):
        train(other, PLAN, tmp_path, start=coarse)
    with pytest.raises(InputError, match="as recipes mechanics and sweeps make"):
        train(body.scene, PLAN, tmp_path, start=replace(coarse, taylor=None, discrepancy=None))


@pytest.mark.slow
def test_it_resumes_on_the_emulator_it_stands_on(body, coarse, fine, tmp_path):
    """The one kept with the checkpoint, or the one given; no other."""
    again = train(body.scene, PLAN, tmp_path, start=coarse)
    assert again.fingerprint == fine.fingerprint
    again = train(body.scene, PLAN, tmp_path, start=coarse, resume=True)
    assert again.fingerprint == fine.fingerprint
    other = replace(coarse, discrepancy=None)
    with pytest.raises(InputError, match="stands on another emulator than is given"):
        train(body.scene, PLAN, tmp_path, resume=True, start=other)


@pytest.mark.slow
def test_sweeps_take_it_to_the_finer_mesh_without_a_run(tmp_path, monkeypatch):
    """Both meshes by the energy alone, kept and found again; what is left is told."""
    body = finer(em.scenes.twisting_cube(cells=2))
    tests, simulator = sobol(body.scene, 4, seed=7), em.Simulator(body.scene)
    exact = [simulator(theta) for theta in tests]

    def refuse(*_):
        raise AssertionError("a FEM solution was asked for")

    monkeypatch.setattr(fem_simulator, "differentiable", lambda *_: refuse)
    below = train(body.coarse, replace(recipe("sweeps"), sweeps=30), tmp_path / "coarse")
    plan = replace(recipe("sweeps"), sweeps=5)
    save_emulator(train(body.scene, plan, tmp_path / "fine", start=below), tmp_path / "kept")
    found = load(tmp_path / "kept")
    assert list(found.parts) == ["coarse", "polynomial"]
    carried = replace(found, polynomial=None)
    off = [[rms(one.cache()(t) - u) for t, u in zip(tests, exact, strict=True)]
           for one in (carried, found)]  # fmt: skip
    assert np.median(off[1]) < 0.02 * np.median(off[0])
    assert np.median(off[1]) < 5.0 * found.record["sweeps"]["error_mm"]


def rms(field):
    """Root mean square over the nodes, mm."""
    return float(jnp.sqrt(jnp.mean(jnp.sum(field**2, axis=-1))))
