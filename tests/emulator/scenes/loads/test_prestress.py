"""Tension of a sheet as it lies, against its energy by invariants and a strip by hand."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import emulator as em
from emulator.core.errors import InputError
from emulator.fem.assembly import System
from emulator.fem.energy import local_terms
from emulator.fem.fields import element_fields
from emulator.fem.reactions import SupportForce
from emulator.geometry.generators.box import box
from emulator.mechanics.laws import find_law
from emulator.scenes import Parameter, Scene, Support
from emulator.scenes.effects import leave_out
from emulator.scenes.loads import Prestress

TENSION = Parameter("prestress", "kPa", 0.0, 10.0)


def sheet(**changes) -> Scene:
    """A block whose left half is five times as soft, held at both ends; the right one moves."""
    mesh = box((8.0, 4.0, 1.0), (4, 2, 1), order=2)
    middles = mesh.nodes[mesh.corners].mean(axis=1)
    scene = Scene(
        name="sheet",
        mesh=mesh,
        law=find_law("neo_hookean_split"),
        parameters=(
            Parameter("mu", "kPa", 1.0, 10.0),
            TENSION,
            Parameter("pull", "", 0.0, 2.0),
        ),
        constants={"kappa": 50.0, "stiffness_0": 0.2, "stiffness_1": 1.0},
        loads=(Prestress(),),
        supports=(
            Support("left"),
            Support("right", (1.0, 0.0, 0.0), amount="pull"),
            Support("front", components="y"),
            Support("back", components="y"),
            Support("bottom", components="z"),
        ),
        regions=(middles[:, 0] > 4.0).astype(int),
    )
    return replace(scene, **changes)


def test_energy_and_force_are_those_of_the_invariants():
    scene, theta = sheet(), jnp.array([2.0, 3.0, 0.0])
    u = 0.2 * jax.random.normal(jax.random.key(1), scene.held.shape)
    values, (term,) = scene.resolve(theta), local_terms(scene)

    def by_invariants(v):
        F = scene.gradients(v) + jnp.eye(3)
        in_plane = jnp.sum(F[..., :2] ** 2, axis=(-2, -1)) - 2.0
        return jnp.sum(scene.discretisation.weights * 1.5 * in_plane)

    np.testing.assert_allclose(term.total(u, values), by_invariants(u), rtol=1e-12)
    force = jax.grad(by_invariants)(u)
    np.testing.assert_allclose(jax.grad(term.total)(u, values), force, atol=1e-11)
    np.testing.assert_allclose(System(scene).external_force(u, theta), -force, atol=1e-11)


def test_a_sheet_of_uneven_stiffness_lies_in_equilibrium_and_resists_at_once():
    scene = sheet()
    u = em.Simulator(scene).solve(scene.theta(mu=2.0, prestress=3.0, pull=0.0)).require_converged()
    np.testing.assert_allclose(u.displacement, 0.0, atol=1e-12)
    force = SupportForce(scene, "right", (1.0, 0.0, 0.0))
    at_rest = force(u.displacement[force.nodes], scene.theta(mu=2.0, prestress=3.0, pull=0.0))
    assert at_rest == pytest.approx(3.0 * 4.0 * 1.0, rel=1e-12)  # kPa over the end's area, mN
    stress = element_fields(scene, u.displacement, scene.theta(mu=2.0, prestress=3.0, pull=0.0))
    expected = np.broadcast_to(np.diag([3.0, 3.0, 0.0]), stress["cauchy_stress"].shape)
    np.testing.assert_allclose(stress["cauchy_stress"], expected, atol=1e-10)


def test_it_belongs_to_the_body_and_can_be_left_out():
    scene = sheet()
    assert scene.load_parameters == ("pull",)
    assert leave_out(scene, ("prestress",)).loads == ()


@pytest.mark.parametrize("wrong", [{"tension": -1.0}, {"normal": "u"}, {"tension": np.inf}])
def test_a_tension_that_cannot_be_is_refused(wrong):
    with pytest.raises(InputError, match="prestress"):
        Prestress(**wrong)
