"""The study of sheep myocardium: its files, its formula and its emulator, without its long runs."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from studies.common.output import run
from studies.sheep_myocardium import (
    campaign,
    checked,
    cube,
    curves,
    experiment,
    inference,
    process,
)
from studies.sheep_myocardium.__main__ import main

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
    points, _ = process.values_and_slopes(0, x, H)
    covariance, sd = process.left(told, lengths, points)
    rows = points.value == 1.0
    said = sd * np.sqrt(np.maximum(np.diagonal(covariance)[rows], 0.0))
    made_there = jax.vmap(process.correction, (None, 0))(made, points.at[rows])
    wrong = np.asarray(made_there)[:, 0] - made_up(x)[0][:, 0]
    assert np.abs(wrong).max() < 0.03
    assert 0.3 < np.sqrt(np.mean((wrong / (said + 1e-5)) ** 2)) < 3.0


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


def test_a_meshs_error_is_taken_off_by_its_order():
    """Forces that are too large by 0.2 h^1.2, on 3 and on 5 cells."""
    right = np.full((2, 4), 2.0)
    by = {n: right * (1.0 + 0.2 * n**-1.2) for n in (3, 5)}
    empty = np.zeros((2, 10))
    there, fine = ([curves.Runs(empty, by[n], empty)] for n in (3, 5))
    arrays = {name: jnp.zeros(1) for name in curves.Emulated._fields}
    found = campaign.without_mesh(curves.Emulated(**arrays), there, fine)
    np.testing.assert_allclose(by[3][0] * found.finer[0], right[0], rtol=1e-3)


def test_half_of_what_a_mode_is_off_is_the_same_along_its_curve():
    amounts = jnp.linspace(-0.3, 0.3, 10)
    covariance = np.asarray(inference.covariances(amounts, jnp.ones(10), jnp.asarray(0.2)))
    assert covariance[0, 0] == pytest.approx(0.04 + inference.POINT**2 + inference.CELL**2)
    assert 0.02 < covariance[0, -1] < 0.025


def checked_heart(differences, spread=1.0):
    """A heart whose draws are Gaussian in logarithms, tested at 30 of them."""
    rng = np.random.default_rng(4)
    names = inference.parameters(inference.ORTHOTROPIC)
    logs = {n: rng.normal(0.0, 0.1, 1000) for n in names}
    draws = {"omega": np.exp(rng.normal(-1.0, 0.1, 1000))}

    def found(moved):
        return SimpleNamespace(
            law=inference.ORTHOTROPIC, draws=draws, worst_rhat=1.0, least_ess=900.0, divergences=0,
            positions=np.zeros((1000, 3, 10)), theta=lambda name: np.exp(logs[name] + moved),
        )  # fmt: skip

    tested = np.arange(30)
    return SimpleNamespace(
        explored=found(0.0), on_mesh=found(0.1 * spread), tested=tested, meshes=([], []),
        likelihood_differences=lambda: differences(logs, tested),
    )  # fmt: skip


def test_tests_that_leave_the_verdict_open_become_runs(monkeypatch):
    """Until it is accepted, or as often as the plan says."""
    asked = []

    def after(verdicts):
        told = iter(verdicts)

        def made(word, seconds):
            asked.append(word)
            return SimpleNamespace(seconds=seconds)

        monkeypatch.setattr(checked, "campaign", lambda *_: made("first", 0))
        monkeypatch.setattr(checked, "again", lambda found, *_: made("again", found.seconds + 1))
        monkeypatch.setattr(checked, "certificate", lambda _: SimpleNamespace(verdict=next(told)))
        asked.clear()
        heart = SimpleNamespace(name="TSL9")
        return checked.decided(heart, campaign.Plan(again=2), None, 0).seconds

    assert after(["undecided", "accepted"]) == 1
    assert asked == ["first", "again"]
    assert after(["undecided", "not certified", "undecided"]) == 2
    assert after(["accepted"]) == 0
    assert asked == ["first"]


@pytest.mark.parametrize(
    ("differences", "spread", "verdict", "word"),
    [
        (lambda logs, rows: 0.05 * np.sin(rows), 1.0, "accepted", "no mean moves"),
        # FEM's likelihood rises with a: its mean moves by a sd.
        (lambda logs, rows: 10.0 * logs["a"][rows], 1.0, None, "mean of a"),
        (lambda logs, rows: 3.0 * np.sin(5.0 * rows), 1.0, "not certified", "irregularly"),
        (lambda logs, rows: np.where(rows < 3, np.nan, 0.0), 1.0, "not certified", "FEM fails"),
        (lambda logs, rows: 0.0 * rows, 4.0, "not certified", "finer mesh"),
    ],
)
def test_the_librarys_limits_judge_a_heart(differences, spread, verdict, word):
    found = checked.certificate(checked_heart(differences, spread))
    assert found.verdict == verdict if verdict else found.verdict != "accepted"
    assert any(word in each for each in found.findings)
