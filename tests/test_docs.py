"""The documentation: every public name is on it, and it builds without a warning."""

import inspect
import re
import subprocess
import sys
from pathlib import Path

import pytest

import calibrate
import emulator
from calibrate.statistical_model.shared_errors import SHARED_ERRORS

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize("package", [emulator, calibrate], ids=lambda p: p.__name__)
def test_every_public_name_is_documented(package):
    bare = [n for n in package.__all__ if not inspect.getdoc(getattr(package, n))]
    assert not bare


def test_pages_are_reached():
    text = (ROOT / "docs" / "index.md").read_text(encoding="utf-8")
    listed = set(re.findall(r"^[a-z_/]+$", text, flags=re.MULTILINE))
    pages = {path.stem for path in (ROOT / "docs").glob("*.md")} - {"index"}
    assert pages <= listed


def test_the_docs_have_every_kind_of_error_that_numbers_share():
    text = (ROOT / "docs" / "experiment_files.md").read_text(encoding="utf-8")
    kinds = set(re.findall(r"^\| `(\w+)` \|", text, flags=re.MULTILINE))
    assert kinds == set(SHARED_ERRORS)


@pytest.mark.slow
def test_the_site_builds_without_a_warning(tmp_path):
    pytest.importorskip("sphinx", reason="no sphinx here")
    words = ["-W", "--keep-going", "-q", "-b", "html", ROOT / "docs", tmp_path]
    command = [sys.executable, "-m", "sphinx", *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    page = (tmp_path / "generated" / "calibrate.html").read_text(encoding="utf-8")
    for name in calibrate.__all__:
        assert f'id="calibrate.{name}"' in page


@pytest.mark.slow
def test_the_examples_of_the_readme_run(capsys):
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    names = {}
    for code in re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL):
        exec(compile(code, "README.md", "exec"), names)
    said = capsys.readouterr().out
    assert "accepted" in said
    assert 120.0 < float(said.split()[-1]) < 180.0  # mL


@pytest.mark.slow
def test_the_quick_start_runs(capsys):
    text = (ROOT / "docs" / "quickstart.md").read_text(encoding="utf-8")
    (code,) = re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL)
    exec(compile(code, "quickstart.md", "exec"), {})
    assert "accepted" in capsys.readouterr().out


@pytest.mark.slow
def test_the_examples_of_populations_run():
    text = (ROOT / "docs" / "populations.md").read_text(encoding="utf-8")
    names = {}
    for code in re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL):
        exec(compile(code, "populations.md", "exec"), names)
    assert names["solution"].converged
    found = names["found"]
    assert abs(found.summary()["median[mu]"]["mean"] - 70.0) < 7.0
    assert found.summary()["median[mu]"]["r_hat"] < 1.02
