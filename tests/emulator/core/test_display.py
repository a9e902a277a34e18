"""Long work without a terminal prints a line now and then and its stages, short work none."""

import io

import pytest

from emulator.core import display


@pytest.fixture
def clock(monkeypatch):
    """Seconds that the test sets."""
    now = [0.0]
    monkeypatch.setattr("tqdm.std.time", lambda: now[0])
    return now


def lines(clock, each, count, **options):
    said = io.StringIO()
    with display.Lines(total=count, desc="FEM", unit="run", file=said, **options) as bar:
        for _ in range(count):
            clock[0] += each
            bar.update()
    return said.getvalue().splitlines()


def test_a_line_every_ten_seconds_and_one_at_the_end(clock):
    said = lines(clock, 4.0, 8)
    assert said == [
        "FEM: 3 of 8 runs, 12 s, 20 s left",
        "FEM: 6 of 8 runs, 24 s, 8 s left",
        "FEM: 8 of 8 runs, 32 s",
    ]


def test_short_work_and_what_is_disabled_say_nothing(clock):
    assert lines(clock, 1.0, 8) == []
    assert lines(clock, 100.0, 8, disable=True) == []


def test_an_iterable_and_a_postfix(clock):
    said = io.StringIO()
    bar = display.Lines(range(3), file=said)
    for k in bar:
        clock[0] += 20.0
        bar.set_postfix(loss=f"{k}")
    assert said.getvalue().splitlines()[-1] == "done: 3 of 3, 60 s, loss=2"


def test_stages_say_their_seconds_if_they_took_ten(monkeypatch, capsys):
    now = [0.0]
    monkeypatch.setattr("time.perf_counter", lambda: now[0])
    stages = display.Stages(show=True)
    for name, seconds in (("data", 0.5), ("sampling", 15.5)):
        with stages(name):
            now[0] += seconds
    assert stages.seconds == {"data": 0.5, "sampling": 15.5}
    assert capsys.readouterr().err == "sampling: 15.5 s\n"
    silent = display.Stages(show=False)
    with silent("sampling"):
        now[0] += 9.0
    assert silent.seconds == {"sampling": 9.0}
    assert capsys.readouterr().err == ""
