"""Compiled programs are kept between commands, and never stand in a command's way."""

import os
import subprocess
import sys

import jax
import pytest

from calibrate.cli import _prune, keep_programs, program_folder

CALL = "import sys; from calibrate.cli import main; sys.exit(main(sys.argv[1:]))"
WORDS = ("simulate", "once_clamped_beam", "--theta", "mu=70", "lam=80", "--json")


def calibrate(*words, **variables):
    """A command in a process of its own, in which nobody has chosen JAX's cache."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith("JAX_COMPILATION")}
    return subprocess.run(
        [sys.executable, "-c", CALL, *words],
        env=environment | variables, capture_output=True, text=True, check=False,
    )  # fmt: skip


def files(folder):
    return [path for path in folder.rglob("*-cache") if path.is_file()]


def test_the_folder_is_the_user_s_and_the_machine_s(tmp_path):
    chosen = program_folder({"CALIBRATE_CACHE": str(tmp_path)})
    assert chosen.parent == tmp_path
    assert jax.__version__ in chosen.name
    assert program_folder({"XDG_CACHE_HOME": "/c"}).parent.as_posix() == "/c/calibrate"
    assert program_folder({}).parent.name == "calibrate"
    assert program_folder({"CALIBRATE_CACHE": ""}) is None


def test_a_cache_that_was_chosen_is_left_alone(tmp_path):
    """As by the tests' own."""
    assert jax.config.jax_compilation_cache_dir is not None
    assert keep_programs({"CALIBRATE_CACHE": str(tmp_path)}) is None
    assert not any(tmp_path.iterdir())


@pytest.mark.slow
def test_programs_are_kept_and_damaged_ones_compiled_again(tmp_path):
    first = calibrate(*WORDS, CALIBRATE_CACHE=str(tmp_path / "kept"))
    assert first.returncode == 0, first.stderr
    kept = files(tmp_path)
    assert kept
    for path in kept:
        path.write_bytes(path.read_bytes()[:100])
    again = calibrate(*WORDS, CALIBRATE_CACHE=str(tmp_path / "kept"))
    assert again.returncode == 0
    assert again.stdout == first.stdout
    assert "Traceback" not in again.stderr


@pytest.mark.parametrize("way", ["variable", "option"])
def test_nothing_is_kept_on_request(tmp_path, way):
    option = ("--no-cache",) if way == "option" else ()
    variable = {"CALIBRATE_CACHE": "" if way == "variable" else str(tmp_path)}
    home = {"XDG_CACHE_HOME": str(tmp_path)}
    done = calibrate(*option, "scenes", **variable, **home)
    assert done.returncode == 0, done.stderr
    assert not any(tmp_path.iterdir())


def test_a_folder_that_cannot_be_is_said_and_does_no_harm(tmp_path):
    (tmp_path / "file").write_text("")
    done = calibrate("scenes", CALIBRATE_CACHE=str(tmp_path / "file" / "in"))
    assert done.returncode == 0
    assert "compiled programs are not kept" in done.stderr
    assert len(done.stderr.splitlines()) == 1


def test_programs_used_longest_ago_are_deleted(tmp_path, monkeypatch):
    monkeypatch.setattr("calibrate.cli.LARGEST", 250)
    for age, name in enumerate(("new-cache", "used-cache", "old-cache", "oldest-cache")):
        path = tmp_path / name
        path.write_bytes(bytes(100))
        os.utime(path, (1e9 - age, 1e9 - age))
    os.utime(tmp_path / "used-cache", (2e9, 1e9))
    _prune(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"new-cache", "used-cache"}
