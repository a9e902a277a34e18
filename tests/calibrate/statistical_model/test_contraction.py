"""A ventricle filled and contracted: two load states that share passive material."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
import pytest

import calibrate as cal
import emulator as em
from emulator.scenes import Parameter
from emulator.scenes.loads import ActiveTension
from linear_support import linear_forward

KNOWN = {"pressure@ED": 1.2, "pressure@ES": 14.0, "tension@ED": 0.0, "b": 2.0, "b_f": 2.0}


def beating(**mesh):
    """A coarse ventricle; theta = (a, b, a_f, b_f, pressure, tension)."""
    base = em.scenes.left_ventricle(**mesh, order=1, kappa=200.0)
    varied = (Parameter("pressure", "kPa", 0.1, 20.0), Parameter("tension", "kPa", 0.0, 120.0))
    return replace(
        base,
        parameters=(*base.parameters[:-1], *varied),
        loads=(*base.loads, ActiveTension()),
        origin={},
    )


def two_states(forward, known):
    volume = cal.CavityVolume(forward.scene)
    return cal.model(
        forward,
        {"volume@ED": volume, "volume@ES": volume},
        cal.GaussianNoise(sd=1.0),
        prior={"tension@ES": dist.Uniform(0.0, 120.0)},
        known=known,
    )


def test_tension_belongs_to_a_state_and_the_passive_material_does_not():
    model = two_states(linear_forward(beating(rings=3, around=6, layers=1), size=1.0), KNOWN)
    assert model.states.unknowns == ("a", "a_f", "tension@ES")
    thetas = model.states.thetas({"a": 0.3, "a_f": 5.0, "tension@ES": 60.0})
    np.testing.assert_allclose(thetas[0], [0.3, 2.0, 5.0, 2.0, 1.2, 0.0])
    np.testing.assert_allclose(thetas[1], [0.3, 2.0, 5.0, 2.0, 14.0, 60.0])


@pytest.mark.slow
def test_contractility_from_the_volumes_of_diastole_and_systole():
    """Two volumes give two unknowns: Gauss-Newton on the model's predictions, by FEM."""
    forward = em.fem_forward(em.Simulator(beating(rings=3, around=6, layers=1)))
    model = two_states(forward, {**KNOWN, "a_f": 5.0})
    assert model.names == ("a", "tension@ES")

    @jax.jit
    def volumes(unknowns):
        found, valid = model.predict(dict(zip(model.names, unknowns, strict=True)))
        return jnp.stack([found["volume@ED"], found["volume@ES"]]), valid

    truth = jnp.array([0.3, 60.0])
    data, valid = volumes(truth)
    assert bool(valid)
    assert data[1] < 0.9 * data[0]
    guess = jnp.array([0.4, 40.0])
    for _ in range(6):
        (found, _), slope = volumes(guess), jax.jacfwd(lambda x: volumes(x)[0])(guess)
        guess = guess - jnp.asarray(np.linalg.solve(slope, found - data))
    np.testing.assert_allclose(guess, truth, rtol=1e-6)
