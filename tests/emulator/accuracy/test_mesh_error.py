"""The error of a mesh against a much finer one."""

import jax.numpy as jnp
import numpy as np
import pytest

import emulator as em
from emulator.accuracy.mesh_error import _weights
from emulator.core.errors import InputError
from emulator.scenes.finer import finer


@pytest.fixture(scope="module")
def coarse():
    return em.scenes.once_clamped_beam(cells=(4, 1, 1))


@pytest.fixture(scope="module")
def error(coarse):
    return em.mesh_error(coarse)


def test_a_finer_scene_has_the_same_problem(coarse):
    fine = finer(coarse).scene
    assert fine.parameters == coarse.parameters
    assert fine.loads == coarse.loads
    moved = finer(em.scenes.twisting_cube(cells=2)).scene
    cube = em.scenes.twisting_cube(cells=4)
    order, again = (np.lexsort(np.round(s.mesh.nodes, 9).T) for s in (moved, cube))
    # A face turned halfway along the chord is linear in place, so it is carried exactly.
    np.testing.assert_allclose(
        moved.held_displacement[order], cube.held_displacement[again], atol=1e-12
    )


def test_weights_are_the_least_of_the_documented_sum():
    """By least squares; and a multiple of one known solution is found."""
    rng = np.random.default_rng(0)
    known, u = rng.normal(size=(4, 30)), rng.normal(size=30)
    ridge = 1e-2 * np.sqrt(np.mean(np.sum(known**2, axis=1)))
    rows = np.vstack([known.T, ridge * np.eye(4)])
    expected = np.linalg.lstsq(rows, np.append(u, np.zeros(4)))[0]
    np.testing.assert_allclose(_weights(known, u), expected, atol=1e-12)
    np.testing.assert_allclose(_weights(known[:1], 1.4 * known[0]), [1.4], rtol=1e-3)
    assert np.isfinite(_weights(np.zeros((2, 30)), u)).all()


def test_a_few_steps_find_what_a_solve_on_the_finer_mesh_finds(coarse, error):
    first = error(coarse.centre)
    theta = coarse.from_unit(jnp.array([0.45, 0.55]))
    near = error(theta, known=[first])
    assert not near.solved
    for told in (first, near):
        exact = error.fine.solve(told.theta).require_converged().displacement
        wrong = float(jnp.abs(told.fine - exact).max())
        assert wrong < 0.05 * float(told.err_u.max())


def test_a_start_is_what_the_finer_mesh_adds_to_a_multiple_of_a_deformation(coarse, error):
    """Linear in a known solution: 1.2 times its displacement starts at 1.2 times the finer one."""
    first = error(coarse.centre)
    begin = error._combined(1.2 * first.coarse, [first])
    np.testing.assert_allclose(
        begin, 1.2 * first.fine, rtol=0, atol=3e-4 * float(first.err_u.max())
    )
    prolonged = error.finer.refinement.carry(1.2 * first.coarse)
    assert float(jnp.abs(begin - prolonged).max()) > 0.5 * float(first.err_u.max())


@pytest.mark.slow
def test_effectivity(coarse, error):
    """Beside a mesh so fine that its own error does not count."""
    told = error(coarse.centre)
    reference = em.scenes.once_clamped_beam(cells=(16, 4, 4))
    exact = em.Simulator(reference)(reference.centre)
    tip = np.array([100.0, 10.0, 10.0])
    at, there = (
        int(np.argmin(np.linalg.norm(s.mesh.nodes - tip, axis=1))) for s in (coarse, reference)
    )
    true = told.coarse[at] - exact[there]
    assert 0.6 < float(jnp.linalg.norm(told.field[at]) / jnp.linalg.norm(true)) < 1.1


@pytest.mark.slow
def test_locked_elements_are_far_off_and_said_so():
    scene = em.scenes.once_clamped_beam(cells=(4, 1, 1), order=1)
    told = em.mesh_error(scene)(scene.centre)
    assert float(told.err_u.max()) > 0.3 * float(jnp.linalg.norm(told.fine, axis=1).max())


def test_what_cannot_be_looked_at_is_refused(coarse):
    with pytest.raises(InputError, match="the mesh finer than that of 'once_clamped_beam' has"):
        em.mesh_error(coarse, most=100)
