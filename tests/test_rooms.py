"""The core does its journey without the rooms, each of them and all at once."""

import subprocess
import sys
from pathlib import Path

import pytest

from rooms import NEIGHBOURS, ROOMS, reaching

ON_CALL = (
    "calibrate.cli.commands.",  # a command is of one call
    "calibrate.project.experiment",  # a file with members of a population
    "emulator.catalogue",  # a scene's name that begins with `published:`
)
"""Modules of the core that import a room when they are called with something of it."""


def test_the_core_is_imported_without_a_room():
    assert not [way for way in reaching(on_import=True) if way[0] == "core"]


def test_the_core_calls_rooms_from_few_places():
    assert not [way for way in reaching() if way[0] == "core" and not way[1].startswith(ON_CALL)]


def test_rooms_reach_into_the_rooms_they_name():
    assert {(h, there) for h, _, there, _ in reaching() if h != "core"} == {
        (room, other) for room, others in NEIGHBOURS.items() for other in others
    }


def journey(tmp_path, *rooms, demo):
    """Run the core's journey in a process in which these rooms' modules cannot be imported."""
    script = Path(__file__).with_name("without_rooms.py")
    words = [sys.executable, str(script), str(tmp_path), "--demo" if demo else "--short", *rooms]
    process = subprocess.run(words, capture_output=True, text=True, timeout=600, check=False)
    assert process.returncode == 0, process.stdout + process.stderr
    return process.stdout


def test_data_becomes_a_posterior_without_any_room(tmp_path):
    out = journey(tmp_path, *ROOMS, demo=False)
    assert "calibrate: this needs the room 'calibrate.report', which is not installed" in out


@pytest.mark.slow
@pytest.mark.parametrize("room", ROOMS)
def test_demo_infer_and_certify_without_a_room(room, tmp_path):
    journey(tmp_path, room, demo=True)
