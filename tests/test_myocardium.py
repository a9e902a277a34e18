"""The study of sheep myocardium: its files, its words, and its emulator through its runs."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from studies.common.output import run
from studies.sheep_myocardium import cube, curves, experiment
from studies.sheep_myocardium.__main__ import main

from emulator.core.errors import InputError

pytestmark = pytest.mark.slow


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


def in_unit(path, unit):
    """A curve's forces in another unit."""
    table = np.loadtxt(path, delimiter=",", skiprows=1)
    table[:, 1:] *= unit
    np.savetxt(path, table, delimiter=",", header="Strain, F", comments="")


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
        (
            lambda f: (f / "WDH_Params.csv").write_text(",".join(["0.9"] * 9) + "\n"),
            "edge lengths in mm .* 3 to 40",
        ),
        (
            lambda f: in_unit(f / "ForceStrain_M3.csv", 1e3),
            "M3.csv: forces reach 105, .* expected N",
        ),
        (
            lambda f: [in_unit(f / f"ForceStrain_M{k}.csv", 1e-3) for k in range(1, 10)],
            "forces reach 0.000435, .* expected N",
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


def test_the_studys_words_end_in_one_line(tmp_path, monkeypatch):
    folder = write_heart(tmp_path / "TSL9")
    (folder / "ForceStrain_M4.csv").unlink()
    words = ["sheep_myocardium/__main__.py", "--data", str(tmp_path), "--out", str(tmp_path)]
    monkeypatch.setattr("sys.argv", words)
    with pytest.raises(SystemExit) as told:
        run(main)
    assert str(told.value).startswith("sheep_myocardium: ")
    assert "ForceStrain_M4.csv is missing" in str(told.value)
    assert "\n" not in str(told.value)


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
    runs = curves.Runs(*(np.asarray(a) for a in (x, force, slopes)))
    emulated = curves.fit(bodies[:1], [runs]).emulated
    again = jax.jit(jax.vmap(lambda x: curves.forces(emulated, x[None])[0]))(x)
    np.testing.assert_allclose(again, force, rtol=1e-4)


def test_no_runs_of_a_cube(tmp_path):
    """A round leaves out cubes that are known."""
    (heart,) = experiment.hearts(write_heart(tmp_path / "TSL9").parent)
    (body, *_) = curves.cubes(heart, cells=1)
    none = body.runs(np.zeros((0, 10)))
    some = curves.Runs(np.ones((2, 10)), np.ones((2, 30)), np.ones((2, 30, 10)))
    for joined, alone in zip(curves.joined([some, none]), some, strict=True):
        np.testing.assert_array_equal(joined, alone)


@pytest.mark.slow  # compiles FEM of a cube twice
def test_forces_without_slopes_are_the_same(tmp_path):
    (heart,) = experiment.hearts(write_heart(tmp_path / "TSL9").parent)
    (body, *_) = curves.cubes(heart, cells=1)
    x = np.zeros((1, 10))
    sloping, plain = body.runs(x), replace(body, sloping=False).runs(x)
    assert np.isfinite(sloping.slopes).all()
    assert np.isnan(plain.slopes).all()
    np.testing.assert_allclose(plain.force, sloping.force, rtol=1e-6)
