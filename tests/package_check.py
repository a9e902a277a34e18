"""Wheel and sdist away from the repository: ``python tests/package_check.py DIST``, by ``make package``.

The wheel is installed into a new environment, with the versions of ``constraints.txt`` and none of
the extras, and used from another folder: the demo, and README's example in Python. The tests of the
package itself then run from the unpacked sdist, and with the extra ``plot`` a report is made.
Nothing may come from the checkout.
"""

import fnmatch
import os
import re
import subprocess
import sys
import tarfile
import tempfile
import tomllib
import venv
import zipfile
from pathlib import Path
from time import perf_counter

ROOT = Path(__file__).resolve().parents[1]
LARGEST = 12e6  # bytes of a wheel
IMPORTS = """
import importlib, pkgutil, sys
import calibrate, emulator
for package in (emulator, calibrate):
    # A package that lacks its extra is judged below; without onerror the walk would raise as well.
    modules = pkgutil.walk_packages(package.__path__, package.__name__ + ".", onerror=lambda _: None)
    for module in modules:
        try:
            importlib.import_module(module.name)
        except ModuleNotFoundError as error:  # of the extra "plot"
            assert error.name in ("plotly", "matplotlib", "jinja2", "markupsafe"), error
        except emulator.core.errors.InputError as error:  # of another extra, which it names
            assert "pip install 'soft-tissue-calibrate[" in str(error), error
from emulator.surrogates.folders import shipped
for name in shipped():
    emulator.load(name)
files = [getattr(module, "__file__", None) or "" for module in sys.modules.values()]
assert not [file for file in files if file.startswith(sys.argv[1])]
print(f"{len(files)} modules, {len(shipped())} emulators, none of the checkout")
"""


def main(dist: Path) -> None:
    """Check the one wheel and the one sdist in ``dist``."""
    (wheel,), (sdist,) = dist.glob("*.whl"), dist.glob("*.tar.gz")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with tarfile.open(sdist) as archive:
            archive.extractall(folder, filter="data")
        source = folder / sdist.name.removesuffix(".tar.gz")
        check_contents(wheel, source)
        python = environment(folder / "bare", wheel)
        use_wheel(python, folder / "away")
        test_sdist(python, source)
        install(python, f"{wheel}[plot]")
        run([python.with_name("calibrate"), "report", "posterior"], folder / "away")
    print("wheel and sdist work away from the repository")


def check_contents(wheel: Path, source: Path) -> None:
    """All that is tracked is in the sdist, and all of ``src`` in the wheel but what is left out."""
    tracked = subprocess.check_output(["git", "ls-files"], cwd=ROOT, text=True).splitlines()
    private = (".ci/", ".pre-commit", ".python-version")
    absent = [f for f in tracked if not (source / f).is_file() and not f.startswith(private)]
    assert not absent, f"not in the sdist: {absent}"
    packed = set(zipfile.ZipFile(wheel).namelist())
    different = {f.removeprefix("src/") for f in in_wheel(tracked)} ^ {
        f for f in packed if ".dist-info/" not in f
    }
    assert not different, f"in the wheel or the repository alone: {different}"
    size = wheel.stat().st_size
    assert size < LARGEST, f"the wheel has {size / 1e6:.1f} MB"
    print(f"sdist and wheel hold what they should, the wheel {len(packed)} files, {size / 1e6} MB")


def in_wheel(tracked: list[str]) -> list[str]:
    """The files of ``src`` that a wheel holds: all but those that pyproject.toml leaves out."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    excluded = project["tool"]["hatch"]["build"]["targets"]["wheel"]["exclude"]
    return [
        file
        for file in tracked
        if file.startswith("src/") and not any(fnmatch.fnmatch(file, one) for one in excluded)
    ]


def environment(folder: Path, wheel: Path) -> Path:
    """The interpreter of a new environment with the wheel in it."""
    venv.create(folder, with_pip=True)
    python = folder / "bin" / "python"
    install(python, str(wheel))
    return python


def install(python: Path, package: str) -> None:
    """Install into the environment of ``python``, at the versions that are known to work."""
    words = ["-m", "pip", "install", "--quiet", "--constraint", str(ROOT / "constraints.txt")]
    began = perf_counter()
    subprocess.run([python, *words, package], check=True)
    print(f"installed in {perf_counter() - began:.0f} s", flush=True)


def use_wheel(python: Path, away: Path) -> None:
    """What a newcomer does first, in the empty folder ``away``."""
    away.mkdir()
    calibrate = python.with_name("calibrate")
    run([calibrate, "--version"], away)
    run([calibrate, "scenes"], away)
    run([calibrate, "demo", "--out", "posterior"], away)
    assert {path.name for path in (away / "posterior").iterdir()} >= {"posterior.nc", "run.json"}
    run([python, "-c", IMPORTS, str(ROOT)], away)
    example = re.search(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    run([python, "-c", example[1]], away)


def test_sdist(python: Path, source: Path) -> None:
    """Tests of the package as a whole, from the unpacked sdist, on the installed wheel."""
    install(python, "pytest")
    tests = ["tests/test_package.py", "tests/test_architecture.py"]
    run([python, "-m", "pytest", "-m", "not slow", *tests], source)


def run(command: list[str | Path], folder: Path) -> None:
    """Run a command in ``folder`` that knows nothing of this process's environment."""
    print("$", *(word if "\n" not in str(word) else "..." for word in command[:4]), flush=True)
    kept = {name: os.environ[name] for name in ("PATH", "HOME", "LANG") if name in os.environ}
    began = perf_counter()
    subprocess.run(command, cwd=folder, env=kept, check=True)
    print(f"  {perf_counter() - began:.0f} s", flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
