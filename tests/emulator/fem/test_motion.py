"""Bodies with inertia, dashpots and rates: against solvers of ordinary differential equations."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from skfem import Basis, BilinearForm, ElementTetP1, ElementTetP2, MeshTet
from skfem.helpers import dot

import emulator as em
from emulator.core.errors import InputError
from emulator.fem.energy import potential_energy
from emulator.fem.through_time import masses_of
from emulator.geometry.generators.box import box
from emulator.mechanics.kinematics import Strain
from emulator.scenes.supports import Dashpots, ElasticSupport

MU = em.Parameter("mu", "kPa", 1.0, 50.0)
TIME = em.Parameter("time", "s", 0.0, 100.0)
PULL = em.Parameter("pull", "kPa", -10.0, 10.0)
LAW = em.find_law("neo_hookean_split")
KAPPA = 20.0
HEAVY = {"density": 1.2}


def bar(order=1, **changes):
    """A bar clamped at its left end and pulled at its right one."""
    scene = em.Scene(
        name="bar",
        mesh=box((2.0, 1.0, 1.0), (2, 1, 1), order),
        law=LAW,
        parameters=(MU, PULL, TIME),
        constants={"kappa": KAPPA},
        loads=(em.loads.DeadPressure("right", parameter="pull"),),
        supports=(em.Support("left"),),
        inertia=HEAVY,
    )
    return replace(scene, **changes)


def path(loads, times, tissue=(8.0,)):
    """Theta at each time: the tissue, the load, the time."""
    rows = zip(loads, times, strict=True)
    return jnp.stack([jnp.append(jnp.asarray(tissue), jnp.array(row)) for row in rows])


def smooth(times):
    """A pull that begins and goes on smoothly."""
    return 3.0 * np.sin(1500.0 * np.asarray(times)) ** 2


@pytest.mark.parametrize("order", [1, 2])
def test_masses_are_those_of_another_assembly(order):
    mesh = box((2.0, 1.0, 1.0), (2, 1, 1), order)
    grid = bar(order).discretisation
    M = np.zeros((len(mesh.nodes),) * 2)
    for nodes, local in zip(grid.connectivity, masses_of(grid), strict=True):
        M[np.ix_(nodes, nodes)] += local
    assert M.sum() == pytest.approx(2.0, rel=1e-12)  # the volume
    corners = MeshTet(mesh.nodes.T[:, : mesh.elements[:, :4].max() + 1], mesh.elements[:, :4].T)
    basis = Basis(corners, {1: ElementTetP1(), 2: ElementTetP2()}[order], intorder=2 * order)
    other = BilinearForm(lambda u, v, _: dot(u, v) if u.ndim > 2 else u * v).assemble(basis)
    np.testing.assert_allclose(np.sort(other.diagonal()), np.sort(np.diag(M)), rtol=1e-10)
    assert np.linalg.eigvalsh(M)[0] > 0.0


@pytest.fixture(scope="module")
def vibration():
    """Displacements of the bar's tip by an ODE solver of high order, without this package's steps."""
    still = bar(inertia=None, parameters=(MU, PULL))
    energy = potential_energy(still)
    force = jax.jit(jax.grad(lambda u, pull: energy(u, jnp.array([8.0, pull]))))
    grid, count = still.discretisation, still.node_count
    M = np.zeros((count, count))
    for nodes, local in zip(grid.connectivity, masses_of(grid), strict=True):
        M[np.ix_(nodes, nodes)] += 1.2e-6 * local
    free = ~still.held[:, 0]
    inverse = np.linalg.inv(M[np.ix_(free, free)])

    def rates(time, state):
        u, v = state.reshape(2, -1, 3)
        whole = np.zeros((count, 3))
        whole[free] = u
        a = -inverse @ np.asarray(force(jnp.asarray(whole), smooth(time)))[free]
        return np.concatenate([v.ravel(), a.ravel()])

    times, zero = np.linspace(0.0, 4e-3, 33)[1:], np.zeros(6 * free.sum())
    run = solve_ivp(rates, (0.0, 4e-3), zero, "DOP853", times, rtol=1e-9, atol=1e-11)
    u = np.zeros((len(times), count, 3))
    u[:, free] = run.y.T[:, : run.y.shape[0] // 2].reshape(len(times), -1, 3)
    return times, u


def test_a_vibration_is_that_of_an_ode_solver_and_of_second_order(vibration):
    times, expected = vibration
    simulator, errors = em.Simulator(bar()), []
    for finer in (4, 8):
        steps = np.linspace(0.0, times[-1], finer * len(times) + 1)[1:]
        solution = simulator.path(path(smooth(steps), steps))
        assert not solution.status.any()
        errors.append(np.abs(solution.displacement[finer - 1 :: finer] - expected).max())
    assert np.abs(expected).max() > 0.1  # mm
    assert errors[1] < 0.01 * np.abs(expected).max()
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.15)


def test_a_free_body_falls():
    """Without supports; the weight is reached evenly within the first step."""
    scene = bar(
        supports=(),
        loads=(em.loads.Gravity(density=1.2), em.loads.DeadPressure("right", parameter="pull")),
        inertia={**HEAVY, "spectral_radius": 1.0},
    )
    h, g, times = 0.01, 9810.0, np.linspace(0.0, 0.1, 11)[1:]  # s, mm/s2
    u = em.Simulator(scene).path(path(np.zeros(10), times)).displacement
    since = times - h
    expected = -g * (
        h**2 / 4.0 + 0.5 * h * since + 0.5 * since**2
    )  # a parabola from the first step
    np.testing.assert_allclose(u[:, :, 2], np.tile(expected[:, None], u.shape[1]), rtol=1e-9)


def test_dashpots_let_a_block_drift_and_springs_stop_it():
    """A stiff block on a spring and a dashpot under a constant pull: an exponential creep."""
    scene = bar(
        supports=(
            em.Support("left", components="yz"),
            ElasticSupport("left", 2.0),
            Dashpots("left", 4.0, "normal"),
        ),
        inertia=None,
    )  # the area is 1 mm2: k = 2 mN/mm, c = 4 mN s/mm, no mass
    times = np.concatenate([[1e-4], np.linspace(0.0, 6.0, 241)[1:]])
    u = em.Simulator(scene).path(path(np.full(len(times), -1.0), times, (50.0,))).displacement
    left = scene.mesh.node_set("left")
    expected = 0.5 * (1.0 - np.exp(-times / 2.0))
    np.testing.assert_allclose(u[:, left, 0].mean(axis=1), expected, atol=2e-3)


def test_kelvin_voigt_creeps_as_its_equation_says():
    """A block under a dead pull, free to contract: the stretches of an ODE solver."""
    eta = em.Parameter("eta", "kPa s", 0.0, 100.0)
    scene = em.Scene(
        name="creep",
        mesh=box((1.0, 1.0, 1.0), (1, 1, 1), 1),
        law=LAW,
        parameters=(MU, eta, PULL, TIME),
        constants={"kappa": KAPPA},
        loads=(em.loads.DeadPressure("right", parameter="pull"),),
        supports=(
            em.Support("left", components="x"),
            em.Support("front", components="y"),
            em.Support("bottom", components="z"),
        ),
        viscosity={"kind": "kelvin_voigt"},
    )
    pull = lambda time: 5.0 * np.sin(time) ** 2
    energy = lambda H: LAW.energy(Strain(H), 8.0, KAPPA)
    stress = jax.jit(jax.grad(lambda stretch: energy(jnp.diag(stretch - 1.0))))

    def rates(time, stretch):
        pulled = np.array([pull(time), 0.0, 0.0])
        return (pulled - np.asarray(stress(jnp.asarray(stretch)))) / (3.0 * stretch**2)

    def pulled_out(count):
        times = np.linspace(0.0, 4.0, count + 1)[1:]
        thetas = path(-pull(times), times, (8.0, 3.0))
        solution = em.Simulator(scene).path(thetas)
        assert not solution.status.any()
        far = np.argmax(scene.mesh.nodes.sum(axis=1))
        return times, 1.0 + np.asarray(solution.displacement[:, far])

    exact = solve_ivp(rates, (0.0, 4.0), np.ones(3), "DOP853", dense_output=True, max_step=0.05,
                      rtol=1e-9, atol=1e-11).sol  # fmt: skip
    errors = []
    for count in (40, 80):
        times, stretches = pulled_out(count)
        errors.append(np.abs(stretches - exact(times).T).max())
    assert exact(2.0)[0] > 1.1
    assert errors[1] < 2e-3
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.15)
    # As fast as can be nothing moves; as slowly, the rate is nothing.
    quick = em.Simulator(scene).path(path([-5.0], [1e-6], (8.0, 3.0)))
    assert np.abs(quick.displacement).max() < 1e-5
    slow = em.Simulator(scene).path(path([-5.0], [1e6], (8.0, 3.0)))
    elastic = replace(scene, viscosity=None, parameters=(MU, PULL))
    expected = em.Simulator(elastic)(jnp.array([8.0, -5.0]))
    np.testing.assert_allclose(slow.displacement[0], expected, atol=1e-5)


def test_derivatives_through_a_vibration_are_those_of_differences():
    simulator = em.Simulator(bar(supports=(em.Support("left"), Dashpots("right", 1e-4))))
    times = np.linspace(0.0, 2e-3, 11)[1:]

    def tip(mu):
        return simulator.path(path(smooth(times), times, (mu,))).displacement[:, -1]

    found = jax.jacfwd(tip)(8.0)
    expected = (tip(8.0 + 1e-4) - tip(8.0 - 1e-4)) / 2e-4
    np.testing.assert_allclose(found, expected, atol=1e-7 * np.abs(found).max())
    assert np.abs(found).max() > 1e-3


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: bar(inertia={"density": 0.0}), "density is 0.0 g/cm3; it must be above 0"),
        (lambda: bar(inertia={"density": np.nan}), "density is nan g/cm3"),
        (lambda: bar(inertia={"mass": 1.0}), "inertia: entry 'mass'"),
        (lambda: bar(inertia={"spectral_radius": 1.5}), "give a share from 0 to 1"),
        (lambda: bar(parameters=(MU, PULL)), "a body in time needs 'time'"),
        (lambda: bar(inertia=None, parameters=(MU, PULL), supports=()), "could move freely"),
        (
            lambda: bar(
                inertia=None, parameters=(MU, PULL),
                supports=(em.Support("left"), Dashpots("right", 1.0)),
            ),
            "a body in time needs 'time'",
        ),
        (lambda: Dashpots("right", 0.0), "damping is 0.0 kPa s/mm; it must be above 0"),
        (lambda: bar(viscosity={"kind": "kelvin_voigt", "terms": 1}), "has no terms"),
        (lambda: em.Simulator(bar()).solve(jnp.ones(3)), "goes through time: follow it by"),
        (
            lambda: em.Simulator(bar()).path(path([1.0, 1.0], [1.0, 1.0])),
            "row 2: time stays 1 s; with inertia or a rate it must rise",
        ),
        (lambda: em.Simulator(bar()).path(path([1.0], [0.0])), "row 1: time stays 0 s"),
    ],
)  # fmt: skip
def test_what_makes_no_sense_is_refused_in_one_line(make, says):
    with pytest.raises(InputError) as caught:
        make()
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)
