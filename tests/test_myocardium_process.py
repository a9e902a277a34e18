"""The study of sheep myocardium: a cube's formula, its features and its process."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from studies.sheep_myocardium import cube, process

import calibrate as cal
import emulator as em
from emulator.fem.energy import point_energy
from emulator.scenes.tissue import Tissue
from emulator.specimens.states import states

pytestmark = pytest.mark.slow


def position(**values):
    """Position (p,) in the box of these values, of others the lowest."""
    lowest = {p.name: p.low for p in cube.MATERIAL} | dict.fromkeys(
        ("in_plane", "out_of_plane"), 0.0
    )
    given = lowest | values
    unit = [p.to_unit(jnp.asarray(given[p.name])) for p in (*cube.MATERIAL, *cube.ANGLES)]
    return 2.0 * jnp.stack(unit) - 1.0


def test_formula_of_an_isotropic_cube():
    r"""Simple shear of W(I1): :math:`F = A\, a\, \gamma\, e^{b \gamma^2}`."""
    x = position(a=1.2, b=6.0, in_plane=7.0, out_of_plane=-3.0)
    H, C = (jnp.asarray(a)[None] for a in cube.homogeneous(np.array([[0.2], [0.2], [0.1]])))
    along_y, along_z, stretched = cube.formula(x[None], H, C, jnp.array([90.0]))[0]
    expected = 1e-3 * 90.0 * 1.2 * 0.2 * np.exp(6.0 * 0.04)
    assert float(along_y) == pytest.approx(expected, rel=2e-3)
    assert float(along_z) == pytest.approx(expected, rel=2e-3)
    # Stretched: sigma = a exp(b (I1 - 3)) (l^2 - 1/l), force A sigma / l.
    stretch, I1 = 1.1, 1.1**2 + 2.0 / 1.1
    sigma = 1.2 * np.exp(6.0 * (I1 - 3.0)) * (stretch**2 - 1.0 / stretch)
    assert float(stretched) == pytest.approx(1e-3 * 90.0 * sigma / stretch, rel=5e-3)


def test_the_formula_is_that_of_specimens():
    """Each of the five directions of fibres is a specimen's, in the same states."""
    amounts, number = np.array([[-0.3, 0.2], [0.1, 0.4], [-0.1, 0.12]]), 1
    x = position(a=1.2, b=6.0, a_f=2.0, b_f=5.0, a_s=1.0, b_s=4.0, a_fs=0.5, b_fs=3.0)
    x = x.at[8:].set(jnp.array([0.3, -0.2]))
    angles = np.zeros((5, len(x)))
    angles[:, 8:] = cube.SPREAD / 45.0 * cube._NODES
    fibres, sheets = np.moveaxis([cube.turned_to(number, x + each) for each in angles], 1, 0)
    stretch = np.concatenate([np.ones(4), 1.0 + amounts[2]])
    shears = np.zeros((2, 6))
    shears[0, :2], shears[1, 2:4] = amounts[:2]
    given = dict(zip(("shear_yx", "shear_zx"), shears, strict=True))
    given |= {"stretch_x": stretch, "stretch_y": stretch**-0.5}
    scene = em.specimen(
        states({name: np.tile(each, 5) for name, each in given.items()}, ordered=False),
        law=em.find_law("holzapfel_ogden_orthotropic"),
        parameters=cube.MATERIAL,
        constants={"kappa": cube.KAPPA},
        fibres=np.repeat(fibres, 6, axis=0),
        sheets=np.repeat(sheets, 6, axis=0),
    )
    forward = em.homogeneous(scene, incompressible=True)
    observe = cal.stresses(scene, "stress_yx,stress_zx,cauchy_x,cauchy_y,cauchy_z")
    theta = cube.theta_of(x)[:8]
    stress = np.asarray(observe(forward(theta), theta)).reshape(5, 6, 5)
    pulled = stress[:, 4:, 2] - 0.5 * (stress[:, 4:, 3] + stress[:, 4:, 4])
    along = [stress[:, :2, 0], stress[:, 2:4, 1], pulled / stretch[4:]]
    H, C = (jnp.asarray(np.stack([each] * 3)) for each in cube.homogeneous(amounts))
    found = cube.formula(jnp.tile(x, (3, 1)), H, C, jnp.full(3, 90.0))[number]
    expected = 0.09 * cube._WEIGHTS @ np.concatenate(along, axis=1)
    np.testing.assert_allclose(found, expected, rtol=1e-12)


def test_the_formulas_fibres_miss_their_angles():
    """By Gauss-Hermite's rule with many nodes, where the force is smooth; and it is continuous."""
    amounts = np.full((3, 1), 0.3)
    H, C = (jnp.asarray(a)[None] for a in cube.homogeneous(amounts))
    x = position(a=1.0, b=5.0, a_f=2.0, b_f=3.0).at[8:].set(jnp.array([0.6, 0.3]))
    found = cube.formula(x[None], H, C, jnp.array([90.0]))[0]
    stress = jax.grad(point_energy(cube._law_of(), cube.theta_of(x)))

    def alone(x):
        P = jax.vmap(stress, (0, None))(H.reshape(-1, 3, 3), Tissue(cube.turned_to(0, x)))
        return 0.09 * jnp.einsum("kij,kij->k", C.reshape(-1, 3, 3), P)

    nodes, weights = np.polynomial.hermite_e.hermegauss(9)
    at = np.stack(np.meshgrid(nodes, nodes), axis=-1).reshape(-1, 2) * cube.SPREAD / 45.0
    weight = np.outer(weights, weights).ravel() / weights.sum() ** 2
    every = jax.vmap(lambda more: alone(x.at[8:].add(more)))(jnp.asarray(at))
    np.testing.assert_allclose(found, weight @ every, rtol=2e-4)
    assert float(np.abs(alone(x) / found - 1.0).max()) > 2e-3


def test_angles_turn_fibres_towards_sheet_and_normal():
    for number in range(3):
        scene = cube.scene(number, np.array([9.0, 10.0, 8.0]), cells=1)
        f, s, across, along = cube._frame(number)
        n = np.eye(3)[np.argsort(cube._CUT[number])][2]
        np.testing.assert_allclose(np.cross(across, f), s)
        np.testing.assert_allclose(np.cross(along, f), n)
        middle = scene.centre
        for name, towards in (("in_plane", s), ("out_of_plane", n)):
            k = scene.parameter_names.index(name)
            turned = np.asarray(scene.tissue_at(middle.at[k].set(30.0)).directions)[0, 0, 0]
            np.testing.assert_allclose(turned, np.sqrt(0.75) * f + 0.5 * towards, atol=1e-12)


H = jnp.asarray(
    cube.homogeneous(np.array([[-0.3, 0.1, 0.35], [-0.4, 0.1, 0.3], [-0.1, 0.05, 0.12]]))[0]
)


def test_features_are_shares_of_terms_at_rest_and_where_curves_end():
    x = position(a=0.8, b=7.0, a_f=1.6, b_f=10.0, a_fs=0.4, b_fs=3.0)
    found = process.features(0, x, H)
    assert found.shape == (process.FEATURES,)
    np.testing.assert_allclose(found[2:5], np.log1p([1.6 / 0.8, 0.001 / 0.8, 0.4 / 0.8]))
    ends = np.asarray(found[5:23]).reshape(6, 3)
    # Sheared by -0.3 from the fibres' plane towards the sheet: I4f = 1.09, I1 = 3.09, I8 = -0.3.
    shares = [
        1.6 / 0.8 * 0.09**2 / 0.09 * np.exp(10.0 * 0.09**2 - 7.0 * 0.09),
        0.0,
        0.4 / 0.8 * 0.09 / 0.09 * np.exp(3.0 * 0.09 - 7.0 * 0.09),
    ]
    np.testing.assert_allclose(ends[0], np.log1p(shares), rtol=1e-10, atol=1e-12)
    # Fibres that are pushed together carry nothing.
    np.testing.assert_allclose(ends[4][0], 0.0, atol=1e-12)
    # Turned by 30 degrees they are pulled at one end of a shear more than at the other.
    turned = x.at[8].set(30.0 / 45.0)
    one, other = np.asarray(process.features(0, turned, H)[5:23]).reshape(6, 3)[:2, 0]
    assert other > 2.0 * one


def test_a_term_that_is_off_has_no_exponent():
    x = [position(a=1.0, b=5.0, b_f=b_f) for b_f in (0.5, 20.0)]
    phi = [process.features(0, each, H) for each in x]
    assert float(jnp.abs(phi[1] - phi[0]).max()) < 5e-3


def test_the_processs_correlations_are_the_kernels_derivatives():
    x, y = 0.5 * jax.random.normal(jax.random.key(0), (2, 10))
    lengths = np.linspace(0.5, 2.0, process.FEATURES)

    def kernel(x, y):
        step = (process.features(1, x, H) - process.features(1, y, H)) / lengths
        return jnp.exp(-0.5 * step @ step)

    one, other = (process.values_and_slopes(1, np.asarray(at)[None], H)[0] for at in (x, y))
    found = process.correlations(one, other, lengths)
    np.testing.assert_allclose(found[0, 0], kernel(x, y), rtol=1e-12)
    np.testing.assert_allclose(found[0, 1:], jax.grad(kernel, 1)(x, y), atol=1e-12)
    np.testing.assert_allclose(found[1:, 0], jax.grad(kernel, 0)(x, y), atol=1e-12)
    cross = jax.jacfwd(jax.grad(kernel, 0), 1)(x, y)
    np.testing.assert_allclose(found[1:, 1:], cross, atol=1e-12)


def made_up(x):
    """A q of one point, smooth in features: (n, 1) and its slopes (n, 1, p)."""

    def q(x):
        phi = process.features(0, x, H)
        return jnp.array([0.3 * jnp.sin(phi[2]) + 0.1 * phi[-2] ** 2])

    x = jnp.asarray(x)
    return np.asarray(jax.vmap(q)(x)), np.asarray(jax.vmap(jax.jacfwd(q))(x))


@pytest.fixture(scope="module")
def told():
    x = np.random.default_rng(0).uniform(-0.6, 0.6, (12, 10))
    return process.known(0, x, *made_up(x), H)


def test_the_slopes_of_likelihood_are_its_differences(told):
    logs, step = np.log(np.linspace(0.8, 3.0, process.FEATURES)), 1e-5
    rising = process._unlikely(logs, told)[1]
    for k, row in enumerate(step * np.eye(len(logs))):
        ahead, behind = (process._unlikely(at, told)[0] for at in (logs + row, logs - row))
        assert rising[k] == pytest.approx((ahead - behind) / (2.0 * step), rel=1e-5, abs=1e-6)


def test_a_process_goes_through_its_runs_and_says_what_it_leaves(told):
    lengths = process.likeliest(told)
    made = process.conditioned(told, lengths, process.room(told.runs))
    assert len(made.at) == process.ROOM
    assert process.room(process.ROOM + 1) == 2 * process.ROOM
    value = told.told.value == 1.0
    there = jax.vmap(process.correction, (None, 0))(made, told.told.at[value])
    np.testing.assert_allclose(there, told.y[value] + told.mean, atol=1e-3)
    # Features that q does not read have longer lengths than those it does.
    assert lengths[2] < lengths[[3, 4, 9]].min()
    x = np.random.default_rng(1).uniform(-0.6, 0.6, (60, 10))
    share, B = process.shares(told, lengths, process.values(0, x, H))
    said = np.sqrt(B[0, 0] * share)
    made_there = jax.vmap(process.correction, (None, 0))(made, process.values(0, x, H).at)
    wrong = np.asarray(made_there)[:, 0] - made_up(x)[0][:, 0]
    assert np.abs(wrong).max() < 0.03
    assert 0.3 < np.sqrt(np.mean((wrong / (said + 1e-5)) ** 2)) < 3.0
    # What is left of values is the same beside their slopes.
    points, _ = process.values_and_slopes(0, x, H)
    remains = np.diagonal(process.left(told, lengths, points))[points.value == 1.0]
    np.testing.assert_allclose(share, np.maximum(remains, 0.0), atol=1e-12)


def test_next_runs_take_the_most_variance_away():
    """Against conditioning on each run by hand."""
    half = np.random.default_rng(2).normal(size=(12, 12))
    C = half @ half.T
    values = np.arange(0, 12, 3)
    left = []
    for i in range(4):
        rows = np.arange(3 * i, 3 * i + 3)
        after = C - C[:, rows] @ np.linalg.inv(C[np.ix_(rows, rows)]) @ C[rows]
        left.append(np.trace(after[np.ix_(values, values)]))
    first, second = process.next_runs(C, 4, 2)
    assert first == int(np.argmin(left))
    assert second != first
