"""What bash itself completes with the script that calibrate prints."""

import shutil
import subprocess

import pytest

from calibrate.cli import COMMANDS, build_parser

ASK = """
source "$1"; shift
COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1))
_shtab_calibrate
printf '%s\\n' "${COMPREPLY[@]}"
"""
pytestmark = pytest.mark.slow


def completion(shell):
    arguments = build_parser("completion").parse_args(["completion", shell])
    return arguments.run(arguments).text


@pytest.fixture(scope="module")
def ask(tmp_path_factory):
    """Words that bash offers for the last of some words, in a folder with one scene file."""
    bash = shutil.which("bash")
    if bash is None:
        pytest.skip("no bash here")
    folder = tmp_path_factory.mktemp("completion")
    (folder / "script").write_text(completion("bash"))
    (folder / "ventricle.toml").touch()

    def words(*typed):
        command = [bash, "-c", ASK, "bash", "./script", "calibrate", *typed]
        found = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True)
        return set(found.stdout.split())

    return words


def test_commands(ask):
    assert ask("") == set(COMMANDS)
    assert ask("si") == {"simulate"}
    assert ask("check", "") == {"sbc", "prior", "mesh"}


def test_scenes_and_scene_files(ask):
    assert ask("simulate", "once") == {"once_clamped_beam"}
    assert ask("simulate", "vent") == {"ventricle.toml"}
    assert ask("check", "sbc", "twice") == {"twice_clamped_beam"}


def test_emulators_samplers_recipes_and_options(ask):
    assert ask("evaluate", "liver") == {"liver", "liver_physics", "liver_series"}
    assert ask("infer", "liver", "--sampler", "s") == {"smc"}
    assert ask("train", "--recipe", "m") == {"mechanics"}
    assert ask("infer", "--noise") == {"--noise", "--noise-scale"}


@pytest.mark.parametrize("shell", ["zsh", "fish"])
def test_other_shells(shell, tmp_path):
    """Each has every command, and is a script that the shell itself can read, where it is there."""
    script = completion(shell)
    assert all(name in script for name in COMMANDS)
    assert "blackjax_nuts" in script
    assert "twice_clamped_beam" in script
    if found := shutil.which(shell):
        (tmp_path / "script").write_text(script)
        subprocess.run([found, "-n", tmp_path / "script"], check=True)
