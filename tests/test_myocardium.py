"""The study of sheep myocardium: its files, its formula and its emulator, without its long runs."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from studies.sheep_myocardium import campaign, cube, curves, experiment, inference

from emulator.errors import InputError

SIZES = np.array([9.0, 10.0, 8.0])


def write_heart(folder):
    """A heart of made-up numbers: forces that rise with the cube of their amounts."""
    folder.mkdir()
    (folder / "WDH_Params.csv").write_text(",".join(["9.0", "10.0", "8.0"] * 3) + "\n")
    for k, mode in enumerate(experiment.MODES, start=1):
        amount = np.linspace(-0.3, 0.3, 100) if mode[0] != mode[1] else np.linspace(-0.1, 0.1, 100)
        force = amount + 5.0 * amount**3
        table = [amount, force, amount**2] if mode[0] != mode[1] else [amount, force]
        header = "Strain, Fx, Fz" if mode[0] != mode[1] else "Strain, Fz"
        np.savetxt(
            folder / f"ForceStrain_M{k}.csv", np.transpose(table), delimiter=",", header=header,
            comments="",
        )  # fmt: skip
    return folder


def test_a_heart_is_read(tmp_path):
    write_heart(tmp_path / "TSL9")
    (heart,) = experiment.hearts(tmp_path)
    assert heart.name == "TSL9"
    assert heart.sizes.shape == (3, 3)
    curve = heart.curves["SN"]
    assert len(curve.amount) == 2 * experiment.LEVELS
    assert (curve.amount[0], curve.amount[-1]) == (-0.3, 0.3)
    assert curve.normal is not None
    assert [c.mode for c in heart.of_cube(2)] == ["NF", "NS", "NN"]


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda f: (f / "ForceStrain_M4.csv").unlink(), "ForceStrain_M4.csv is missing"),
        (lambda f: (f / "ForceStrain_M4.csv").write_text("Strain\n1,2\n"), "has 2 columns"),
        (
            lambda f: (f / "ForceStrain_M3.csv").write_text("Strain\na,b\n"),
            "not a table of numbers",
        ),
        (lambda f: (f / "WDH_Params.csv").write_text("9,9,9\n"), "has 3 columns"),
        (
            lambda f: (f / "ForceStrain_M3.csv").write_text("Strain, F\n-10,1\n-1,1\n10,2\n"),
            "expected fractions, not percent",
        ),
        (
            lambda f: (f / "ForceStrain_M3.csv").write_text("Strain, F\n0.1,1\n0.0,2\n"),
            "do not rise",
        ),
    ],
)
def test_bad_files_get_one_line(tmp_path, spoil, message):
    folder = write_heart(tmp_path / "TSL9")
    spoil(folder)
    with pytest.raises(InputError, match=message) as told:
        experiment.hearts(tmp_path)
    assert "\n" not in str(told.value)


def test_no_hearts(tmp_path):
    with pytest.raises(InputError, match="no folders TSL1"):
        experiment.hearts(tmp_path)


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


def test_angles_turn_fibres_towards_sheet_and_normal():
    for number in range(3):
        scene = cube.scene(number, SIZES, cells=1)
        f, s, across, along = cube._frame(number)
        n = np.eye(3)[np.argsort(cube._CUT[number])][2]
        np.testing.assert_allclose(np.cross(across, f), s)
        np.testing.assert_allclose(np.cross(along, f), n)
        middle = scene.centre
        for name, towards in (("in_plane", s), ("out_of_plane", n)):
            k = scene.parameter_names.index(name)
            turned = np.asarray(scene.tissue_at(middle.at[k].set(30.0)).directions)[0, 0, 0]
            np.testing.assert_allclose(turned, np.sqrt(0.75) * f + 0.5 * towards, atol=1e-12)


def test_the_process_covariances_are_the_kernels_derivatives():
    x, y = jax.random.normal(jax.random.key(0), (2, 4))
    k = curves._kernel
    np.testing.assert_allclose(curves._to_run(x, y)[1:], jax.grad(k, argnums=1)(x, y), atol=1e-14)
    between = curves._between_runs(x, y)
    np.testing.assert_allclose(between[0, 1:], jax.grad(k, argnums=1)(x, y), atol=1e-14)
    np.testing.assert_allclose(between[1:, 0], jax.grad(k, argnums=0)(x, y), atol=1e-14)
    cross = jax.jacfwd(jax.grad(k, argnums=0), argnums=1)(x, y)
    np.testing.assert_allclose(between[1:, 1:], cross, atol=1e-14)


def test_the_emulator_goes_through_its_runs(tmp_path):
    """Forces made of the formula and a smooth factor, in place of FEM's."""
    (heart,) = experiment.hearts(write_heart(tmp_path / "TSL9").parent)
    bodies = curves.cubes(heart, cells=1)
    H, C = (jnp.asarray(a)[None] for a in cube.homogeneous(bodies[0].amounts))
    area = jnp.array([bodies[0].area])

    def made(x):
        formula = cube.formula(x[None], H, C, area)[0]
        return formula * jnp.exp(0.3 * jnp.sin(x[0]) + 0.2 * x[1] * x[3])

    x = jax.random.uniform(jax.random.key(1), (6, 10), minval=-0.5, maxval=0.5)
    # At angles zero the cut is the frame, so that only the first cube is like this formula.
    force, slopes = jax.jit(jax.vmap(made))(x), jax.jit(jax.vmap(jax.jacfwd(made)))(x)
    runs = curves.Runs(*(np.asarray(a) for a in (x, force, slopes, force)))
    emulated = curves.fit(bodies[:1], [runs])
    again = jax.jit(jax.vmap(lambda x: curves.forces(emulated, x[None])[0]))(x)
    np.testing.assert_allclose(again, force, rtol=1e-4)


def test_a_meshs_error_is_taken_off_by_its_order():
    """Forces that are too large by 0.2 h^1.6, on 3 and on 5 cells."""
    right = np.full((2, 4), 2.0)
    by = {n: right * (1.0 + 0.2 * n**-1.6) for n in (3, 5)}
    empty = np.zeros((2, 10))
    tests, fine = ([curves.Runs(empty, by[n], empty, empty)] for n in (3, 5))
    arrays = {name: jnp.zeros(1) for name in curves.Emulated._fields}
    found = campaign.without_mesh(curves.Emulated(**arrays), tests, fine)
    np.testing.assert_allclose(by[3][0] * found.finer[0], right[0], rtol=1e-3)


def test_a_law_leaves_out_moduli_and_their_exponents():
    assert inference.parameters("fibres") == ("a", "b", "a_f", "b_f")
    assert len(inference.parameters(inference.ORTHOTROPIC)) == 8


def test_half_of_what_a_mode_is_off_is_the_same_along_its_curve():
    amounts = jnp.linspace(-0.3, 0.3, 10)
    covariance = np.asarray(inference.covariances(amounts, jnp.ones(10), jnp.asarray(0.2)))
    assert covariance[0, 0] == pytest.approx(0.04 + inference.POINT**2 + inference.CELL**2)
    assert 0.02 < covariance[0, -1] < 0.025
