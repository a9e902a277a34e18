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
from emulator.specimens.states import states
from emulator.verify.homogeneous import tetrahedra

NAN = np.nan
PULL = np.linspace(1.0, 1.2, 4)
GIVEN = states(
    {
        "stretch_x": np.concatenate([PULL, PULL, np.full(8, NAN)]),
        "stretch_y": np.concatenate([np.full(4, NAN), 0.5 + 0.5 * PULL, np.full(8, NAN)]),
        "shear_xz": np.concatenate([np.zeros(8), PULL - 0.99, np.zeros(4)]),
        "shear_yx": np.concatenate([np.zeros(12), PULL - 0.99]),
    },
    ["uniaxial"] * 4 + ["biaxial"] * 4 + ["xz"] * 4 + ["yx"] * 4,
)
THETA = jnp.array([1.0, 6.0])
FORCE = np.linspace(0.0, 20.0, 4)
PULLED = states(
    {
        "applied_x": np.concatenate([FORCE, FORCE, FORCE, np.full(4, NAN)]),
        "applied_y": np.concatenate([np.full(4, NAN), 0.5 * FORCE, np.full(8, NAN)]),
        "applied_z": np.concatenate([np.full(12, NAN), 0.2 * FORCE]),
        "stretch_y": np.concatenate([np.full(8, NAN), np.ones(4), np.full(4, NAN)]),
        "shear_xz": np.concatenate([np.zeros(12), PULL - 0.99]),
    },
    ["uniaxial"] * 4 + ["biaxial"] * 4 + ["strip"] * 4 + ["xz"] * 4,
)


@pytest.fixture(scope="module", params=[GIVEN, PULLED], ids=["moved", "pulled"])
def tissue(request):
    """Fibres at 30 degrees from x in the plane of x and y, under stretch or load control."""
    return specimen(
        request.param,
        law=em.find_law("holzapfel_ogden"),
        parameters=(em.Parameter("a", "kPa", 0.2, 2.0), em.Parameter("b_f", "", 1.0, 10.0)),
        constants={"b": 3.0, "a_f": 5.0, "kappa": 40.0},
        fibres=[np.cos(np.pi / 6.0), 0.5, 0.0],
    )


@pytest.fixture(scope="module")
def compressible(tissue):
    return Homogeneous(tissue, all_nodes(tissue))


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


def test_derivatives_are_those_of_differences(tissue):
    # Pulled and incompressible, moved and compressible: the others are combinations of these.
    pulled = bool(tissue.states.pulls.any())
    forward, step = Homogeneous(tissue, all_nodes(tissue), incompressible=pulled), 1e-4
    slopes = jax.jit(jax.jacfwd(forward))(THETA)
    by_reverse = jax.jit(jax.grad(lambda theta: jnp.sum(forward(theta) ** 2)))
    jitted = jax.jit(forward)
    for k in range(2):
        along = step * THETA[k] * jnp.eye(2)[k]
        up, down = jitted(THETA + along), jitted(THETA - along)
        difference = (up - down) / (2.0 * along[k])
        np.testing.assert_allclose(slopes[..., k], difference, atol=1e-7)
        square = (jnp.sum(up**2) - jnp.sum(down**2)) / (2.0 * along[k])
        assert float(by_reverse(THETA)[k]) == pytest.approx(float(square), abs=1e-7)
    assert np.abs(slopes).max() > 1e-3


def test_an_incompressible_specimen_keeps_its_volume(tissue):
    forward = Homogeneous(tissue, all_nodes(tissue), incompressible=True)
    u = np.asarray(forward(THETA))
    F = np.eye(3) + np.swapaxes(u.reshape(-1, 3, 3), 1, 2)
    np.testing.assert_allclose(np.linalg.det(F), 1.0, atol=1e-14)
    # The limit of a law whose volume hardly changes.
    stiff = specimen(
        tissue.states, law=tissue.law, parameters=tissue.parameters, fibres=tissue.fibres,
        constants={**tissue.constants, "kappa": 1e6},
    )  # fmt: skip
    np.testing.assert_allclose(Homogeneous(stiff, forward.nodes)(THETA), u, atol=1e-4)


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


@pytest.mark.parametrize("axis", [0, 2])
def test_large_pulls_of_an_exponential(axis):
    """In closed form to a stretch of 1.3 at b = 30, and at the corners of a box around it."""
    stretch, a, b = np.linspace(1.0, 1.3, 7), 1.0, 30.0
    pull = a * np.exp(b * (stretch**2 + 2.0 / stretch - 3.0)) * (stretch - stretch**-2.0)
    scene = specimen(
        {f"applied_{'xyz'[axis]}": pull},
        law=em.find_law("holzapfel_ogden_isotropic"),
        parameters=(em.Parameter("a", "kPa", 1e-3, 100.0), em.Parameter("b", "", 0.1, 80.0)),
        constants={"kappa": 1000.0},
    )
    thetas = jnp.array([[a, b], *([x, y] for x in (1e-3, 100.0) for y in (0.1, 80.0))])
    for incompressible in (True, False):
        forward = em.homogeneous(scene, incompressible=incompressible).evaluate
        found = jax.jit(jax.vmap(forward))(thetas)
        assert found.valid.all()
        assert np.isfinite(found.displacement).all()
        if incompressible:
            along = 1.0 + found.displacement[0, axis::3, axis]
            np.testing.assert_allclose(along, stretch, atol=1e-12)
    assert not bool(jax.jit(forward)(jnp.array([jnp.nan, 1.0])).valid)


def test_hard_states_are_found_or_refused():
    """Exponents by which W overflows on the way, and a box corner of a hundred times the data."""
    pull = np.array([1.1, 1.6])
    scene = specimen(
        {"stretch_x": pull},
        law=em.find_law("holzapfel_ogden"),
        parameters=(em.Parameter("a", "kPa", 1e-4, 100.0), em.Parameter("b", "", 0.1, 80.0)),
        constants={"a_f": 50.0, "b_f": 60.0, "kappa": 100.0},
        fibres=[0.0, 1.0, 0.0],
    )
    forward = jax.jit(jax.vmap(Homogeneous(scene, all_nodes(scene)).evaluate))
    corners = jnp.array([[a, b] for a in (1e-4, 100.0) for b in (0.1, 20.0, 80.0)])
    found = forward(corners)
    assert np.isfinite(found.displacement).all()
    assert found.valid.all()
    outside = forward(jnp.array([[jnp.nan, 1.0], [1.0, jnp.inf], [1.0, 1e4]]))
    assert np.isfinite(outside.displacement).all()
    assert not outside.valid[:2].any()
    with pytest.raises(SolverError, match="scene 'specimen': a state has no equilibrium"):
        em.homogeneous(scene)(jnp.array([jnp.nan, 1.0]))


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
