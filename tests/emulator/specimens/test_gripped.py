"""Specimens between their grips: exact cases, mean stresses, marks, and what is learned."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import calibrate as cal
import emulator as em
from emulator.core.errors import InputError
from emulator.fem.energy import strain_energy
from emulator.specimens.gripped import GrippedSpecimen, learn_grips
from emulator.specimens.grips import Grips, GripStresses
from emulator.specimens.piece import pieces
from emulator.specimens.specimen import specimen
from emulator.specimens.states import states

PULL = np.array([1.0, 1.05, 1.1, 1.2])
ISOTROPIC = {
    "law": em.find_law("neo_hookean"),
    "parameters": (em.Parameter("mu", "kPa", 5.0, 20.0), em.Parameter("lam", "kPa", 1e-9, 100.0)),
}
BIAXIAL = states({"stretch_x": PULL, "stretch_y": 0.5 + 0.5 * PULL})
HOOKS = Grips((6.0, 5.0, 1.0), "hooks", hooks=2, cells=4, marks=2.0)
THETA = jnp.array([10.0, 40.0])


def clamped(marks=None):
    """A strip of 8 by 4 by 2 mm, its ends in clamps."""
    grips = Grips((8.0, 4.0, 2.0), cells=4, marks=marks)
    return specimen({"stretch_x": PULL}, grips=grips, **ISOTROPIC)


@pytest.fixture(scope="module")
def strip():
    return GrippedSpecimen(clamped())


@pytest.fixture(scope="module")
def membrane():
    return specimen(BIAXIAL, grips=HOOKS, **ISOTROPIC)


def test_clamps_add_nothing_where_the_tissue_does_not_contract(strip):
    # With lam = 0 nothing pulls across, so that a clamped strip stretches evenly.
    shares = strip.shares(jnp.array([10.0, 1e-9]))
    np.testing.assert_allclose(shares[:, 0, 0], 0.0, atol=1e-7)


def test_only_what_acts_on_a_grip_is_known(strip, membrane):
    shares = strip.shares(THETA)
    assert np.isfinite(shares[:, :, 0]).all()  # a clamp may hold forces across
    assert np.isnan(shares[:, :, 1:]).all()
    (piece,) = set(pieces(membrane).values())
    np.testing.assert_array_equal(piece.acting, np.diag([True, True, False]))


def test_a_clamped_strip_is_stiffer_and_its_stress_is_the_slope_of_its_energy(strip):
    (piece,) = strip.simulators
    simulator, energy = strip.simulators[piece], jax.jit(strain_energy(piece.scene))

    def least(stretch):
        theta = jnp.concatenate([THETA, jnp.array([stretch - 1.0])])
        return energy(simulator.solve(theta).require_converged("strip").displacement, theta)

    step, volume = 1e-4, 8.0 * 4.0 * 2.0
    slope = float(least(1.2 + step) - least(1.2 - step)) / (2.0 * step * volume)
    assert strip.stresses(THETA)[-1, 0, 0] == pytest.approx(slope, rel=1e-6)
    assert strip.shares(THETA)[-1, 0, 0] > 0.02


def test_marks_on_the_whole_piece_measure_the_grips(strip):
    by_marks = GrippedSpecimen(clamped(marks=7.999))
    np.testing.assert_allclose(
        by_marks.stresses(THETA)[:, 0, 0], strip.stresses(THETA)[:, 0, 0], rtol=1e-4
    )


def test_marks_have_moved_as_was_measured(membrane):
    gripped = GrippedSpecimen(membrane)
    (piece,) = gripped.simulators
    at = None
    followed = gripped.path("", THETA)
    for H, at in zip(BIAXIAL.gradients[1:], followed[1:], strict=True):
        np.testing.assert_allclose(piece.between_marks(np.asarray(at.u)), np.diag(H)[:2], atol=1e-5)
    assert at is not None
    assert at.q[0] > 0.21  # hooks move more than the middle


@pytest.mark.slow
def test_a_thick_layer_between_plates_is_sheared_less_evenly_than_a_thin_one():
    sheared = {"stretch_x": np.ones(2), "stretch_y": np.ones(2), "shear_xy": [0.1, 0.2]}

    def share(height):
        grips = Grips((6.0, height, 6.0), cells=4)
        return GrippedSpecimen(specimen(sheared, grips=grips, **ISOTROPIC)).shares(THETA)[-1, 0, 1]

    assert share(6.0) < share(2.0) < 0.0  # free sides take a part of the shear away


def test_states_between_those_that_are_solved(strip):
    many = specimen(
        {"stretch_x": np.linspace(1.0, 1.2, 13)}, grips=strip.specimen.grips, **ISOTROPIC
    )
    gripped = GrippedSpecimen(many)
    u = gripped.homogeneous.solve(THETA).displacement
    exact = gripped.stresses(THETA)[:, 0, 0]
    observe = cal.stresses(many, "stress_x")
    found = observe.gripped(gripped.shares(THETA))(u, THETA)[:, 0]
    np.testing.assert_allclose(found, exact, rtol=2e-4, atol=1e-9)


def test_a_test_that_was_held_still(strip):
    """States that repeat without motion have the shares of their first."""
    held = specimen(
        {"stretch_x": np.array([1.0, 1.05, 1.05, 1.1, 1.2, 1.2])},
        grips=clamped().grips,
        **ISOTROPIC,
    )
    shares = strip.shares(THETA)[:, :, 0]
    np.testing.assert_allclose(
        GrippedSpecimen(held).shares(THETA)[:, :, 0], shares[[0, 1, 1, 2, 3, 3]], atol=1e-9
    )


@pytest.fixture(scope="module")
def learned(strip):
    return learn_grips(strip.specimen, 20)


def test_learned_grips_are_added_to_stresses_of_any_map(strip, learned, tmp_path):
    assert learned.error < 0.01
    learned.write(tmp_path / "grips.safetensors")
    read = GripStresses.read(tmp_path / "grips.safetensors")
    grips = replace(strip.specimen.grips, learned=read)
    scene = specimen({"stretch_x": PULL}, grips=grips, **ISOTROPIC)
    theta = jnp.array([8.0, 30.0])
    forward, observe = em.homogeneous(scene), cal.stresses(scene, "stress_x")
    found = jax.jit(lambda theta: observe(forward(theta), theta))(theta)[:, 0]
    exact = strip.stresses(theta)[:, 0, 0]
    np.testing.assert_allclose(found, exact, rtol=0.01, atol=1e-9)
    assert np.isfinite(jax.jacfwd(lambda t: observe(forward(t), t))(theta)).all()


def test_learned_grips_of_another_size_are_refused(learned):
    grips = Grips((9.0, 4.0, 2.0), cells=4, learned=learned)
    scene = specimen({"stretch_x": PULL}, grips=grips, **ISOTROPIC)
    with pytest.raises(InputError, match="another specimen, range or grips"):
        cal.stresses(scene, "stress_x")(em.homogeneous(scene)(THETA), THETA)


def test_a_component_that_acts_on_no_grip_is_refused(strip):
    observe = cal.stresses(strip.specimen, "stress_y")
    with pytest.raises(InputError, match="acts on no grip"):
        observe.gripped(strip.shares(THETA))


@pytest.mark.parametrize(
    ("grips", "given", "words"),
    [
        (Grips((5.0, 5.0, 1.0)), BIAXIAL, "would tear at their common edges"),
        (HOOKS, states({"stretch_x": [1.0, 1.0], "shear_xy": [0.1, 0.2]}), "do not shear"),
        (
            Grips((5.0, 5.0, 1.0), "hooks"),
            states({f"stretch_{axis}": [1.1, 1.2] for axis in "xyz"}),
            "hooks hold two",
        ),
    ],
)
def test_grips_that_cannot_hold_a_test_are_refused(grips, given, words):
    with pytest.raises(InputError, match=words):
        GrippedSpecimen(specimen(given, grips=grips, **ISOTROPIC))


@pytest.mark.parametrize(
    ("entries", "words"),
    [
        ({"size": (1.0, 0.0, 1.0)}, "three lengths above 0"),
        ({"hooks": 1}, "give 2 or more"),
        ({"marks": 9.0}, "below that of the piece"),
    ],
)
def test_grips_that_are_none_are_refused(entries, words):
    with pytest.raises(InputError, match=words):
        Grips(**{"size": (5.0, 5.0, 1.0), **entries})
