"""States of specimens against FEM of tetrahedra, closed forms and differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import emulator as em
from emulator.core.errors import InputError, SolverError
from emulator.fem.energy import point_energy, volume_ratio
from emulator.scenes.scene import all_nodes
from emulator.specimens.homogeneous import Homogeneous, homogeneous_stresses
from emulator.specimens.specimen import specimen
from emulator.verify.homogeneous import tetrahedra
from specimen_support import together

PULL = np.linspace(1.0, 1.2, 4)
FORCE = np.linspace(0.0, 20.0, 4)
TESTS = {
    "uniaxial": {"stretch_x": PULL},
    "biaxial": {"stretch_x": PULL, "stretch_y": 0.5 + 0.5 * PULL},
    "xz": {"shear_xz": PULL - 0.99},
    "yx": {"shear_yx": PULL - 0.99},
    "pulled": {"applied_x": FORCE},
    "pulled twice": {"applied_x": FORCE, "applied_y": 0.5 * FORCE},
    "strip": {"applied_x": FORCE, "stretch_y": np.ones(4)},
    "pulled xz": {"applied_z": 0.2 * FORCE, "shear_xz": PULL - 0.99},
}
THETA = jnp.array([1.0, 6.0])


@pytest.fixture(scope="module")
def tissue():
    """Fibres at 30 degrees from x in the plane of x and y, under stretch and load control."""
    return specimen(
        together(TESTS),
        law=em.find_law("holzapfel_ogden"),
        parameters=(em.Parameter("a", "kPa", 0.2, 2.0), em.Parameter("b_f", "", 1.0, 10.0)),
        constants={"b": 3.0, "a_f": 5.0, "kappa": 40.0},
        fibres=[np.cos(np.pi / 6.0), 0.5, 0.0],
    )


@pytest.fixture(scope="module")
def compressible(tissue):
    return Homogeneous(tissue, all_nodes(tissue))


@pytest.fixture(scope="module")
def incompressible(tissue):
    return Homogeneous(tissue, all_nodes(tissue), incompressible=True)


def test_fem_has_the_same_states_derivatives_and_stability(tissue, compressible):
    simulator = em.Simulator(tetrahedra(tissue))
    by_fem = simulator.solve(THETA).require_converged("specimen").displacement
    solution = compressible.solve(THETA)
    assert bool(solution.converged)
    corners = np.flatnonzero(np.arange(len(by_fem)) % 4)  # not the origins
    np.testing.assert_allclose(solution.displacement, by_fem[corners], atol=1e-9)
    slopes = compressible.sensitivities(solution.displacement, THETA)
    of_fem = simulator.sensitivities(by_fem, THETA)[:, corners]
    np.testing.assert_allclose(slopes, of_fem, atol=1e-8)
    assert compressible.is_stable(solution.displacement, THETA)
    assert simulator.is_stable(by_fem, THETA)
    J = volume_ratio(simulator.scene, by_fem)[:, 0]
    np.testing.assert_allclose(volume_ratio(tissue, solution.displacement), J, atol=1e-9)


@pytest.mark.parametrize(("strain", "stable"), [(0.1, True), (-0.7, False)])
def test_a_state_is_stable_where_its_energy_is_convex(strain, stable):
    """All three stretches are free: the Hessian in them is the energy's own, by differentiation."""
    free = specimen(
        {f"applied_{axis}": np.array([1.0]) for axis in "xyz"},
        law=em.find_law("small_strain" if stable else "ogden_1"),
        parameters=(em.Parameter(*(("mu", "kPa") if stable else ("mu_1", "kPa")), 0.1, 10.0),),
        constants={"lam": 1.0} if stable else {"alpha_1": 0.5, "kappa": 1e-3},
    )
    theta = jnp.array([1.0])
    energy = lambda d: point_energy(free, theta)(jnp.diag(d))
    d = jnp.array([strain, -0.5 * strain, 0.3])
    convex = bool((np.linalg.eigvalsh(jax.hessian(energy)(d)) > 0.0).all())
    assert em.homogeneous(free).is_stable(jnp.diag(d), theta) is convex is stable


@pytest.mark.parametrize("of", ["compressible", "incompressible"])
def test_derivatives_are_those_of_differences(of, request):
    """Forward ones, and those of the sum of squares by transposition."""
    forward, step = request.getfixturevalue(of), 1e-4

    @jax.jit
    def linearised(theta):
        u, slope = jax.linearize(forward, theta)
        (by_reverse,) = jax.linear_transpose(slope, theta)(2.0 * u)
        return u, jax.vmap(slope)(jnp.eye(2)), by_reverse

    _, slopes, by_reverse = linearised(THETA)
    for k in range(2):
        along = step * THETA[k] * jnp.eye(2)[k]
        up, down = linearised(THETA + along)[0], linearised(THETA - along)[0]
        difference = (up - down) / (2.0 * along[k])
        np.testing.assert_allclose(slopes[k], difference, atol=1e-7)
        square = (jnp.sum(up**2) - jnp.sum(down**2)) / (2.0 * along[k])
        assert float(by_reverse[k]) == pytest.approx(float(square), abs=1e-7)
    assert np.abs(slopes).max() > 1e-3


def test_an_incompressible_specimen_keeps_its_volume(tissue, incompressible):
    u = np.asarray(incompressible(THETA))
    F = np.eye(3) + np.swapaxes(u.reshape(-1, 3, 3), 1, 2)
    np.testing.assert_allclose(np.linalg.det(F), 1.0, atol=1e-14)
    # The limit of a law whose volume hardly changes.
    stiff = specimen(
        tissue.states, law=tissue.law, parameters=tissue.parameters, fibres=tissue.fibres,
        constants={**tissue.constants, "kappa": 1e6},
    )  # fmt: skip
    np.testing.assert_allclose(Homogeneous(stiff, incompressible.nodes)(THETA), u, atol=1e-4)


def test_many_theta_and_some_nodes(tissue, compressible, monkeypatch):
    thetas = jnp.stack([THETA, 1.5 * THETA, 0.3 * THETA])
    batch = jax.jit(jax.vmap(compressible.evaluate))(thetas)
    assert batch.valid.all()
    for theta, u in zip(thetas, batch.displacement, strict=True):
        np.testing.assert_allclose(compressible(theta), u, atol=1e-12)
    nodes = np.array([46, 3, 17])
    traced, evaluate = [], Homogeneous._evaluate
    counted = lambda self, theta: traced.append(theta) or evaluate(self, theta)
    monkeypatch.setattr(Homogeneous, "_evaluate", counted)
    few = compressible.at(nodes)
    for theta, u in zip(thetas, batch.displacement, strict=True):
        np.testing.assert_allclose(few(theta), u[nodes], atol=1e-12)
    assert len(traced) == 1  # by hand, too, it is compiled once


@pytest.mark.parametrize("incompressible", [False, True])
def test_stresses_are_the_pulls_and_stretches_give_them_back(incompressible):
    """A test under load control, and the same states prescribed by their stretches."""
    law, parameters = em.find_law("holzapfel_ogden"), (em.Parameter("a", "kPa", 0.2, 2.0),)
    words = {"constants": {"b": 3.0, "a_f": 5.0, "b_f": 6.0, "kappa": 40.0}, "fibres": [1, 0, 0]}
    pulled = specimen({"applied_x": FORCE, "applied_y": 0.5 * FORCE}, law=law,
                      parameters=parameters, **words)  # fmt: skip
    theta = THETA[:1]
    u = em.homogeneous(pulled, incompressible=incompressible)(theta)
    H, P = homogeneous_stresses(pulled, u, theta)
    expected = FORCE[:, None] * np.array([1.0, 0.5, 0.0])
    np.testing.assert_allclose(np.diagonal(P, axis1=1, axis2=2), expected, atol=1e-10)
    stretches = {f"strain_{a}": np.array(H[:, k, k]) for k, a in enumerate("xy")}
    moved = specimen(stretches, ordered=False, law=law, parameters=parameters, **words)
    again = em.homogeneous(moved, incompressible=incompressible)(theta)
    _, P = homogeneous_stresses(moved, again, theta)
    np.testing.assert_allclose(np.diagonal(P, axis1=1, axis2=2), expected, atol=1e-10)


def test_large_pulls_of_an_exponential():
    """In closed form to a stretch of 1.3 at b = 30, and at the corners of a box around it."""
    stretch, a, b = np.linspace(1.0, 1.3, 7), 1.0, 30.0
    pull = a * np.exp(b * (stretch**2 + 2.0 / stretch - 3.0)) * (stretch - stretch**-2.0)
    scene = specimen(
        together({"x": {"applied_x": pull}, "z": {"applied_z": pull}}),
        law=em.find_law("holzapfel_ogden_isotropic"),
        parameters=(em.Parameter("a", "kPa", 1e-3, 100.0), em.Parameter("b", "", 0.1, 80.0)),
        constants={"kappa": 1000.0},
    )
    corners = ([x, y] for x in (1e-3, 100.0) for y in (0.1, 80.0))
    thetas = jnp.array([[a, b], *corners, [jnp.nan, 1.0]])
    for incompressible in (True, False):
        forward = em.homogeneous(scene, incompressible=incompressible).evaluate
        found = jax.jit(jax.vmap(forward))(thetas)
        assert found.valid[:-1].all()
        assert not found.valid[-1]
        assert np.isfinite(found.displacement[:-1]).all()
        if incompressible:
            u = found.displacement[0].reshape(2, 7, 3, 3)
            np.testing.assert_allclose(1.0 + u[0, :, 0, 0], stretch, atol=1e-12)
            np.testing.assert_allclose(1.0 + u[1, :, 2, 2], stretch, atol=1e-12)


def test_hard_states_are_found_or_refused(compressible):
    """Exponents by which W overflows on the way, and a box corner of a hundred times the data."""
    pull = np.array([1.1, 1.6])
    scene = specimen(
        {"stretch_x": pull},
        law=em.find_law("holzapfel_ogden"),
        parameters=(em.Parameter("a", "kPa", 1e-4, 100.0), em.Parameter("b", "", 0.1, 80.0)),
        constants={"a_f": 50.0, "b_f": 60.0, "kappa": 100.0},
        fibres=[0.0, 1.0, 0.0],
    )
    corners = [[a, b] for a in (1e-4, 100.0) for b in (0.1, 20.0, 80.0)]
    outside = [[jnp.nan, 1.0], [1.0, jnp.inf], [1.0, 1e4]]
    forward = jax.jit(jax.vmap(Homogeneous(scene, all_nodes(scene)).evaluate))
    found = forward(jnp.array(corners + outside))
    assert np.isfinite(found.displacement).all()
    assert found.valid[:6].all()
    assert not found.valid[6:8].any()
    with pytest.raises(SolverError, match="scene 'specimen': a state has no equilibrium"):
        compressible(jnp.array([jnp.nan, 1.0]))


def test_scenes_that_are_no_specimen_are_refused(tissue):
    cube = em.find_scene("twisting_cube")
    with pytest.raises(InputError, match="is no specimen"):
        Homogeneous(cube, all_nodes(cube))
    closed = specimen(
        {"stretch_x": np.array([1.1]), "stretch_y": np.array([1.0]), "stretch_z": np.array([1.0])},
        law=tissue.law, parameters=tissue.parameters, constants=tissue.constants,
        fibres=tissue.fibres[0],
    )  # fmt: skip
    with pytest.raises(InputError, match="state 1 of 'specimen' has no free direction"):
        Homogeneous(closed, all_nodes(closed), incompressible=True)
