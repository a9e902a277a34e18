"""What a training step minimises, by hand and by differences."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import emulator as em
from emulator.fem import Runs, run_campaign, sobol
from emulator.surrogates import Architecture
from emulator.training.graph_network import GraphNetwork
from emulator.training.objectives import OBJECTIVES, Scales, loss_scales, make_loss
from emulator.training.plan import Job

SMALL = Architecture(steps=2, latent=8, hidden=(16, 16))
SCALES = Scales(displacement=2.0, gradient=0.3, energy=7.0)


@pytest.fixture(scope="module")
def tests(beam, simulator):
    return run_campaign(simulator, sobol(beam, 6, seed=5))


def test_objectives_by_hand(beam, tests):
    u = tests.displacement + 0.1
    batch = Runs(*tests[:3])
    Pi = em.potential_energy(beam)
    values = np.array([Pi(v, t) for v, t in zip(u, tests.theta, strict=True)])
    misfit = 3 * 0.1**2 / 4.0
    gap = np.mean((values - tests.energy) / np.abs(tests.energy))
    expected = {
        "energy": values.mean() / 7.0,
        "simulations": misfit,
        "gradients": misfit,  # a shift has none
        "both": misfit + 0.3 * gap,
    }
    assert set(expected) == set(OBJECTIVES)
    for objective, value in expected.items():
        loss = make_loss(beam, objective, SCALES)
        assert float(loss(u, batch)) == pytest.approx(float(value), rel=1e-12)
    # At the solutions nothing is left but round-off.
    assert abs(make_loss(beam, "both", SCALES)(tests.displacement, batch)) < 1e-12
    assert float(make_loss(beam, "gradients", SCALES)(tests.displacement, batch)) == 0.0


def rough(tests):
    """The solutions with noise that has gradients, (c, n, 3) mm."""
    noise = np.random.default_rng(3).normal(0.0, 0.1, tests.displacement.shape)
    return np.asarray(tests.displacement) + noise


def deformation_gradients(mesh, u):
    """F (m, 3, 3) of linear tetrahedra from their edges before and after, and volumes (m,) mm3."""
    before, after = (
        np.swapaxes(x[mesh.elements[:, 1:]] - x[mesh.elements[:, :1]], 1, 2)
        for x in (mesh.nodes, mesh.nodes + u)
    )
    return after @ np.linalg.inv(before), np.abs(np.linalg.det(before)) / 6.0


def test_gradients_by_an_independent_evaluation(tests):
    """On elements of unequal volume."""
    bent = em.scenes.once_clamped_beam(cells=(4, 2, 2), order=1)
    nodes = bent.mesh.nodes.copy()
    nodes[:, 0] = 100.0 * (nodes[:, 0] / 100.0) ** 2
    graded = replace(bent, mesh=replace(bent.mesh, nodes=nodes), origin={})
    u = rough(tests)
    misfits = []
    for found, exact in zip(u, np.asarray(tests.displacement), strict=True):
        F, volume = deformation_gradients(graded.mesh, found)
        error = F - deformation_gradients(graded.mesh, exact)[0]
        F_part = np.average(np.sum(error**2, axis=(1, 2)), weights=volume) / SCALES.gradient**2
        u_part = np.mean(np.sum((found - exact) ** 2, axis=1)) / SCALES.displacement**2
        misfits.append(u_part + F_part)
    assert np.ptp(volume) > volume.min()
    loss = make_loss(graded, "gradients", SCALES)(jnp.asarray(u), Runs(*tests[:3]))
    assert float(loss) == pytest.approx(np.mean(misfits), rel=1e-12)


def test_the_slope_of_gradients_by_differences(beam, tests):
    loss = make_loss(beam, "gradients", SCALES)
    batch, u = Runs(*tests[:3]), rough(tests)
    direction = np.random.default_rng(4).normal(size=u.shape)
    step = 1e-3  # the loss is quadratic: differences are exact but for round-off
    ahead, behind = (loss(jnp.asarray(u + sign * step * direction), batch) for sign in (1, -1))
    slope = jax.grad(loss)(jnp.asarray(u), batch)
    by_differences = float(ahead - behind) / (2.0 * step)
    assert float(jnp.vdot(slope, direction)) == pytest.approx(by_differences, rel=1e-9)


@pytest.mark.parametrize("objective", ["energy", "simulations", "both"])
def test_other_objectives_do_not_know_the_scale_of_gradients(beam, tests, objective):
    u, batch = jnp.asarray(rough(tests)), Runs(*tests[:3])
    without = SCALES._replace(gradient=float("nan"))
    one, other = (make_loss(beam, objective, scales)(u, batch) for scales in (SCALES, without))
    assert float(one) == float(other)


def test_both_terms_of_gradients_are_one_at_the_centre(beam):
    """Over the runs its scales were taken from."""
    plan = GraphNetwork(objective="gradients", steps=1, simulations=8, batch=4)
    runs = plan.prepare(Job(beam, SMALL)).runs
    scales = loss_scales(beam, runs, from_runs=True)
    batch = Runs(*runs.take(slice(1, None))[:3])
    centre = jnp.broadcast_to(runs.displacement[0], batch.displacement.shape)
    simulations, gradients = (
        float(make_loss(beam, name, scales)(centre, batch)) for name in ("simulations", "gradients")
    )
    assert simulations == pytest.approx(1.0, rel=1e-12)
    assert gradients - simulations == pytest.approx(1.0, rel=1e-12)
