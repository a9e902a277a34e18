"""Charts of draws by name, without a posterior."""

import numpy as np
import pytest

from calibrate.report.charts import inside, pairs

LABELS = {"mu": "mu (kPa)", "lam": "lam (kPa)", "nu": "nu"}


@pytest.mark.parametrize("count", [2, 3])
def test_pairs_are_drawn_of_two_and_of_more(count):
    """A matrix of one panel is left blank by Plotly, so two names are a chart of their own."""
    labels = dict(list(LABELS.items())[:count])
    draws = {name: np.arange(5.0) + k for k, name in enumerate(labels)}
    figure = pairs(labels, draws)
    if count == 3:
        assert [each.label for each in figure.data[0].dimensions] == list(labels.values())
        return
    np.testing.assert_array_equal(figure.data[0].x, draws["mu"])
    np.testing.assert_array_equal(figure.data[0].y, draws["lam"])
    assert figure.layout.xaxis.title.text == "mu (kPa)"
    assert figure.layout.yaxis.title.text == "lam (kPa)"


def test_data_lies_within_the_central_90_percent_or_not():
    """Of 0, 1, ..., 100: from 5 to 95; missing data is left out."""
    values = np.tile(np.arange(101.0)[:, None], 4)
    measured = np.array([4.9, 5.1, np.nan, 95.1])
    assert inside(values, measured).tolist() == [False, True, False]
