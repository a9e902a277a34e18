import jax.numpy as jnp
import numpy as np
import pytest

import emulator as em
from emulator.evaluation import evaluate, field_errors
from emulator.forward import fem_forward
from scene_support import block


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
    Pi = em.potential_energy(scene)
    a, b = Pi(u, scene.centre), Pi(reference, scene.centre)
    assert errors["err_Pi"] == pytest.approx(100 * abs(float(a / b - 1)))


def test_fem_has_no_error(beam, simulator):
    report = evaluate(fem_forward(simulator), beam.centre[None], simulator(beam.centre)[None])
    assert report["err_u"]["max"] < 1e-9
    assert report["cases"] == 1
    assert report["units"]["err_Pi"] == "%"
