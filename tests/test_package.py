"""The package as a whole: what importing it does, and what never gets in."""

import re
import shutil
import subprocess
import sys
import tomllib
import zlib
from pathlib import Path

import pytest

import calibrate
import emulator
from calibrate.cli import build_parser
from emulator.core.errors import InputError
from package_check import in_wheel

ROOT = Path(__file__).parents[1]
SOURCES = sorted((ROOT / "src").rglob("*.py"))


def test_what_the_readme_imports_is_there():
    for module in (calibrate, emulator):
        for name in module.__all__:
            try:
                value = getattr(module, name)
            except InputError as error:  # of an extra, which it names
                value = re.search(r"pip install 'soft-tissue-calibrate\[", str(error))
            assert value is not None


@pytest.mark.parametrize(
    "code",
    [
        pytest.param(
            "import os, sys, jax; before = dict(os.environ); import emulator, calibrate;"
            "assert jax.config.jax_enable_x64; assert dict(os.environ) == before;"
            # The libraries behind it take seconds, and are imported by what needs them.
            "slow = {'matplotlib', 'numpyro', 'blackjax', 'arviz_stats', 'flax', 'sklearn',"
            "        'skfem', 'xarray', 'zarr'};"
            "assert not slow & set(sys.modules), slow & set(sys.modules)",
            id="importing turns on float64, loads JAX and does nothing else",
        ),
        pytest.param(
            # ArviZ puts a lazy module in NumPyro's place (calibrate.mend_numpyro).
            "import arviz_base, calibrate; from numpyro import distributions;"
            "calibrate.sample; distributions.distribution",
            id="ArviZ may be imported first",
        ),
        pytest.param(
            "import calibrate, arviz_base, numpyro.distributions as dist;"
            "calibrate.model; dist.distribution",
            id="ArviZ may be imported second",
        ),
        pytest.param(
            "import arviz_base, numpyro.distributions as dist; import calibrate;dist.distribution",
            id="ArviZ and NumPyro may be imported first",
        ),
    ],
)
def test_in_a_fresh_process(code):
    subprocess.run([sys.executable, "-c", code], check=True)


def test_a_wheel_stays_small_and_what_it_lacks_is_told_how_to_make(monkeypatch, tmp_path):
    """As deflated one by one, as zip does; ``make package`` measures the wheel itself."""
    away, tmp_path = tmp_path / "away", tmp_path / "shipped"
    away.mkdir()
    tmp_path.mkdir()
    files = [str(p.relative_to(ROOT)) for p in (ROOT / "src").rglob("*") if p.is_file()]
    packed = in_wheel([file for file in files if "__pycache__" not in file])
    sizes = [len(zlib.compress((ROOT / file).read_bytes())) for file in packed]
    assert 5e6 < sum(sizes) < 11.5e6  # names and headers besides
    for file in packed:
        if "/shipped/" in file:
            path = tmp_path / Path(file).relative_to("src/emulator/shipped")
            path.parent.mkdir(exist_ok=True)
            path.symlink_to(ROOT / file)
    monkeypatch.setattr("emulator.surrogates.folders.SHIPPED", tmp_path)
    here = set(emulator.shipped())
    left_out = {path.name for path in tmp_path.iterdir()} - here
    assert len(left_out) == 5
    monkeypatch.chdir(away)
    for name in left_out:
        scene, kind = name.rsplit("_", 1)
        with pytest.raises(InputError, match=f"no weights of '{name}'; make them here") as refused:
            emulator.load(scene, kind=kind)
        command = str(refused.value).partition(" minutes: calibrate ")[2].split()
        parsed = build_parser().parse_args(command)
        assert (parsed.scene, parsed.out) == (scene, name)
    shutil.copytree(ROOT / "src/emulator/shipped/twisting_cube_physics", "twisting_cube_physics")
    assert list(emulator.load("twisting_cube", kind="physics").parts) == ["polynomial"]


def test_the_emulator_never_imports_calibrate():
    for path in (ROOT / "src" / "emulator").rglob("*.py"):
        assert not re.search(r"^\s*(from|import) calibrate", path.read_text(), re.M), path


def test_no_pickle_no_batched_lapack_no_clock_seeds():
    forbidden = re.compile(
        r"import pickle|allow_pickle=True|jnp\.linalg\.(inv|det|solve)\(|seed=(int\()?time"
    )
    # The released networks are pickles; this file's unpickler admits arrays and refuses all else.
    reader = ROOT / "src" / "emulator" / "released" / "network.py"
    assert reader in SOURCES
    # What a process sends to its workers is pickled by any executor; it is never read from a file.
    engine = ROOT / "src" / "emulator" / "core" / "engine.py"
    assert not re.search(r"open\(|read_bytes|\.load\(path", engine.read_text())
    for path in SOURCES:
        if path not in (reader, engine):
            assert not forbidden.search(path.read_text()), path
    assert not re.search(r"pickle\.(load|loads|dumps?)\(|allow_pickle=True", reader.read_text())


def test_constraints_hold_names_and_versions_only():
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    pins = [line for line in lines if not line.startswith("#")]
    assert all(re.fullmatch(r"[A-Za-z0-9_.-]+==[A-Za-z0-9_.!+-]+", line) for line in pins)
    for name in ("jax", "numpyro", "sparsax", "h5py", "pytest"):
        assert any(line.startswith(f"{name}==") for line in pins)


def test_the_oldest_versions_are_those_that_pyproject_allows():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    every = [*project["dependencies"], *project["optional-dependencies"]["plot"]]
    lines = (ROOT / "constraints-oldest.txt").read_text().splitlines()
    assert {word.split(",")[0].replace(">=", "==") for word in every} <= set(lines)


@pytest.mark.skipif(shutil.which("make") is None, reason="there is no make")
@pytest.mark.parametrize(
    "target", ["test", "test-slow", "test-studies", "test-oldest", "notebooks"]
)
def test_every_target_tests_what_is_there(target):
    """A target that few people run named files that had moved."""
    commands = subprocess.run(
        ["make", "--dry-run", target], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout
    for path in re.findall(r"[ =](tests/\S+)", commands):
        assert (ROOT / path).exists(), path


def test_versions_agree():
    text = (ROOT / "pyproject.toml").read_text()
    assert f'version = "{emulator.__version__}"' in text
    assert f"version: {emulator.__version__}" in (ROOT / "CITATION.cff").read_text()


def test_a_report_without_its_extra_is_refused_in_one_line(monkeypatch, tmp_path):
    for name in [m for m in sys.modules if m.startswith("calibrate.report.")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "markupsafe", None)
    with pytest.raises(InputError, match=r"a report needs markupsafe: pip install .*\[plot\]"):
        calibrate.write_report(tmp_path)
