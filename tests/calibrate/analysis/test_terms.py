"""Which terms a test shows: against quadrature, twins, terms that do the same, and refusals."""

import json
from itertools import combinations

import numpy as np
import pytest
from scipy.stats import truncnorm

import calibrate as cal
import emulator as em
from calibrate.analysis.term_sets import posterior_of_sets
from calibrate.analysis.terms import Terms, _compared, _held_out, find_terms
from calibrate.cli import main
from emulator.core.errors import InputError
from emulator.mechanics.laws.invariant_terms import TERMS
from emulator.specimens.specimen import specimen
from emulator.specimens.states import states

PULL = np.linspace(1.02, 1.2, 8)
HALF, STILL = 0.5 + 0.5 * PULL, np.ones(8)
SHEAR, NONE = np.linspace(0.05, 0.4, 8), np.zeros(8)
GIVEN = states(
    {
        "stretch_x": np.concatenate([PULL, PULL, HALF, STILL, STILL]),
        "stretch_y": np.concatenate([PULL, HALF, PULL, STILL, STILL]),
        "shear_xy": np.concatenate([NONE, NONE, NONE, SHEAR, NONE]),
        "shear_xz": np.concatenate([NONE, NONE, NONE, NONE, SHEAR]),
    },
    [name for name in ("equal", "x", "y", "xy", "xz") for _ in range(8)],
)


def scene_of(given=GIVEN, scale="uniform", fibre=(1.0, 0.0, 0.0)):
    return specimen(
        given,
        law=em.find_law("invariant_terms"),
        parameters=tuple(
            em.Parameter(name, "kPa", 0.0 if scale == "uniform" else 0.1, 50.0, scale)
            for name in TERMS
        ),
        constants={"kappa": 1000.0},
        fibres=fibre,
        sheets=(-fibre[1], fibre[0], 0.0),
    )


def model_of(scene, noise=None, **options):
    observe = cal.stresses(scene, "cauchy_x,cauchy_y,cauchy_xy,cauchy_xz")
    noise = noise or cal.GaussianNoise(0.1)
    forward = em.homogeneous(scene, incompressible=options.get("incompressible", True))
    return cal.model(forward, {"stress": observe}, {"stress": noise}, check_scale=False)


def test_probabilities_are_those_of_quadrature():
    rng = np.random.default_rng(2)
    G = np.column_stack([np.linspace(0.0, 1.0, 6), np.linspace(0.0, 1.0, 6) ** 2])
    y = G @ [0.7, 0.4] + 0.1 * rng.normal(size=6)
    found = _compared(G, y, ["one", "two"])
    size = np.sqrt(np.mean(y**2))
    sds, c = np.geomspace(1e-3 * size, size / 3.0, 400), np.linspace(0.0, 4.0, 401) + 0.005
    sums = {}
    for S in [S for k in range(3) for S in combinations(range(2), k)]:
        axes = [c if k in S else np.zeros(1) for k in range(2)]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
        square, own = ((y - grid @ G.T) ** 2).sum(axis=1), list(S)
        best = np.linalg.lstsq(G[:, own], y, rcond=None)[0] if S else np.zeros(0)
        A = G[:, own].T @ G[:, own]
        away = grid[:, own] - best
        form = np.einsum("ci,ij,cj->c", away, A, away) if S else np.zeros(1)
        sums[S] = (
            0.25 ** len(S)
            * 0.75 ** (2 - len(S))
            * sum(
                np.average(np.exp(-0.5 * square / sd**2), weights=np.exp(-0.5 * form / (6 * sd**2)))
                / sd**6
                for sd in sds
            )
        )
    total = sum(sums.values())
    for k, name in enumerate(("one", "two")):
        exact = sum(value for S, value in sums.items() if k in S) / total
        assert found.probabilities[name] == pytest.approx(exact, abs=0.03)


@pytest.fixture(scope="module")
def twins():
    """A model of five tests, and data with 3 % noise: of three terms, and without their shear."""
    model, data = model_of(scene_of()), []
    for moduli in ({"I1": 8.0, "f_2": 20.0, "fs_2": 10.0}, {"I1": 8.0, "f_2": 20.0}):
        theta = np.array([moduli.get(name, 0.0) for name in TERMS])
        exact = np.asarray(model.observe.parts["stress"](model.forward(theta), theta))
        noise = np.random.default_rng(1).normal(size=exact.shape)
        data.append(exact + 0.03 * np.sqrt(np.mean(exact**2)) * noise)
    return model, *data


def test_terms_of_a_twin_are_found(twins):
    model, data, _ = twins
    found = find_terms(model, data)
    present = {name for name, chance in found.probabilities.items() if chance > 0.5}
    assert present == {"I1", "f_2", "fs_2"}
    assert found.moduli["f_2"][0] == pytest.approx(20.0, abs=4.0 * found.moduli["f_2"][1])
    assert found.sets[0][0] == ("I1", "f_2", "fs_2")
    assert found.noise == pytest.approx(0.3 * np.sqrt(np.mean(data**2)), rel=0.2)
    # Fibres and sheets shear in one test: the others cannot predict it, and predict one another.
    *others, shear = sorted(found.held_out, key=lambda each: each.test == "xy")
    assert shear.inside < 0.6 < 0.85 < min(each.inside for each in others)
    assert shear.in_noise > 5.0 > 1.3 > max(each.in_noise for each in others)
    assert shear.alone == ("fs_2", "fs_e")
    assert "do not predict 'xy', which alone shows fs_2, fs_e" in str(found)


@pytest.mark.slow
def test_a_twin_whose_tests_predict_one_another(twins):
    model, _, data = twins
    found = find_terms(model, data)
    assert [each.test for each in found.held_out] == ["equal", "x", "y", "xy", "xz"]
    assert min(each.inside for each in found.held_out) > 0.8
    assert max(each.in_noise for each in found.held_out) < 1.3
    words = "each test is predicted by the others; no other set predicts better than"
    assert found.held_out_in_words().startswith(words)
    expected = -0.5 * np.log(2.0 * np.pi * np.e) - np.log(found.noise)
    assert found.log_densities[0] == pytest.approx(expected, abs=0.1)


def test_a_set_predicts_by_positive_moduli():
    """One modulus, half an sd above zero: the mean of a normal variable that is cut there."""
    g = np.linspace(0.1, 1.0, 20)[:, None]
    y = np.random.default_rng(6).normal(size=20)
    y += (0.5 / np.sqrt(g[:, 0] @ g[:, 0]) - g[:, 0] @ y / (g[:, 0] @ g[:, 0])) * g[:, 0]
    posterior = posterior_of_sets(g, y, ["one"])
    mean, below, _ = posterior.predicted(1, np.zeros(1), g[-1:])
    sd = np.sqrt(20.0 / 21.0 / (g[:, 0] @ g[:, 0])) * (posterior.weights[1] @ posterior.sds)
    sd /= posterior.weights[1].sum()
    centre = g[:, 0] @ y / (g[:, 0] @ g[:, 0])
    exact = truncnorm(-centre / sd, np.inf, loc=centre, scale=sd).mean()
    assert mean[0] == pytest.approx(exact, rel=0.15)
    assert below[0] < 0.5


def test_bands_of_tests_whose_errors_correlate_hold_nine_points_in_ten():
    g = np.linspace(0.1, 1.0, 12)
    columns = np.concatenate([np.stack([g, g**3], axis=1) * k for k in (1.0, 2.0, 0.5)])
    within = 0.05**2 * (np.exp(-np.abs(g[:, None] - g) / 0.3) + 0.3 * np.eye(12))
    covariance = np.kron(np.eye(3), within)
    white = np.linalg.cholesky(np.linalg.inv(covariance)).T
    tests = {name: np.arange(12 * k, 12 * k + 12) for k, name in enumerate("abc")}
    rng, inside, errors = np.random.default_rng(8), [], []
    for _ in range(40):
        data = columns @ [0.0, 1.0] + rng.multivariate_normal(np.zeros(36), covariance)
        G, y = white @ columns, white @ data
        reports = _held_out(tests, white, G, y, _compared(G, y, "ab"))
        inside += [each.inside for each in reports]
        errors += [each.in_noise for each in reports]
    assert np.mean(inside) == pytest.approx(0.9, abs=0.04)
    assert 1.0 < np.sqrt(np.mean(np.square(errors))) < 1.3  # moduli are not known, either


def test_another_set_that_predicts_better_is_named():
    g = np.linspace(0.1, 1.0, 10)
    G = np.tile(np.stack([g, g**2], axis=1), (3, 1))
    y = G @ [0.0, 1.0] + 0.02 * np.random.default_rng(5).normal(size=30)
    tests = {name: np.arange(10 * k, 10 * k + 10) for k, name in enumerate("abc")}
    terms = Terms({"a": 0.5, "b": 0.5}, [(("a",), 0.6), (("b",), 0.4)], {}, 1.0)
    found = Terms(**vars(terms) | {"held_out": _held_out(tests, np.eye(30), G, y, terms)})
    assert found.held_out_in_words().endswith("b predicts better than the likeliest set")
    assert _held_out({"all": np.arange(30)}, np.eye(30), G, y, terms) == []


def test_terms_that_do_the_same_share_their_probability():
    g = np.linspace(0.0, 1.0, 20)
    y = 2.0 * g + 0.02 * np.random.default_rng(0).normal(size=20)
    found = _compared(np.column_stack([g, 3.0 * g, g**3, 0.0 * g]), y, "abcd")
    assert found.probabilities["a"] == pytest.approx(found.probabilities["b"], abs=1e-3)
    assert 0.4 < found.probabilities["a"] < 0.8
    assert found.probabilities["d"] == 0.25  # the data do not have it
    assert {"a", "b", "d"} <= set(found.undecided)
    assert "undecided" in str(found)
    assert not found.held_out
    assert "held out" not in str(found)


def test_a_set_that_needs_a_negative_modulus_is_not_taken():
    g = np.linspace(0.1, 1.0, 30)
    y = 2.0 * g - 0.8 * g**3 + 0.005 * np.random.default_rng(4).normal(size=30)
    found = _compared(np.column_stack([g, g**3, g**0.5]), y, "abc")
    assert found.probabilities["b"] < 0.1
    assert min(mean for name, (mean, _) in found.moduli.items() if name != "b") > 0.0
    assert found.probabilities["a"] > 0.99


@pytest.mark.slow
def test_a_test_without_shear_says_nothing_of_shear():
    rows = slice(24)
    given = states({"stretch_x": GIVEN.gradients[rows, 0, 0] + 1.0,
                    "stretch_y": GIVEN.gradients[rows, 1, 1] + 1.0}, ["a"] * 8 + ["b"] * 8
                   + ["c"] * 8)  # fmt: skip
    scene = scene_of(given)
    observe = cal.stresses(scene, "cauchy_x,cauchy_y")
    forward = em.homogeneous(scene, incompressible=True)
    model = cal.model(
        forward, {"stress": observe}, {"stress": cal.CorrelatedNoise(0.1, sd_scale=0.1,
                                                                     spatial_sd_scale=0.1)}
    )  # fmt: skip
    theta = np.array([5.0 if name == "f_2" else 0.0 for name in TERMS])
    data = np.asarray(observe(forward(theta), theta))
    data = data + 0.05 * np.random.default_rng(3).normal(size=data.shape)
    found = find_terms(model, data)
    assert found.probabilities["fs_2"] == found.probabilities["fs_e"] == 0.25
    assert found.probabilities["f_2"] + found.probabilities["f_3"] > 0.9


UNIAXIAL = states({"stretch_x": PULL, "stretch_y": np.full(8, np.nan)})


@pytest.mark.parametrize(
    ("scale", "fibre", "noise", "words"),
    [
        pytest.param(
            "uniform", (0.8, 0.6, 0.0), None, "not linear in the moduli", marks=pytest.mark.slow
        ),
        ("log", (1.0, 0.0, 0.0), None, "no modulus on a uniform scale"),
        ("uniform", (1.0, 0.0, 0.0), cal.StudentTNoise(4.0, scale=0.1), "must be Gaussian"),
    ],
)
def test_what_is_not_linear_is_refused(scale, fibre, noise, words):
    model = model_of(scene_of(UNIAXIAL, scale, fibre), noise)
    with pytest.raises(InputError, match=words):
        find_terms(model, np.ones(model.observe.shapes["stress"]))


def test_by_command(tmp_path, capsys, monkeypatch, twins):
    monkeypatch.chdir(tmp_path)
    _, data, _ = twins
    lines = ["protocol,stretch_x,stretch_y,shear_xy,shear_xz,cauchy_x,cauchy_y,cauchy_xy,cauchy_xz"]
    names = [n for n in ("equal", "x", "y", "xy", "xz") for _ in range(8)]
    for name, H, row in zip(names, GIVEN.gradients, data, strict=True):
        motion = (1 + H[0, 0], 1 + H[1, 1], H[0, 1], H[0, 2])
        lines.append(",".join([name, *(f"{x:.17g}" for x in (*motion, *row))]))
    (tmp_path / "test.csv").write_text("\n".join(lines))
    assert main(["init", "test.csv", "--law", "invariant_terms"]) == 0
    capsys.readouterr()
    assert main(["terms", "test.toml", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert max(found["probabilities"], key=found["probabilities"].get) in ("I1", "f_2", "fs_2")
    assert {each["test"] for each in found["held_out"]} == {"equal", "x", "y", "xy", "xz"}
