from dataclasses import replace

import numpy as np
import pytest

import calibrate as cal
from certificate_support import exact_data, exact_posterior, grid_of, linear_model, quadrature
from emulator.errors import InputError
from linear_support import LinearSimulator, linear_forward


@pytest.fixture(scope="module")
def biased(beam):
    """A posterior made with a map two noise sd off where mu moves it, FEM's map, and the data."""
    fem = linear_forward(beam, size=0.02)
    data = exact_data(linear_model(beam, forward=fem))
    off = 0.2 * np.sign(fem.matrix[..., 0])
    wrong = linear_model(beam, forward=replace(fem, shift=fem.shift + off))
    return exact_posterior(wrong, data), fem, data


@pytest.mark.slow
def test_the_reweighted_posterior_is_fems_and_is_accepted(biased):
    posterior, fem, data = biased
    reweighted = cal.reweight(posterior, LinearSimulator(fem))
    points, weights = grid_of(), quadrature(fem, data)
    moved = []
    for k, name in enumerate(("mu", "lam")):
        mean = weights @ points[:, k]
        sd = np.sqrt(weights @ (points[:, k] - mean) ** 2)
        row = reweighted.summary()[name]
        assert abs(row["mean"] - mean) < 0.2 * sd
        assert row["sd"] == pytest.approx(sd, rel=0.15)
        moved.append(abs(posterior.summary()[name]["mean"] - mean) / sd)
    assert max(moved) > 0.5
    assert reweighted.divergences == 0
    assert reweighted.data is posterior.data
    again = cal.certify(reweighted, LinearSimulator(fem))
    assert again.verdict in ("accepted", "undecided")


def test_it_leaves_the_posterior_alone(biased):
    posterior, fem, _ = biased
    before = {name: values.copy() for name, values in posterior.draws().items()}
    reweighted = cal.reweight(posterior, LinearSimulator(fem), draws=80)
    assert "reweighted" in reweighted.tree.attrs
    assert "reweighted" not in posterior.tree.attrs
    for name, values in posterior.draws().items():
        np.testing.assert_array_equal(values, before[name])


def test_it_is_refused_where_nothing_says_it_is_fems(biased):
    posterior, fem, _ = biased
    with pytest.raises(InputError, match="the verdict is 'not certified'"):
        cal.reweight(posterior, LinearSimulator(replace(fem, limit=0.0)), draws=25)
