import jax.numpy as jnp
import numpy as np
import pytest

import emulator as em
from emulator.accuracy.comparison import case_errors, evaluate, field_errors
from emulator.core.errors import SolverError
from emulator.fem.reactions import support_forces
from emulator.scenes.scene import find_cavity
from emulator.surrogates.fem import fem_forward
from network_support import untrained
from scene_support import between_plates, block


def test_errors_by_hand():
    scene = block()
    H = np.array([[0.1, 0.02, 0.0], [0.0, -0.05, 0.01], [0.03, 0.0, 0.07]])
    G = H + 0.01 * np.eye(3)
    u, reference = (jnp.asarray(scene.mesh.nodes @ h.T) for h in (G, H))
    errors = field_errors(scene, scene.centre, u, reference)
    np.testing.assert_allclose(errors["err_u"], 0.01 * np.linalg.norm(scene.mesh.nodes, axis=1))
    np.testing.assert_allclose(errors["err_F"], 0.01 * np.sqrt(3.0))
    I1 = lambda h: np.sum((np.eye(3) + h) ** 2)
    np.testing.assert_allclose(errors["err_I1"], I1(G) - I1(H), rtol=1e-10)
    E = lambda h: 0.5 * (h + h.T + h.T @ h)  # F = I + h, and E = (F'F - I) / 2
    np.testing.assert_allclose(errors["err_E"], np.abs(E(G) - E(H)).max(), rtol=1e-10)
    Pi = em.fem.potential_energy(scene)
    a, b = Pi(u, scene.centre), Pi(reference, scene.centre)
    assert errors["err_Pi"] == pytest.approx(100 * abs(float(a / b - 1)))


def test_fem_has_no_error(beam, simulator):
    report = evaluate(fem_forward(simulator), beam.centre[None], simulator(beam.centre)[None])
    assert report["err_u"]["max"] < 1e-9
    assert report["cases"] == 1
    assert report["units"]["err_Pi"] == "%"
    assert not {"err_V"} & {*report, *report["units"]}  # a beam has no cavity


def test_volume_error_by_hand():
    scene = em.scenes.left_ventricle(rings=3, around=8, layers=1, order=1)
    X = jnp.asarray(scene.mesh.nodes)
    cavity = find_cavity(scene)
    errors = field_errors(scene, scene.centre, 0.01 * X, 0.02 * X, [cavity])
    # Both are the cavity at rest, enlarged.
    assert errors["err_V"] == pytest.approx([100.0 * (1.0 - (1.01 / 1.02) ** 3)], rel=1e-10)


def test_size_of_the_reference(beam):
    u = jnp.zeros((2, *beam.held.shape)).at[0, 5].set(jnp.array([3.0, 0.0, 4.0]))
    u = u.at[1, 5].set(jnp.array([0.0, 1.0, 0.0]))
    report = evaluate(untrained(beam).cache(), jnp.stack([beam.centre] * 2), u)
    assert report["max_u"]["max"] == 5.0
    assert report["mean_u"]["mean"] == pytest.approx(3.0 / len(beam.mesh.nodes))


def test_cases_without_an_answer_are_counted_not_averaged(beam):
    forward = untrained(beam).cache()
    inside, outside = beam.centre, 1.5 * beam.centre
    thetas, zero = jnp.stack([inside, outside]), jnp.ones((2, *beam.held.shape))
    errors = case_errors(forward, thetas, zero)
    assert (len(errors.thetas), errors.invalid) == (1, 1)
    with pytest.raises(SolverError, match="emulator map has no valid answer for any of 1"):
        case_errors(forward, outside[None], zero[:1])


def test_forces_of_supports_are_compared_in_newtons():
    """Between plates a map that is right to 1e-3 mm may have forces that are far off."""
    scene = between_plates()
    simulator = em.Simulator(scene)
    theta = scene.theta(mu=4.0, shear=0.3, stretch=0.1)
    u = simulator(theta)
    off = u.at[np.flatnonzero(~scene.held.any(axis=1))[0], 0].add(0.02)
    forces = support_forces(scene)
    assert sorted(forces) == [f"{name}:{axis}" for name in ("bottom", "top") for axis in "xyz"]
    errors = field_errors(scene, theta, off, u, supports=tuple(forces.values()))
    exact, wrong = (np.asarray(simulator.reaction("top", v, theta)) / 1e3 for v in (u, off))
    by_name = dict(zip(forces, errors["err_R"], strict=True))
    found = [by_name[f"top:{axis}"] for axis in "xyz"]
    np.testing.assert_allclose(found, np.abs(wrong - exact), rtol=1e-8, atol=1e-12)
    assert float(errors["max_R"]) == pytest.approx(np.abs(exact).max(), rel=1e-8)
    report = evaluate(fem_forward(simulator), theta[None], off[None])
    assert report["err_R"]["max"] == pytest.approx(float(errors["err_R"].max()), rel=1e-6)
    assert (report["units"]["err_R"], report["units"]["max_R"]) == ("N", "N")
