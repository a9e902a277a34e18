"""A body with viscosity: against specimens, elastic limits, differences, and what is refused."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import emulator as em
from emulator.core.errors import InputError
from emulator.fem.energy import potential_energy
from emulator.fem.newton import NewtonOptions
from emulator.fem.solution import Status
from emulator.fem.through_time import StepLaw
from emulator.geometry.generators.box import box
from emulator.mechanics.kinematics import Strain

MU, G, TAU = 8.0, 0.5, 2.0
OF_TISSUE = (
    em.Parameter("mu", "kPa", 1.0, 50.0),
    em.Parameter("relaxation_1", "", 1e-6, 0.99),
    em.Parameter("tau_1", "s", 1e-9, 1e12, "log"),
)
TIME = em.Parameter("time", "s", 0.0, 100.0)
PRONY = {"kind": "prony"}
TIMES = np.concatenate([np.linspace(0.0, 1.0, 6), [1.5, 3.0, 6.0]])
PULLS = np.minimum(TIMES, 1.0)


def pulled(order=2, cells=(1, 1, 1), **changes):
    """A block that is pulled along x by up to a fifth, free to contract."""
    scene = em.Scene(
        name="pulled",
        mesh=box((1.0, 1.0, 1.0), cells, order),
        law=em.find_law("neo_hookean_split"),
        parameters=(*OF_TISSUE, em.Parameter("pull", "", 0.0, 1.0), TIME),
        constants={"kappa": 100.0},
        supports=(
            em.Support("left", components="x"),
            em.Support("front", components="y"),
            em.Support("bottom", components="z"),
            em.Support("right", (0.2, 0.0, 0.0), "x", amount="pull"),
        ),
        viscosity=PRONY,
    )
    return replace(scene, **changes)


def clamped(**changes):
    """A block whose ends are clamped, so that it deforms unevenly, under a dead traction."""
    scene = em.Scene(
        name="clamped",
        mesh=box((2.0, 1.0, 1.0), (2, 1, 1), 1),
        law=em.find_law("neo_hookean_split"),
        parameters=(*OF_TISSUE, em.Parameter("pull", "kPa", 0.0, 10.0), TIME),
        constants={"kappa": 100.0},
        loads=(em.loads.DeadPressure("right", parameter="pull"),),
        supports=(em.Support("left"),),
        viscosity=PRONY,
    )
    return replace(scene, **changes)


def path(loads, times, tissue=(MU, G, TAU)):
    """Theta at each time: the tissue, the load, the time."""
    rows = zip(loads, times, strict=True)
    return jnp.stack([jnp.append(jnp.asarray(tissue), jnp.array(row)) for row in rows])


@pytest.mark.parametrize(("order", "dilatation"), [(1, "pointwise"), (2, "mean")])
def test_a_block_is_the_specimen(order, dilatation):
    """Pulled and held: what contracts is what the specimen's free directions do."""
    solution = em.Simulator(pulled(order, dilatation=dilatation)).path(path(PULLS, TIMES))
    assert not solution.status.any()
    piece = em.specimen(
        {"time": TIMES, "stretch_x": 1.0 + 0.2 * PULLS}, viscosity=PRONY, parameters=OF_TISSUE,
        law=em.find_law("neo_hookean_split"), constants={"kappa": 100.0},
    )  # fmt: skip
    H = piece.gradients(em.homogeneous(piece)(jnp.array([MU, G, TAU])))
    far = np.argmax(pulled(order).mesh.nodes.sum(axis=1))
    stretches = np.diagonal(H, axis1=1, axis2=2)
    np.testing.assert_allclose(solution.displacement[:, far], stretches, atol=1e-9)
    held = solution.displacement[5:, far, 1]
    assert np.ptp(held) > 1e-3  # the volume's stress stays while the other relaxes


@pytest.mark.parametrize(("tau", "left"), [(1e12, 1.0), (1e-9, 1.0 - G)])
def test_an_infinite_and_a_vanishing_rate_are_two_elastic_bodies(tau, left):
    loads, times = np.array([1.0, 3.0]), np.array([1.0, 2.0])
    scene = clamped()
    solution = em.Simulator(scene).path(path(loads, times, (MU, G, tau)))
    mu, *_, pull, _ = scene.parameters
    elastic = replace(scene, viscosity=None, parameters=(mu, pull))
    for u, load in zip(solution.displacement, loads, strict=True):
        # The volumetric energy of the law does not relax.
        expected = em.Simulator(elastic)(jnp.array([left * MU, load]))
        np.testing.assert_allclose(u, expected, atol=1e-7)


def test_creep_is_of_second_order_in_the_step():
    simulator = em.Simulator(clamped())

    def at_end(count):
        times = np.linspace(0.0, 4.0, count + 1)[1:]
        return simulator.path(path(3.0 * times / 4.0, times)).displacement[-1]

    coarse, middle, fine = (at_end(count) for count in (4, 8, 16))
    ratio = np.linalg.norm(coarse - middle) / np.linalg.norm(middle - fine)
    assert ratio == pytest.approx(4.0, rel=0.1)
    assert np.linalg.norm(middle - fine) > 1e-6


def test_derivatives_through_time_are_those_of_differences():
    simulator, times = em.Simulator(clamped()), np.array([0.5, 1.0, 1.0, 2.0, 4.0])
    loads = np.array([1.0, 2.0, 3.0, 3.0, 0.0])  # with a jump, a hold and a return

    def tip(tissue):
        return simulator.path(path(loads, times, tissue)).displacement[:, -1]

    at = jnp.array([MU, G, TAU])
    found = jax.jit(jax.jacfwd(tip))(at)
    assert np.abs(found).min(axis=(0, 1)).max() > 0.0
    for k, step in enumerate((1e-4, 1e-5, 1e-4)):
        along = step * jnp.eye(3)[k]
        expected = (tip(at + along) - tip(at - along)) / (2.0 * step)
        np.testing.assert_allclose(found[..., k], expected, atol=1e-7 * np.abs(found).max())


def test_under_jit_and_alone_it_is_the_same():
    simulator = em.Simulator(clamped())
    run = lambda thetas: simulator.path(thetas).displacement
    thetas = path([2.0, 2.0], [1.0, 5.0])
    np.testing.assert_allclose(jax.jit(run)(thetas), run(thetas), atol=1e-12)


def test_a_rotation_of_the_body_changes_no_step():
    rng = np.random.default_rng(0)
    law = StepLaw.of(em.find_law("holzapfel_ogden"))
    Q = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    Q *= np.sign(np.linalg.det(Q))
    H, A = 0.2 * rng.normal(size=(3, 3)), rng.normal(size=(3, 3))
    fibre = np.eye(3)[: int(law.fibres)]
    rows = jnp.asarray(np.vstack([fibre, A + A.T, [[0.7, 0.0, 0.0]]]))
    turned = Q @ (np.eye(3) + H) - np.eye(3)
    parameters = [jnp.asarray(1.5) for _ in law.parameters]
    one, other = (law.energy(Strain(jnp.asarray(h), None, rows), *parameters) for h in (H, turned))
    assert one == pytest.approx(float(other), rel=1e-12)


def test_fibres_and_regions_relax_too():
    """A fibre law with stiffer regions: held, the body under its load creeps on, and converges."""
    ventricle = em.scenes.left_ventricle(rings=3, around=6, layers=1, order=1)
    regions = np.arange(len(ventricle.mesh.elements)) % 2
    scene = replace(
        ventricle,
        viscosity=PRONY,
        regions=regions,
        parameters=(*ventricle.parameters, *OF_TISSUE[1:], TIME),
        constants={**ventricle.constants, "stiffness_0": 1.0, "stiffness_1": 2.0},
    )
    values = {n: float(v) for n, v in zip(ventricle.parameter_names, ventricle.centre, strict=True)}
    values |= {"relaxation_1": 0.6, "tau_1": 1.0}
    thetas = jnp.stack([scene.theta(**values, time=time) for time in (0.1, 1.0, 20.0)])
    solution = em.Simulator(scene).path(thetas)
    assert not solution.status.any()
    moved = np.linalg.norm(solution.displacement, axis=(1, 2))
    assert moved[0] < moved[1] < moved[2]


def test_after_a_step_that_fails_all_have_its_status():
    simulator = em.Simulator(clamped(), NewtonOptions(max_iterations=1))
    solution = simulator.path(path([0.0, 5.0, 0.0], [0.0, 1.0, 2.0]))
    names = [Status(int(status)) for status in solution.status]
    assert names == [Status.CONVERGED, Status.ITERATION_LIMIT, Status.ITERATION_LIMIT]
    assert np.isfinite(solution.displacement).all()


@pytest.mark.parametrize(
    ("call", "line"),
    [
        (lambda s: s.solve(s.scene.centre), "goes through time: follow it by Simulator.path"),
        (lambda s: s.reactions(s.rest, s.scene.centre), "goes through time: follow it"),
        (lambda s: potential_energy(s.scene), "goes through time: follow it"),
        (
            lambda s: em.fem.element_fields(s.scene, s.rest, s.scene.centre),
            "goes through time: follow it",
        ),
        (lambda s: s.path(path([1.0], [1.0])[:, :3]), r"expected \(m, 5\)"),
        (lambda s: s.path(path([1.0, 1.0], [2.0, 1.0])), "time goes back"),
        (lambda s: s.path(path([1.0], [-1.0])), "give 0 or more"),
        (lambda s: s.path(path([1.0], [np.nan])), "give 0 or more"),
        (
            lambda s: replace(s.scene, parameters=s.scene.parameters[:-1]),
            "a body in time needs 'time'",
        ),
        (lambda s: replace(s.scene, viscosity={"terms": 9}), "9 terms"),
        (lambda s: replace(s.scene, viscosity={"kinds": "prony"}), "'kinds' is unknown"),
        (lambda s: replace(s.scene, viscosity={"terms": 2}), "needs 'relaxation_2'"),
        (lambda s: replace(s.scene, viscosity=None), "'relaxation_1' is not one of"),
    ],
)
def test_what_is_refused(call, line):
    with pytest.raises(InputError, match=line):
        call(em.Simulator(clamped()))


def test_a_mesh_known_under_load_and_small_strains_are_refused():
    with pytest.raises(InputError, match="is unloaded without time"):
        clamped(loaded_by={"pull": "imaged"}, constants={"kappa": 100.0, "imaged": 1.0})
    with pytest.raises(InputError, match="'time' is a constant, so nothing goes on"):
        clamped(constants={"kappa": 100.0, "time": 1.0})
    small = {"law": em.find_law("small_strain"), "constants": {"lam": 100.0}}
    with pytest.raises(InputError, match="small strains; what goes through time needs another"):
        clamped(**small)


def test_time_is_a_load_s_and_the_tissue_has_the_rest():
    scene = clamped()
    assert scene.load_parameters == ("pull", "time")
    assert scene.tissue_parameters[-2:] == ("relaxation_1", "tau_1")
