import contextlib
import io
import json

import numpy as np
import pytest

from calibrate.certificate.verdict import NO_TAIL
from calibrate.cli import main
from calibrate.posterior import read_tree
from calibrate.project.demo import BEAM


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    """Folder and report of the demo."""
    folder, printed = tmp_path_factory.mktemp("demo"), io.StringIO()
    with contextlib.redirect_stdout(printed):
        assert main(["demo", "--out", str(folder), "--json"]) == 0
    return folder, json.loads(printed.getvalue())


def test_the_demo_ends_accepted(demo):
    folder, report = demo
    assert report["verdict"] == "accepted"
    tail = report["certificate"]["tail"]
    assert tail["k_hat"] < tail["k_threshold"] or tail["largest"] < NO_TAIL
    for name, truth in BEAM.truth.items():
        row = report["parameters"][name]
        assert row["truth"] == truth
        assert row["r_hat"] < 1.01
        assert abs(row["mean"] - truth) < 3 * row["sd"]
    # mu is found, lam hardly: bending depends on it little.
    assert report["parameters"]["mu"]["sd"] < 2.0
    assert report["parameters"]["lam"]["sd"] > 5.0
    tree = read_tree(folder / "posterior.nc")
    assert tree.attrs["forward_fingerprint"]
    assert json.loads(tree.attrs["observe"])["displacement"]["kind"] == "nodes"
    assert json.loads(tree.attrs["sampler_options"])["chains"] == 4
    assert json.loads(tree.attrs["prior"])["mu"] == "LogUniform(low=50.0, high=100.0)"
    picture = (folder / "beam.png").read_bytes()
    assert picture[:4] == b"\x89PNG"
    assert len(picture) > 30_000


@pytest.mark.slow
def test_a_kept_run_can_be_certified_again(demo, capsys):
    folder, _ = demo
    before = json.loads((folder / "certificate.json").read_text())
    assert main(["certify", str(folder), "--draws", "100", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["certificate"]["draws"] == 100
    assert np.isclose(report["certificate"]["mean_fem"]["mu"], before["mean_fem"]["mu"], atol=0.5)
