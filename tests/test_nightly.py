"""The table of the tiers is written by their runs."""

from datetime import date

from nightly import PAGE, outcome, tiers, with_outcome

DAY = date(2026, 11, 29)


def test_each_tier_of_the_page_has_a_command():
    commands = tiers(PAGE.read_text(encoding="utf-8"))
    assert commands["fast"] == "make test"
    assert {"lint", "slow", "package", "docs", "notebooks", "benchmarks"} <= commands.keys()


def test_a_run_fills_its_row_alone():
    page = "| tier | command | covers | last |\n|---|---|---|---|\n| a | `make a` | x | |\n| b | `b` | y | old |\n"
    assert tiers(page) == {"a": "make a", "b": "b"}
    after = with_outcome(page, "b", "new")
    assert after == page.replace("old", "new")


def test_a_failure_is_written_as_one():
    output = "...\n3 failed, 20 passed, 1 skipped in 12.3s\n2 passed in 1.0s\n"
    cell = outcome(1, output, 150.0, DAY)
    assert cell == "29 November 2026: FAILED, 3 failed, 20 passed, 1 skipped; 2 passed, 2 min"
    assert outcome(0, "All checks passed!", 61.0, DAY) == "29 November 2026: passed, 1 min"
