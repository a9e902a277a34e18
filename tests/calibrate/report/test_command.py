"""``calibrate report`` on a beam: no fibres, no cavity, no certificate."""

import json

import pytest

from calibrate.cli import main
from calibrate.project import Run, infer
from calibrate.report import charts


@pytest.mark.slow
def test_a_law_without_fibres_and_a_body_without_cavity(tmp_path, capsys):
    truth = {"mu": 70.0, "lam": 70.0}
    run = Run(
        "once_clamped_beam", truth=truth, observe="landmarks:6", noise=0.5, draws=60, chains=2,
        sampler="laplace",
    )  # fmt: skip
    posterior = infer(run, tmp_path / "run")
    assert charts.volume_band(posterior) is None
    assert len(charts.stress(posterior).data) == 2
    assert main(["report", str(tmp_path / "run"), "--no-fem", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    text = (tmp_path / "run" / "report.html").read_text(encoding="utf-8")
    assert told == {"out": str(tmp_path / "run" / "report.html")}
    assert "truth" in text
    assert "not certified" in text
    assert "once_clamped_beam" in text
    assert "Forward map: graph network; " in text
    assert "a graph network&#39;s processor, is computed once, in" in text
    assert main(["report", str(tmp_path / "run"), "--out", "page.pdf"]) == 2
    assert "must end in .html" in capsys.readouterr().err
    assert main(["report", str(tmp_path / "none")]) == 2
    assert capsys.readouterr().err.count("\n") == 1
