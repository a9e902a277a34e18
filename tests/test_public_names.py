"""A public name changes only with notice (``python -m tests.public_names`` rewrites the file)."""

import pytest

from ceilings import front_doors
from public_names import FILE, arguments_of, as_text, breaks, problems, public_names, read


def test_the_file_has_today_s_names_and_arguments():
    assert sorted(problems(read(FILE.read_text(encoding="utf-8")), public_names())) == []


def test_the_file_has_every_name_that_the_ceilings_count():
    packages = {"em": "emulator", "cal": "calibrate"}
    counted = {
        f"{packages[head]}{dot}{rest}.{name}"
        for door, names in front_doors().items()
        for head, dot, rest in [door.partition(".")]
        for name in names
    }
    assert counted == public_names().keys()


def test_arguments_are_read_as_they_are_written():
    names = public_names()
    assert read(as_text(names)) == names
    assert names["emulator.laws"] == names["calibrate.OBSERVATIONS"] == ""
    assert arguments_of(lambda a, b=1, *, c, d=2, **e: None) == "(a, b=, *, c, d=, **e)"
    assert arguments_of(lambda *a, b: None) == "(*a, b)"
    assert names["calibrate.GaussianNoise"].startswith("(sd")


def test_a_name_that_is_gone_is_told_how_to_go_and_a_new_one_what_to_run():
    (gone,) = problems({"emulator.load": "(name)"}, {})
    assert gone.startswith("emulator.load is gone or renamed: keep it for one release")
    assert "CONTRIBUTING.md" in gone
    assert [*problems({}, {"emulator.store": "()"})] == [
        "emulator.store is new: python -m tests.public_names"
    ]
    (changed,) = problems({"emulator.load": "(name, kind)"}, {"emulator.load": "(name, sort)"})
    assert "which breaks calls: keep" in changed
    (wider,) = problems({"emulator.load": "(name)"}, {"emulator.load": "(name, *, kind=)"})
    assert wider.endswith(": python -m tests.public_names")


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("(a, b)", "(a, b)", False),
        ("(a)", "(a, b=)", False),
        ("(a)", "(a, *, b=)", False),
        ("(a, *, b)", "(a, b)", False),
        ("(a)", "(a=)", False),
        ("(a)", "(a, b)", True),
        ("(a)", "(a, *, b)", True),
        ("(a, b)", "(b, a)", True),
        ("(a, b)", "(a, *, b)", True),
        ("(a=)", "(a)", True),
        ("(a, **b)", "(a)", True),
        ("(a, *, b=)", "(a)", True),
    ],
)
def test_which_arguments_break_calls(old, new, expected):
    assert breaks(old, new) is expected
