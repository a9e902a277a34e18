"""Specimens with viscosity against closed forms and an integration by NumPy that shares no code."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq

import calibrate as cal
import emulator as em
from emulator.core.errors import InputError
from emulator.specimens import homogeneous as module
from emulator.specimens.homogeneous import homogeneous_stresses
from emulator.specimens.specimen import specimen

MU, G, TAU = 3.0, 0.6, 2.0  # a standard solid; G = 1 would be Maxwell's fluid
PARAMETERS = (
    em.Parameter("mu", "kPa", 0.5, 20.0),
    em.Parameter("relaxation_1", "", 0.01, 0.9999),
    em.Parameter("tau_1", "s", 0.1, 100.0),
)
THETA = jnp.array([MU, G, TAU])


def solid(columns, tests=None, kappa=1e4, **words):
    """A neo-Hookean standard solid in the motion and at the times of ``columns``."""
    times = np.asarray(columns["time"], float)
    columns = {n: np.asarray(x, float) for n, x in columns.items() if n != "time"}
    return specimen(
        em.specimens.states(columns, tests, ordered=False),
        times=times,
        viscosity={"kind": "prony"},
        law=em.find_law("neo_hookean_split"),
        parameters=PARAMETERS,
        constants={"kappa": kappa},
        **words,
    )


def stress_in(scene, incompressible=True):
    """The program of a specimen's gradients and stresses at theta."""
    forward = em.homogeneous(scene, incompressible=incompressible)
    return jax.jit(lambda theta: homogeneous_stresses(scene, forward.evaluate(theta)[0], theta))


def pulled_and_sheared(time, stretch, shear):
    """Two tests, x and xy, along x and in simple shear; what is free follows from the volume."""
    one = np.ones(len(time))
    return solid(
        {
            "time": np.tile(time, 2),
            "stretch_x": np.append(stretch, one),
            "stretch_y": np.append(stretch**-0.5, one),
            "shear_xy": np.append(0.0 * one, shear),
        },
        ["x"] * len(time) + ["xy"] * len(time),
    )


def test_relaxation_after_an_instant_step_uniaxial_and_in_shear():
    t = np.concatenate([[0.0, 0.0], np.geomspace(0.01, 50.0, 40)])
    held = np.append(0.0, np.ones(41))
    stress = stress_in(pulled_and_sheared(t, 1.0 + 0.3 * held, 0.4 * held))
    for fraction in (0.6, 1.0):  # a standard solid, and Maxwell's fluid
        _, P = stress(jnp.array([MU, fraction, TAU]))
        G_of_t = held * (1.0 - fraction + fraction * np.exp(-t / TAU))
        np.testing.assert_allclose(P[:42, 0, 0], MU * (1.3 - 1.3**-2) * G_of_t, atol=1e-12)
        np.testing.assert_allclose(P[42:, 0, 1], MU * 0.4 * G_of_t, atol=1e-12)


def test_creep_begins_at_the_instant_and_ends_at_the_relaxed_stretch():
    t = np.concatenate([[0.0, 0.0], np.geomspace(0.05, 2000.0, 60)])
    scene = solid({"time": t, "applied_x": 2.0 * (np.arange(62) > 0)})
    H, P = stress_in(scene)(THETA)
    stretch = 1.0 + np.asarray(H)[:, 0, 0]
    for row, modulus in ((1, MU), (-1, (1.0 - G) * MU)):
        exact = brentq(lambda x, m=modulus: m * (x - x**-2) - 2.0, 1.0, 5.0, xtol=1e-14)
        assert stretch[row] == pytest.approx(exact, abs=1e-8)
    np.testing.assert_allclose(P[1:, 0, 0], 2.0, atol=1e-9)
    assert (np.diff(stretch) > -1e-9).all()


def _creep_by_numpy(pull, end, steps):
    """The stretch under a pull, by Runge and Kutta of z = g S - Q, dz/dt = Q/tau; S total is S - z.

    The stretch follows from P/l = (S - z)_1 - (S - z)_2 / l^3, the free directions' stress being 0.
    """

    def S(x):
        first = x**2 + 2.0 / x
        return MU * np.array([1.0 - first / (3.0 * x**2), 1.0 - first * x / 3.0])

    def stretch(z):
        def excess(x):
            s = S(x) - z
            return x * (s[0] - s[1] / x**3) - pull

        return brentq(excess, 0.9, 6.0, xtol=1e-15, rtol=1e-14)

    def rate(z):
        return (G * S(stretch(z)) - z) / TAU

    z, dt, curve = np.zeros(2), end / steps, []
    for _ in range(steps):
        a = rate(z)
        b = rate(z + 0.5 * dt * a)
        c = rate(z + 0.5 * dt * b)
        d = rate(z + dt * c)
        z = z + dt / 6.0 * (a + 2.0 * b + 2.0 * c + d)
        curve.append(stretch(z))
    return np.array(curve)


def test_creep_is_of_second_order_to_an_independent_integration():
    exact, ends = _creep_by_numpy(2.0, 4.0, 200)[[49, 99, 199]], []
    for count in (100, 200):
        t = np.append(0.0, np.linspace(0.0, 4.0, count + 1))
        scene = solid({"time": t, "applied_x": 2.0 * (np.arange(count + 2) > 0)})
        H = stress_in(scene)(THETA)[0]
        rows = 1 + np.array([count // 4, count // 2, count])
        ends.append(1.0 + np.asarray(H)[rows, 0, 0])
    errors = [np.abs(stretch - exact).max() for stretch in ends]
    assert errors[0] / errors[1] == pytest.approx(4.0, abs=0.05)
    np.testing.assert_allclose((4.0 * ends[1] - ends[0]) / 3.0, exact, atol=1e-8)


def test_cyclic_loss_of_small_strains_is_that_of_linear_viscoelasticity():
    """Loss a cycle is pi e^2 E'', E'' = E g w tau / (1 + w^2 tau^2), of Maxwell's fluid, too."""
    frequency, cycles, size, fractions = 2.0, 12, 1e-5, (0.6, 1.0)
    losses = []
    for count in (100, 200):
        phase = 2.0 * np.pi * np.arange(cycles * count + 1) / count
        strain, last = size * np.sin(phase), slice(-count - 1, None)
        stress = stress_in(pulled_and_sheared(phase / frequency, 1.0 + strain, strain))
        for fraction in fractions:
            P = np.asarray(stress(jnp.array([MU, fraction, TAU]))[1])
            both = P[: len(phase), 0, 0], P[len(phase) :, 0, 1]
            losses += [np.trapezoid(p[last], strain[last]) / size**2 for p in both]
    # A sine between whose points stress goes straight; extrapolated, it is of fourth order.
    loss = (4.0 * np.array(losses[4:]) - losses[:4]) / 3.0
    w_tau = frequency * TAU
    unit = np.pi * w_tau / (1.0 + w_tau**2) * np.repeat(fractions, 2)
    np.testing.assert_allclose(loss, unit * MU * np.tile([3.0, 1.0], 2), rtol=3e-7)


def test_cycles_at_finite_strain_against_an_independent_integration():
    """Of an exponential, by the trapezoidal rule of z = g S - Q in tiny steps."""
    a, b, end = 2.0, 3.0, 6.0
    of_time = lambda t: 1.0 + 0.15 * (1.0 - np.cos(2.0 * t))

    def S(x):
        first = x**2 + 2.0 / x
        factor = a * np.exp(b * (first - 3.0))
        return factor * np.array([1.0 - first / (3.0 * x**2), 1.0 - first * x / 3.0])

    fine = np.linspace(0.0, end, 60_001)
    S_fine, z, dt = S(of_time(fine)), np.zeros(2), fine[1]
    at, exact = np.arange(0, 60_001, 6_000), []
    for k in range(60_001):
        if k:
            gain = G * (S_fine[:, k - 1] + S_fine[:, k])
            z = ((1.0 - 0.5 * dt / TAU) * z + 0.5 * dt / TAU * gain) / (1.0 + 0.5 * dt / TAU)
        if k in at:
            x, s = of_time(fine[k]), S_fine[:, k] - z
            exact.append(x * (s[0] - s[1] / x**3))
    curves = []
    for count in (300, 600):
        t = np.linspace(0.0, end, count + 1)
        scene = specimen(
            {"time": t, "stretch_x": of_time(t), "stretch_y": of_time(t) ** -0.5},
            viscosity={"kind": "prony", "terms": 1},
            law=em.find_law("holzapfel_ogden_isotropic"),
            parameters=(em.Parameter("a", "kPa", 1.0, 5.0), *PARAMETERS[1:]),
            constants={"b": b, "kappa": 1e4},
        )
        P = stress_in(scene)(jnp.array([a, G, TAU]))[1]
        curves.append(np.asarray(P)[:: count // 10, 0, 0])
    np.testing.assert_allclose((4.0 * curves[1] - curves[0]) / 3.0, exact, atol=2e-8)
    assert np.ptp(exact) > 1.0


TIME = np.concatenate([np.linspace(0.0, 2.0, 60), np.linspace(2.02, 20.0, 140)])
RAMP = np.minimum(TIME, 2.0) / 2.0


@pytest.fixture(scope="module")
def tissue():
    """Fibres at 30 degrees from x; stretched and held, pulled and released, 200 times each."""
    tests = {
        "held": {"stretch_x": 1.0 + 0.2 * RAMP},
        "released": {"applied_x": 4.0 * np.where(TIME < 8.0, RAMP, 0.0)},
    }
    of = together_in_time(tests)
    return specimen(
        of,
        times=np.tile(TIME, 2),
        viscosity={"kind": "prony", "terms": 2},
        law=em.find_law("holzapfel_ogden"),
        parameters=(
            em.Parameter("a", "kPa", 0.2, 9.0),
            em.Parameter("a_f", "kPa", 0.2, 20.0),
            em.Parameter("relaxation_1", "", 0.01, 0.99),
            em.Parameter("tau_1", "s", 0.01, 5.0),
        ),
        constants={"b": 3.0, "b_f": 6.0, "kappa": 1e6, "relaxation_2": 0.4, "tau_2": 8.0},
        fibres=[np.cos(np.pi / 6.0), 0.5, 0.0],
    )


def together_in_time(tests):
    names = dict.fromkeys(name for columns in tests.values() for name in columns)
    empty = np.full(len(TIME), np.nan)
    columns = {n: np.concatenate([c.get(n, empty) for c in tests.values()]) for n in names}
    labels = [test for test in tests for _ in TIME]
    return em.specimens.states(columns, labels, timed=True)


POINT = jnp.array([2.0, 5.0, 0.5, 0.7])


def test_derivatives_through_200_steps_are_those_of_differences(tissue):
    forward, observe = em.homogeneous(tissue, incompressible=True), cal.stresses(tissue, "stress_x")
    both = lambda theta: jnp.stack(
        [observe(u := forward(theta), theta)[:, 0], tissue.gradients(u)[:, 0, 0]]
    )
    value, h = jax.jit(both), 1e-4
    slopes = np.asarray(jax.jit(jax.jacfwd(both))(POINT))
    for k in range(4):
        step = h * jnp.eye(4)[k]
        # Of fourth order.
        near = value(POINT + step) - value(POINT - step)
        far = value(POINT + 2.0 * step) - value(POINT - 2.0 * step)
        difference = (8.0 * near - far) / (12.0 * h)
        np.testing.assert_allclose(slopes[..., k], difference, atol=1e-7)
    assert (np.abs(slopes).max(axis=(0, 1)) > 1e-2).all()
    by_reverse = jax.jit(jax.grad(lambda theta: jnp.sum(both(theta) ** 2)))(POINT)
    expected = 2.0 * np.einsum("ct,ctp->p", value(POINT), slopes)
    np.testing.assert_allclose(by_reverse, expected, rtol=1e-9)


def test_incompressible_is_the_limit_of_a_large_bulk_modulus(tissue):
    H, P = stress_in(tissue)(POINT)
    near, of_stiff = stress_in(tissue, incompressible=False)(POINT)
    np.testing.assert_allclose(near, H, atol=2e-5)
    np.testing.assert_allclose(of_stiff[:, 0, 0], P[:, 0, 0], atol=2e-4 * np.abs(P).max())
    np.testing.assert_allclose(of_stiff[200:, 0, 0], tissue.states.pulls[200:, 0], atol=1e-8)
    u = jnp.swapaxes(near, 1, 2).reshape(-1, 3)
    assert em.homogeneous(tissue).is_stable(u, POINT)


def test_a_tube_has_a_history_at_each_point_of_its_wall():
    t = np.append(0.0, np.linspace(0.0, 40.0, 9))
    radius = np.append(1.0, np.full(9, 1.2))
    tube = em.specimen(
        {"time": t, "inner_radius": radius, "stretch_axial": np.ones(10)},
        tube=em.specimens.Tube(1.0, (0.3,)),
        viscosity={},
        law=em.find_law("neo_hookean_split"),
        parameters=PARAMETERS,
        constants={"kappa": 1e4},
    )
    u = em.homogeneous(tube, incompressible=True)(THETA)
    pressure = np.asarray(cal.TubePressure(tube)(u, THETA)).ravel()
    fraction = 1.0 - G + G * np.exp(-t[1:] / TAU)
    np.testing.assert_allclose(pressure[1:], pressure[1] * fraction, atol=1e-10)
    assert pressure[1] > 0.1


def test_an_elastic_specimen_computes_nothing_of_viscosity(monkeypatch):
    stretch = np.linspace(1.0, 1.2, 4)
    columns = {"stretch_x": stretch, "stretch_y": stretch**-0.5}  # no iteration, no loop of its own
    words = {"law": em.find_law("neo_hookean_split"), "parameters": PARAMETERS[:1]}
    plain = em.specimen(columns, constants={"kappa": 9.0}, **words)
    timed = em.specimen({"time": np.arange(4.0), **columns}, constants={"kappa": 9.0}, **words)
    assert timed.fingerprint == plain.fingerprint
    viscous = solid({"time": np.arange(4.0), **columns})

    def program(scene, theta):
        forward = em.homogeneous(scene, incompressible=True)
        both = lambda theta: homogeneous_stresses(scene, forward._evaluate(theta)[0], theta)
        return str(jax.make_jaxpr(both)(theta))

    assert "scan" in program(viscous, THETA)
    for name in ("step_after", "potential", "isochoric_stress"):
        monkeypatch.setattr(module, name, None)  # an error where it is called
    assert program(timed, THETA[:1]) == program(plain, THETA[:1])
    assert "scan" not in program(plain, THETA[:1])


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ({"time": [0.0, 2.0, 1.0]}, "row 3: time goes back from 2 to 1 s"),
        ({"time": [0.0, np.nan, 1.0]}, "row 2: time is nan s; give 0 or more"),
        ({"time": [-1.0, 0.0, 1.0]}, "row 1: time is -1 s; give 0 or more"),
        ({"time": [0.0, 1.0]}, "2 times of 3 states"),
        ({}, "viscosity needs the time of each state; give 'time', in s"),
        ({"parameters": PARAMETERS[:2]}, "the scene's Viscosity needs 'tau_1'"),
        ({"constants": {"kappa": 1.0, "tau_1": 0.0}}, "'tau_1' is 0 s; it must be above 0"),
        (
            {"constants": {"kappa": 1.0, "tau_1": 1.0, "relaxation_1": 1.2}},
            "'relaxation_1' is 1.2; it must be below 1",
        ),
        ({"viscosity": {"term": 2}}, "viscosity: entry 'term' is unknown"),
        ({"viscosity": {"kind": "maxwell"}}, "kind 'maxwell'; use prony or spectrum"),
        ({"law": em.find_law("small_strain")}, "law 'small_strain' is of small strains"),
        ({"grips": em.specimens.Grips((1.0, 1.0, 1.0))}, "leave out viscosity or grips"),
    ],
)
def test_what_viscosity_cannot_have_is_refused(words, message):
    columns = {"stretch_x": [1.0, 1.1, 1.0]}
    if "constants" in words or "parameters" in words or "viscosity" in words or "law" in words:
        columns["time"] = [0.0, 1.0, 2.0]
    if "grips" in words:
        columns["time"] = [0.0, 1.0, 2.0]
    if "time" in words:
        columns["time"] = words["time"]
    known = words.get("constants", {"kappa": 1.0})
    law = words.get("law", em.find_law("neo_hookean_split"))
    entries = {
        "viscosity": {"kind": "prony"},
        "law": law,
        "parameters": tuple(p for p in PARAMETERS if p.name not in known),
        "constants": known if law.name == "neo_hookean_split" else {"lam": 1.0},
        **{n: x for n, x in words.items() if n not in ("time", "constants")},
    }
    with pytest.raises(InputError) as caught:
        em.specimen({n: np.array(x) for n, x in columns.items()}, **entries)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_test_is_stretched_along_the_same_axes_to_its_end():
    columns = {"stretch_x": np.ones(2), "stretch_y": np.array([1.0, np.nan])}
    with pytest.raises(InputError, match="row 2 has no stretch along y, others have"):
        em.specimens.states(columns, timed=True)
