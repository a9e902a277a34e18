"""Models of the same data compared, against closed forms of linear maps."""

import json

import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr
from scipy import stats

import calibrate as cal
from calibrate.cli import main
from calibrate.posterior.comparison import compare
from calibrate.samplers.smc import SMCOptions
from emulator.core.errors import InputError
from linear_support import PRIOR_MEAN, PRIOR_SD, closed_form, linear_forward, linear_problem

SD = 0.1


def marginal(model):
    """Mean (e,) and covariance of the data of a linear map, theta integrated out."""
    A = model.forward.matrix.reshape(-1, 2)
    mean = np.asarray(model.forward(jnp.asarray(PRIOR_MEAN))).ravel()
    return mean, A * PRIOR_SD**2 @ A.T + SD**2 * np.eye(len(A))


def exact_elpd(model, data):
    """Sum of log p(y_i | y_-i), each the ratio of two of SciPy's densities."""
    y, (mean, C) = np.asarray(data).ravel(), marginal(model)
    whole = stats.multivariate_normal.logpdf(y, mean, C)
    total = 0.0
    for i in range(len(y)):
        rest = np.delete(np.arange(len(y)), i)
        total += whole - stats.multivariate_normal.logpdf(
            y[rest], mean[rest], C[np.ix_(rest, rest)]
        )
    return total


def exact_fit(model, data):
    """Sum of log p(y_i | y): of each datum given all, itself included."""
    mean, covariance = closed_form(model.full, model.observe.nodes, data, SD, PRIOR_MEAN, PRIOR_SD)
    A = model.forward.matrix.reshape(-1, 2)
    centre = np.asarray(model.forward(jnp.asarray(mean))).ravel()
    sds = np.sqrt(np.einsum("ej,jk,ek->e", A, covariance, A) + SD**2)
    return stats.norm.logpdf(np.asarray(data).ravel(), centre, sds).sum()


@pytest.fixture(scope="module")
def problems(beam):
    """The right map and one that is biased by two noise sds; the same data."""
    model, data = linear_problem(beam)
    biased, _ = linear_problem(beam, linear_forward(beam, bias=2.0 * SD))
    return {"right": model, "biased": biased}, data


@pytest.fixture(scope="module")
def posteriors(problems):
    models, data = problems
    options = cal.samplers.NUTSOptions(300, 1000, chains=2, rounds=1)
    return {name: cal.sample(model, data, options=options) for name, model in models.items()}


@pytest.fixture
def trees(posteriors):
    return {name: posterior.tree for name, posterior in posteriors.items()}


def test_scores_are_the_closed_form_s(problems, trees):
    models, data = problems
    found = compare(trees)
    exact = {name: exact_elpd(model, data) for name, model in models.items()}
    assert [model.name for model in found.models] == ["right", "biased"]
    for model in found.models:
        assert model.elpd == pytest.approx(exact[model.name], abs=0.4)
        fitted = exact_fit(models[model.name], data)
        assert model.parameters == pytest.approx(fitted - exact[model.name], abs=0.5)
        assert model.log_evidence is None
    right, biased = found.models
    assert right.difference == 0.0
    assert biased.difference == pytest.approx(exact["biased"] - exact["right"], abs=0.5)
    assert right.weight + biased.weight == pytest.approx(1.0)
    assert found.data == 9
    assert found.verdict.startswith("right predicts better, by ")


def test_a_model_and_itself_are_not_told_apart(problems, trees):
    models, data = problems
    options = cal.samplers.NUTSOptions(300, 1000, chains=2, rounds=1)
    again = cal.sample(models["right"], data, options=options, seed=5).tree
    verdict = compare({"one": trees["right"], "two": again}).verdict
    assert verdict.startswith("not decided: ")


@pytest.mark.slow
def test_evidence_where_the_sampler_knows_it(problems, trees):
    models, data = problems
    tree = cal.sample(
        models["biased"], data, sampler="smc", options=SMCOptions(draws=500, chains=4)
    ).tree
    found = {model.name: model for model in compare({"a": tree, "b": trees["right"]}).models}
    exact = stats.multivariate_normal.logpdf(np.asarray(data).ravel(), *marginal(models["biased"]))
    assert found["a"].log_evidence == pytest.approx(exact, abs=5 * found["a"].log_evidence_error)
    assert found["b"].log_evidence is None


def test_an_outlier_that_decides_alone_is_named(problems, trees):
    """Its densities' inverses have a tail of index 1/3: importance sampling has no mean."""
    tree = trees["right"].copy(deep=True)
    values = tree["log_likelihood"]["displacement"].values
    values[..., 0, 0] -= np.random.default_rng(0).exponential(3.0, values.shape[:2])
    found = compare({"right": trees["right"], "spoiled": tree})
    assert max(model.unreliable for model in found.models) == 1
    assert found.verdict.startswith("not decided: single data decide too much in spoiled")


def test_a_model_that_no_datum_fits_loses_though_its_score_is_unreliable(problems, trees):
    """Its ceiling, the data given the draws that have seen them, is a closed form here."""
    models, data = problems
    hopeless = trees["right"].copy(deep=True)
    values = hopeless["log_likelihood"]["displacement"].values
    values[..., 0, 0] -= np.random.default_rng(0).exponential(3.0, values.shape[:2])
    values -= 60.0
    found = compare({"right": trees["right"], "hopeless": hopeless})
    assert found.models[1].unreliable == 1
    assert found.verdict.startswith("right predicts better, by at least 5")
    right = found.models[0]
    assert right.ceiling == pytest.approx(exact_fit(models["right"], data), abs=0.3)
    # The other way round: a best model whose own score is not to be relied on.
    hopeless["log_likelihood"]["displacement"].values += 120.0
    verdict = compare({"right": trees["right"], "hopeless": hopeless}).verdict
    assert verdict.startswith("not decided: single data decide too much in hopeless")


def test_a_datum_that_no_parameter_moves_counts_as_it_is(trees):
    """Its likelihood is the same with and without it: a specimen at rest, with known noise."""
    known = trees["right"].copy(deep=True)
    known["log_likelihood"]["displacement"].values[..., 0, 0] = -0.7
    (score,) = (m for m in compare({"a": known, "b": trees["biased"]}).models if m.name == "a")
    rest = trees["right"].copy(deep=True)
    rest["log_likelihood"]["displacement"].values[..., 0, 0] = 0.0
    (without,) = (m for m in compare({"a": rest, "b": trees["biased"]}).models if m.name == "a")
    assert score.elpd - without.elpd == pytest.approx(-0.7, abs=1e-9)
    assert score.parameters == pytest.approx(without.parameters, abs=1e-9)
    assert score.unreliable == 0


def test_a_chain_that_never_moved_is_told(trees):
    """A quarter of the draws is one draw: nothing can be said of the tail of the weights."""
    stuck = trees["right"].copy(deep=True)
    values = stuck["log_likelihood"]["displacement"].values
    values[0] = values[0, :1] - 5.0
    found = compare({"stuck": stuck, "biased": trees["biased"]})
    assert max(model.unreliable for model in found.models) == 9


def test_only_models_of_the_same_data(problems, trees):
    right = trees["right"]
    other = right.copy(deep=True)
    other["observed_data"]["displacement"].values[0, 0] += 1e-6
    with pytest.raises(InputError, match="were given different data of 'displacement'"):
        compare({"a": right, "b": other})
    renamed = right.copy(deep=True)
    renamed["observed_data"] = xr.DataTree(xr.Dataset({"volume": ("n", [1.0])}))
    with pytest.raises(InputError, match="a observes displacement, b volume"):
        compare({"a": right, "b": renamed})
    with pytest.raises(InputError, match="1 posterior is given"):
        compare({"a": right})
    bare = right.copy(deep=True)
    del bare["log_likelihood"]
    with pytest.raises(InputError, match="b has no log likelihoods"):
        compare({"a": right, "b": bare})
    allowed = right.copy(deep=True)
    allowed.attrs["forward_error"] = "abc"
    with pytest.raises(InputError, match="b allows for systematic errors, which"):
        compare({"a": right, "b": allowed})
    allowed.attrs["run"] = json.dumps({"systematic": {"camera": {}, "pins": {}}})
    with pytest.raises(InputError, match=r"b allows for systematic errors \(camera, pins\)"):
        compare({"a": right, "b": allowed})


def test_the_command(posteriors, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name, posterior in posteriors.items():
        (tmp_path / name).mkdir()
        posterior.save(tmp_path / name / "posterior.nc")
    assert main(["compare", "biased", "right"]) == 0
    printed = capsys.readouterr().out
    assert printed.splitlines()[1].startswith("right")
    assert "leave-one-out over 9 data: right predicts better" in printed
    assert main(["compare", "biased", "right", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["models"][1]["name"] == "biased"
    for words, message in (
        (["biased"], "1 posterior is given"),
        (["biased", "biased"], "a folder is given twice"),
        (["biased", "absent"], "posterior file absent/posterior.nc does not exist"),
    ):
        assert main(["compare", *words]) == 2
        error = capsys.readouterr().err
        assert message in error
        assert len(error.splitlines()) == 1
