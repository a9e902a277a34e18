"""The code of docs/ecosystem.md runs, and all samplers find one posterior."""

import re
import warnings
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

PAGE = Path(__file__).resolve().parents[1] / "docs" / "ecosystem.md"
pytestmark = pytest.mark.slow


def blocks():
    """Code of the page by the heading above it, up to a colon."""
    sections = re.split(r"^#+ ", PAGE.read_text(encoding="utf-8"), flags=re.MULTILINE)
    code = {s.split("\n")[0]: re.findall(r"```python\n(.*?)```", s, re.DOTALL) for s in sections}
    return {heading.split(":")[0]: "\n".join(parts) for heading, parts in code.items() if parts}


def run(names, *headings):
    found = blocks()
    for heading in headings:
        exec(compile(found[heading], f"{PAGE.name}, {heading}", "exec"), names)
    return names


@pytest.fixture(scope="module")
def prepared():
    return run({}, "With other libraries", "BlackJAX")


@pytest.fixture(scope="module")
def reference(prepared):
    """Our own posterior of the same model."""
    cal = prepared["cal"]
    return cal.sample(prepared["model"], prepared["data"], predictions=False).draws()


def agree(found, reference):
    for name, draws in reference.items():
        sd = draws.std()
        assert abs(np.mean(found[name]) - draws.mean()) < 0.4 * sd  # 1000 dependent draws
        assert 0.7 < np.std(found[name]) / sd < 1.4


def test_blackjax(prepared, reference):
    agree(prepared["blackjax_draws"], reference)


def test_numpyro(prepared):
    draws = run(dict(prepared), "NumPyro")["numpyro_draws"]
    assert abs(draws["sd"].mean() - 0.2) < 0.05
    assert abs(draws["mu"].mean() - 73.0) < 3.0  # another prior, but the data determine mu


def test_pymc(prepared, reference):
    pytest.importorskip("pymc", reason="no pymc here; the example needs it")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # PyMC's own
        agree(run(dict(prepared), "PyMC")["pymc_draws"], reference)


def test_meshes(prepared, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = run(dict(prepared), "Meshes")
    assert names["u"][:, 2].min() < 0.0
    assert (tmp_path / "u.vtu").is_file()


def test_labelled_data(prepared, tmp_path):
    names = run(dict(prepared), "xarray and ArviZ")
    first, again = (names[name].draws()["mu"] for name in ("posterior", "again"))
    np.testing.assert_array_equal(first, again)
    names["posterior"].save(tmp_path / "posterior.nc")
    with xr.open_datatree(tmp_path / "posterior.nc") as tree:
        assert {"posterior", "observed_data"} <= set(tree.children)
