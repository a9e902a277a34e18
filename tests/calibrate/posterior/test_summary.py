"""The summary's effective draws are those that a run is stopped by."""

import json

import numpy as np
import pytest

from calibrate.arviz import array_stats
from calibrate.posterior.diagnosis import summary_of
from calibrate.samplers.diagnostics import least_ess


def test_tail_ess_is_of_the_quantiles_that_a_run_is_stopped_by():
    """Chains that stay in their upper tail for a while, not in their bulk."""
    rng = np.random.default_rng(2)
    values = rng.normal(size=(4, 1000))
    values[:, ::100] = 3.0
    values[:, 1:900:100] = values[:, 2:900:100] = values[:, 3:900:100] = 2.5
    row = summary_of({"mu": values})["mu"]
    axes = {"chain_axis": 0, "draw_axis": 1}
    for_stopping = array_stats.ess(values, method="tail", prob=(0.05, 0.95), **axes)
    inner = array_stats.ess(values, method="tail", prob=(0.055, 0.945), **axes)
    assert row["ess_tail"] == pytest.approx(float(for_stopping))
    assert abs(float(for_stopping) - float(inner)) > 1.0
    assert min(row["ess_bulk"], row["ess_tail"]) == pytest.approx(least_ess(values))


def test_a_summary_prints_as_a_table():
    draws = np.random.default_rng(0).normal(size=(4, 100))
    table = summary_of({"a": draws, "long_name": 1e3 * draws})
    lines = str(table).splitlines()
    assert lines[0].split() == list(table["a"])
    assert [line.split()[0] for line in lines[1:]] == ["a", "long_name"]
    assert len(set(map(len, lines))) == 1
    assert repr(table) == str(table)
    assert json.loads(json.dumps(table)) == table
