"""A reader does not go through more files than today (``python -m tests.journeys`` lists them)."""

import pytest

from journeys import JOURNEYS

LONG = {"calibrate infer to the likelihood", "calibrate certify to Simulator.solve"}
"""Journeys that go through a whole calibration."""


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.slow if n in LONG else ()) for n in JOURNEYS]
)
def test_a_journey_enters_few_files(name):
    most, travel = JOURNEYS[name]
    way = travel()
    assert way.frames
    assert len(way.files) <= most, "\n".join(way.files)
