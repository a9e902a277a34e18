from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq

from emulator.core.errors import InputError
from emulator.mechanics.kinematics import Barriers, Strain
from emulator.mechanics.laws import LAWS, find_law
from emulator.mechanics.laws.holzapfel_ogden import textbook_from_released
from emulator.mechanics.laws.law import logarithmic, quadratic, quadratic_logarithmic
from emulator.mechanics.laws.neo_hookean import lame_from_engineering
from law_support import ARGUMENTS, FIBRE, LAM, MU, SHEET
from scene_support import rotation, slope


def energy(name, H):
    law = find_law(name)
    directions = np.stack([FIBRE, SHEET]) if law.sheets else FIBRE
    strain = Strain(jnp.asarray(H), None, jnp.asarray(directions))
    return law.energy(strain, *map(jnp.asarray, ARGUMENTS[name]))


def isochoric(F):
    C = np.linalg.det(F) ** (-2 / 3) * F.T @ F
    return np.trace(C), FIBRE @ C @ FIBRE


def deformation(stretched):
    """A deformation whose fibres are longer, or shorter, than at rest."""
    F = np.eye(3) + 0.1 * np.random.default_rng(0).normal(size=(3, 3))
    return F + (0.25 if stretched else -0.25) * np.outer(FIBRE, FIBRE)


@pytest.mark.parametrize("stretched", [True, False])
def test_holzapfel_ogden_equals_its_formula(stretched):
    F = deformation(stretched)
    (I1, I4), J = isochoric(F), np.linalg.det(F)
    assert (I4 > 1) == stretched
    volume = 25.0 * (J**2 - 1 - 2 * np.log(J))
    switch = max(I4 - 1, 0.0)
    a, b, af, bf, _ = ARGUMENTS["holzapfel_ogden"]
    expected = a / (2 * b) * (np.exp(b * (I1 - 3)) - 1) + af / (2 * bf) * (
        np.exp(bf * switch**2) - 1
    )
    assert energy("holzapfel_ogden", F - np.eye(3)) == pytest.approx(expected + volume, rel=1e-12)
    a, b, af, bf, _ = ARGUMENTS["holzapfel_ogden_released"]
    expected = a / b * (np.exp(b * (I1 - 3)) - 1) + af / bf * (np.exp(bf * (I4 - 1) ** 2) - 1)
    released = energy("holzapfel_ogden_released", F - np.eye(3))
    assert released == pytest.approx(expected + volume, rel=1e-12)


@pytest.mark.parametrize("dispersion", [0.05, 0.3])
def test_dispersed_fibres_are_the_mean_over_their_directions(dispersion):
    F = deformation(True)
    I1, _ = isochoric(F)
    C = np.linalg.det(F) ** (-2 / 3) * F.T @ F
    # The structure tensor of the generalised theory: d I + (1 - 3 d) f f^T.
    structure = dispersion * np.eye(3) + (1 - 3 * dispersion) * np.outer(FIBRE, FIBRE)
    mean = max(np.sum(structure * C) - 1.0, 0.0)
    J = np.linalg.det(F)
    a, b, af, bf, _, kappa = ARGUMENTS["holzapfel_ogden_dispersed"]
    expected = a / (2 * b) * np.expm1(b * (I1 - 3)) + af / (2 * bf) * np.expm1(bf * mean**2)
    expected += kappa * (J**2 - 1 - 2 * np.log(J))
    law, strain = find_law("holzapfel_ogden_dispersed"), Strain(F - np.eye(3), None, FIBRE)
    assert law.energy(strain, a, b, af, bf, dispersion, kappa) == pytest.approx(expected, rel=1e-12)


def test_laws_without_an_effect_are_those_with_it_where_it_is_absent():
    pulled, pressed = (deformation(s) - np.eye(3) for s in (True, False))
    plain, unswitched = "holzapfel_ogden", "holzapfel_ogden_unswitched"
    assert energy(unswitched, pulled) == pytest.approx(float(energy(plain, pulled)), rel=1e-14)
    assert energy(unswitched, pressed) > energy(plain, pressed)
    # Fibres that are shortened do nothing.
    strain = Strain(jnp.asarray(pressed))
    isotropic = find_law("holzapfel_ogden_isotropic").energy(strain, 0.3, 2.0, 25.0)
    assert isotropic == pytest.approx(float(energy(plain, pressed)), rel=1e-14)
    dispersed, strain = find_law("holzapfel_ogden_dispersed"), Strain(pulled, None, FIBRE)
    parallel = dispersed.energy(strain, 0.3, 2.0, 3.0, 2.5, 0.0, 25.0)
    assert parallel == pytest.approx(float(energy(plain, pulled)), rel=1e-14)
    parallel = find_law("holzapfel_ogden_dispersed_unswitched").energy(
        Strain(pressed, None, FIBRE), 0.3, 2.0, 3.0, 2.5, 0.0, 25.0
    )
    assert parallel == pytest.approx(float(energy(unswitched, pressed)), rel=1e-14)
    for law in LAWS.values():
        for _, simpler in law.simpler:
            assert set(simpler.parameters) <= set(law.parameters)
            assert LAWS[simpler.name] is simpler


def test_small_strain_is_neo_hookean_near_rest_and_knows_no_rotation():
    H = np.random.default_rng(0).normal(size=(3, 3))
    for small, law in (("small_strain", "neo_hookean"), ("small_strain_E_nu", "neo_hookean_E_nu")):
        wrong = [abs(energy(small, h * H) / energy(law, h * H) - 1.0) for h in (1e-2, 1e-3, 1e-4)]
        assert slope(np.array([1e-2, 1e-3, 1e-4]), np.array(wrong)) == pytest.approx(1.0, abs=0.05)
        assert energy(small, rotation() - np.eye(3)) > 0.1


@pytest.mark.parametrize("stretched", [True, False])
def test_orthotropic_holzapfel_ogden_equals_its_formula(stretched):
    F = deformation(True) + (0.2 if stretched else -0.3) * np.outer(SHEET, SHEET)
    J = np.linalg.det(F)
    C = J ** (-2 / 3) * F.T @ F
    I1, I4f, I4s, I8 = np.trace(C), FIBRE @ C @ FIBRE, SHEET @ C @ SHEET, FIBRE @ C @ SHEET
    assert (I4s > 1) == stretched
    assert abs(I8) > 0.01
    a, b, a_f, b_f, a_s, b_s, a_fs, b_fs, kappa = ARGUMENTS["holzapfel_ogden_orthotropic"]
    expected = (
        a / (2 * b) * (np.exp(b * (I1 - 3)) - 1)
        + a_f / (2 * b_f) * (np.exp(b_f * max(I4f - 1, 0) ** 2) - 1)
        + a_s / (2 * b_s) * (np.exp(b_s * max(I4s - 1, 0) ** 2) - 1)
        + a_fs / (2 * b_fs) * (np.exp(b_fs * I8**2) - 1)
        + kappa * (J**2 - 1 - 2 * np.log(J))
    )
    found = energy("holzapfel_ogden_orthotropic", F - np.eye(3))
    assert found == pytest.approx(expected, rel=1e-12)


def test_barriers_limit_the_shear_of_fibre_and_sheet_either_way():
    directions = jnp.asarray(np.stack([FIBRE, SHEET]))
    shear = lambda H, limits: Strain(jnp.asarray(H), limits, directions).isochoric_I8fs
    simple = np.outer(FIBRE, SHEET)
    for amount in (-40.0, -0.5, 0.0, 0.5, 40.0):
        exact, limited = (shear(amount * simple, limits) for limits in (None, Barriers()))
        assert exact == pytest.approx(amount, abs=1e-9)
        assert limited == pytest.approx(np.clip(amount, -8.0, 8.0), abs=1e-9)
    slope_at_rest = jax.grad(lambda H: shear(H, Barriers()))(jnp.zeros((3, 3)))
    np.testing.assert_allclose(slope_at_rest, simple + simple.T, atol=1e-12)


def test_the_two_holzapfel_ogden_forms_agree_in_tension():
    assert textbook_from_released(0.15, 1.5) == (0.3, 3.0)
    pulled, pressed = (deformation(s) - np.eye(3) for s in (True, False))
    textbook, released = "holzapfel_ogden", "holzapfel_ogden_released"
    assert energy(textbook, pulled) == pytest.approx(float(energy(released, pulled)), rel=1e-12)
    assert energy(textbook, pressed) < energy(released, pressed)  # no switch in the released one


def test_guccione_equals_its_formula_in_fibre_axes():
    F = deformation(True)
    axes = np.linalg.qr(np.column_stack([FIBRE, np.eye(3)[:, :2]]))[0]
    axes[:, 0] *= np.sign(axes[:, 0] @ FIBRE)
    E = axes.T @ (0.5 * (F.T @ F - np.eye(3))) @ axes
    C, bf, bt, bfs, kappa = ARGUMENTS["guccione"]
    Q = (
        bf * E[0, 0] ** 2
        + bt * (E[1, 1] ** 2 + E[2, 2] ** 2 + E[1, 2] ** 2 + E[2, 1] ** 2)
        + bfs * (E[0, 1] ** 2 + E[1, 0] ** 2 + E[0, 2] ** 2 + E[2, 0] ** 2)
    )
    expected = C / 2 * (np.exp(Q) - 1) + kappa / 2 * (np.linalg.det(F) - 1) ** 2
    assert energy("guccione", F - np.eye(3)) == pytest.approx(expected, rel=1e-12)


def in_numpy(name, F):
    """The energies of test pieces' laws without their volumetric part, in other terms than ours."""
    *values, _ = ARGUMENTS[name]
    J = np.linalg.det(F)
    bar = J ** (-2 / 3) * F.T @ F
    I1, I2 = np.trace(bar), np.trace(np.linalg.inv(bar))  # of determinant 1
    E = (F.T @ F - np.eye(3)) / 2
    across = np.cross(FIBRE, SHEET)
    E = np.stack([FIBRE, SHEET, across]) @ E @ np.stack([FIBRE, SHEET, across]).T
    if name == "mooney_rivlin":
        return values[0] * (I1 - 3) + values[1] * (I2 - 3)
    if name == "yeoh":
        return sum(c * (I1 - 3) ** k for k, c in enumerate(values, 1))
    if name.startswith("ogden"):
        stretches = np.sqrt(np.linalg.eigvalsh(bar))
        pairs = zip(values[::2], values[1::2], strict=True)
        return sum(2 * mu / alpha**2 * (np.sum(stretches**alpha) - 3) for mu, alpha in pairs)
    if name == "may_newman":
        c_0, c_1, c_2, mu = values
        stretch = np.sqrt(FIBRE @ bar @ FIBRE)
        Q = c_1 * (I1 - 3) ** 2 + c_2 * (stretch - 1) ** 4
        return c_0 * (np.exp(Q) - 1) + mu / 2 * (I1 - 3)
    if name == "invariant_terms":
        x = [I1 - 3, 0.5 * (np.trace(bar) ** 2 - np.trace(bar @ bar)) - 3]
        f, s = (max(a @ bar @ a - 1, 0) for a in (FIBRE, SHEET))
        g = FIBRE @ bar @ SHEET
        terms = [
            x[0] / 2, x[0] ** 2 / 2, (np.exp(10 * x[0]) - 1) / 20, x[1] / 2, x[1] ** 2 / 2,
            f**2 / 2, f**3 / 3, (np.exp(20 * f**2) - 1) / 40, s**2 / 2,
            (np.exp(20 * s**2) - 1) / 40, g**2 / 2, (np.exp(20 * g**2) - 1) / 40,
        ]  # fmt: skip
        return np.dot(values, terms)
    if name.startswith("fung"):
        C, *b, mu = values
        if name == "fung_planar":
            b = [b[0], b[1], 0, b[2], 0, 0, b[3], 0, 0]
        B = np.diag(b[:3]) + np.array([[0, b[3], b[5]], [b[3], 0, b[4]], [b[5], b[4], 0]])
        normal, shear = np.diag(E), np.array([E[0, 1], E[1, 2], E[2, 0]])
        Q = normal @ B @ normal + 4 * np.array(b[6:]) @ shear**2
        return C / 2 * (np.exp(Q) - 1) + mu / 2 * (I1 - 3)
    c, k_1, k_2, angle, *d = values
    d, beta = (d or [0.0])[0], np.radians(angle)
    W = c / 2 * (I1 - 3)
    for sign in (1, -1):
        family = np.cos(beta) * FIBRE + sign * np.sin(beta) * SHEET
        structure = d * np.eye(3) + (1 - 3 * d) * np.outer(family, family)
        mean = max(np.sum(structure * bar) - 1, 0)
        W += k_1 / (2 * k_2) * (np.exp(k_2 * mean**2) - 1)
    return W


@pytest.mark.parametrize("stretched", [True, False])
@pytest.mark.parametrize(
    "name",
    ["mooney_rivlin", "yeoh", "ogden_1", "ogden_3", "fung_planar", "fung_orthotropic"]
    + ["holzapfel_gasser_ogden", "gasser_ogden_holzapfel", "may_newman"]
    + ["invariant_terms"],
)
def test_laws_of_test_pieces_equal_their_formulas(name, stretched):
    F = deformation(stretched)
    J, kappa = np.linalg.det(F), ARGUMENTS[name][-1]
    expected = in_numpy(name, F) + kappa / 4 * (J**2 - 1 - 2 * np.log(J))
    assert energy(name, F - np.eye(3)) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("exponent", [-30.0, -2.0, 0.5, 9.0, 30.0])
def test_powers_of_stretches_from_a_thousandth_of_a_percent_to_five(exponent):
    law = find_law("ogden_1")
    W = jax.jit(lambda H: law.energy(Strain(H), 1.0, exponent, 0.0))
    for size in (1e-5, 1e-2, 0.5, np.log(5.0)):
        for logs in ([1.0, -0.5, -0.5], [0.5, 0.5, -1.0], [1.0, 0.0, -1.0]):
            logs = size * np.array(logs)
            expected = 2.0 / exponent**2 * np.sum(np.expm1(exponent * logs) - exponent * logs)
            stretches = jnp.asarray(np.diag(np.expm1(logs)))
            # Below, rounding of the stretches themselves, whose product is not quite 1.
            assert W(stretches) == pytest.approx(expected, rel=1e-11, abs=1e-15)


def test_equal_stretches_have_all_derivatives():
    """A cube in shear, and one stretched evenly in two directions: the second derivative's slope."""
    W = jax.jit(jax.grad(lambda H: energy("ogden_1", H)))
    rng, step = np.random.default_rng(1), 1e-4
    for H in (np.zeros((3, 3)), np.diag([0.3, 0.3, -0.2]), np.diag([0.3, 0.3, 0.3])):
        D = rng.normal(size=(3, 3))
        second = jax.jvp(W, (jnp.asarray(H),), (jnp.asarray(D),))[1]
        around = (W(jnp.asarray(H + step * D)) - W(jnp.asarray(H - step * D))) / (2.0 * step)
        np.testing.assert_allclose(second, around, rtol=1e-5, atol=1e-5)


def test_volumetric_energies_and_their_stiffness():
    kappa, J = 3.0, 1.2
    strain = Strain((J ** (1 / 3) - 1) * jnp.eye(3))
    expected = {
        quadratic: kappa / 2 * (J - 1) ** 2,
        quadratic_logarithmic: kappa * (J**2 - 1 - 2 * np.log(J)),
        logarithmic: kappa / 2 * np.log(J) ** 2,
    }
    for law, value in expected.items():
        assert law(strain, kappa) == pytest.approx(value, rel=1e-12)


def test_neo_hookean_equals_its_formula_in_F():
    F = np.eye(3) + 0.2 * np.random.default_rng(0).normal(size=(3, 3))
    J = np.linalg.det(F)
    expected = 0.5 * MU * (np.trace(F.T @ F) - 3.0) - MU * np.log(J) + 0.5 * LAM * np.log(J) ** 2
    assert energy("neo_hookean", F - np.eye(3)) == pytest.approx(expected, rel=1e-13)


def test_engineering_constants():
    # E = mu (3 lam + 2 mu) / (lam + mu), nu = lam / 2 (lam + mu)
    mu, lam = lame_from_engineering(jnp.array(8.0), jnp.array(0.3))
    assert mu * (3 * lam + 2 * mu) / (lam + mu) == pytest.approx(8.0)
    assert lam / (2 * (lam + mu)) == pytest.approx(0.3)


@pytest.mark.parametrize("name", sorted(LAWS))
def test_rest_is_free_of_energy_and_stress(name):
    rest = jnp.zeros((3, 3))
    assert energy(name, rest) == 0.0
    np.testing.assert_allclose(jax.grad(lambda H: energy(name, H))(rest), 0.0, atol=1e-14)


@pytest.mark.parametrize("name", sorted(name for name in LAWS if LAWS[name].shape_moduli))
def test_shape_moduli_scale_all_but_the_resistance_to_volume_change(name):
    law = find_law(name)
    assert set(law.shape_moduli) <= {q.name for q in law.quantities if q.unit == "kPa"}

    def scaled(factor, F):
        values = dict(zip(law.parameters, ARGUMENTS[name], strict=True))
        values |= {modulus: factor * values[modulus] for modulus in law.shape_moduli}
        directions = jnp.asarray(np.stack([FIBRE, SHEET]) if law.sheets else FIBRE)
        strain = Strain(jnp.asarray(F - np.eye(3)), None, directions)
        return float(law.energy(strain, *map(jnp.asarray, values.values())))

    F = deformation(True)
    volume, whole = scaled(0.0, F), scaled(1.0, F)
    even = np.cbrt(np.linalg.det(F)) * np.eye(3)  # as much volume change, and no other
    assert volume == pytest.approx(scaled(0.0, even), rel=1e-12)
    assert whole - volume > 0.1 * whole
    assert scaled(3.0, F) - volume == pytest.approx(3.0 * (whole - volume), rel=1e-12)


@pytest.mark.parametrize("name", sorted(name for name in LAWS if LAWS[name].objective))
def test_frame_indifference(name):
    F = np.eye(3) + 0.2 * np.random.default_rng(3).normal(size=(3, 3))
    turned = rotation() @ F  # the fibre is a direction of the reference body and stays
    assert energy(name, turned - np.eye(3)) == pytest.approx(
        float(energy(name, F - np.eye(3))), rel=1e-12
    )


# A law of small strains is quadratic: no remainder to see a slope in.
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.slow if name in ("ogden_2", "ogden_3") else ())
        for name in sorted(LAWS)
        if LAWS[name].objective
    ],
)
def test_stress_and_tangent_are_the_derivatives_taylor(name):
    rng = np.random.default_rng(5)
    H, D = 0.1 * rng.normal(size=(3, 3)), rng.normal(size=(3, 3))
    W = lambda h: energy(name, h)
    stress, tangent = jax.grad(W)(jnp.asarray(H)), jax.hessian(W)(jnp.asarray(H))
    steps = 0.02 / 2.0 ** np.arange(5)
    first = [abs(W(H + h * D) - W(H) - h * np.sum(stress * D)) for h in steps]
    second = [
        np.linalg.norm(
            jax.grad(W)(jnp.asarray(H + h * D)) - stress - h * np.einsum("ijkl,kl", tangent, D)
        )
        for h in steps
    ]
    assert slope(steps, np.array(first)) == pytest.approx(2.0, abs=0.1)
    assert slope(steps, np.array(second)) == pytest.approx(2.0, abs=0.1)


@pytest.mark.parametrize("stretch", [0.7, 0.9, 1.2, 1.8])
def test_uniaxial_tension_against_the_scalar_solution(stretch):
    # P_22 = 0 gives mu (t^2 - 1) + lam ln(stretch t^2) = 0 for the lateral stretch t, and then
    # P_11 = mu (stretch - 1 / stretch) + lam ln(stretch t^2) / stretch.
    lateral = brentq(lambda t: MU * (t**2 - 1) + LAM * np.log(stretch * t**2), 0.2, 3.0, xtol=1e-14)
    expected = MU * (stretch - 1 / stretch) + LAM * np.log(stretch * lateral**2) / stretch
    H = jnp.diag(jnp.array([stretch, lateral, lateral]) - 1.0)
    stress = jax.grad(lambda h: energy("neo_hookean", h))(H)
    assert stress[0, 0] == pytest.approx(expected, rel=1e-11)
    np.testing.assert_allclose([stress[1, 1], stress[2, 2], stress[0, 1]], 0.0, atol=1e-11)


def test_an_inverted_point_has_no_energy():
    assert np.isnan(energy("neo_hookean", jnp.diag(jnp.array([-1.5, 0.0, 0.0]))))


def test_unknown_law_names_the_known_ones():
    with pytest.raises(InputError, match="law 'hooke' is unknown; known: fung_planar, "):
        find_law("hooke")


def test_the_page_of_laws_names_every_law():
    page = (Path(__file__).parents[3] / "docs/laws.md").read_text()
    assert [name for name in LAWS if f"`{name}`" not in page] == []
