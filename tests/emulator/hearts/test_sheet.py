"""Sheets from outlines: sets, volumes, pads, regions, and outlines that cannot be."""

import numpy as np
import pytest

from emulator.core.errors import InputError
from emulator.geometry.discretisation import discretise
from emulator.hearts.sheet import mesh_sheet, regions_within


def rectangle(left, right, low, high):
    return np.array([[left, low], [right, low], [right, high], [left, high]])


AROUND = rectangle(0.0, 60.0, 0.0, 40.0)
PADS = {"moving": rectangle(10.0, 18.0, 16.0, 24.0), "fixed": rectangle(40.0, 48.0, 16.0, 24.0)}


@pytest.fixture(scope="module")
def sheet():
    pytest.importorskip("gmsh")
    return mesh_sheet(AROUND, 2.0, size=2.0, pads=PADS)


def area(mesh, facet_set):
    corners = mesh.nodes[mesh.facet_set(facet_set)[:, :3]]
    sides = corners[:, 1:] - corners[:, :1]
    return 0.5 * np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1).sum()


def test_it_has_the_volume_and_the_sets_of_its_outlines(sheet):
    assert sheet.order == 2
    assert discretise(sheet).weights.sum() == pytest.approx(60.0 * 40.0 * 2.0, rel=1e-12)
    assert area(sheet, "top") == pytest.approx(2400.0, rel=1e-12)
    np.testing.assert_allclose(sheet.nodes[sheet.node_set("top")][:, 2], 2.0)
    np.testing.assert_allclose(sheet.nodes[sheet.node_set("bottom")][:, 2], 0.0)
    x, y, _ = sheet.nodes[sheet.node_set("edge")].T
    assert np.all(np.isclose(x % 60.0, 0.0) | np.isclose(y % 40.0, 0.0))


@pytest.mark.parametrize("name", PADS)
def test_a_pad_is_what_lies_under_it_at_the_top(sheet, name):
    places = sheet.nodes[sheet.node_set(name)]
    np.testing.assert_allclose(places[:, 2], 2.0)
    low, high = PADS[name].min(axis=0), PADS[name].max(axis=0)
    np.testing.assert_allclose(places[:, :2].min(axis=0), low, atol=1e-9)
    np.testing.assert_allclose(places[:, :2].max(axis=0), high, atol=1e-9)
    top = sheet.nodes[sheet.node_set("top")][:, :2]
    within = ((top >= low - 1e-9) & (top <= high + 1e-9)).all(axis=1)
    assert within.sum() == len(places)


def test_edges_are_fine_between_the_pads_and_coarse_far_away(sheet):
    corners = sheet.nodes[sheet.facet_set("bottom")[:, :3]]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    x, y = corners.mean(axis=1)[:, 0], corners.mean(axis=1)[:, 1]
    between = (x > 18.0) & (x < 40.0) & (np.abs(y - 20.0) < 4.0)
    assert longest[between].max() < 3.5
    assert longest.max() > 4.0


def test_the_last_region_counts_where_two_overlap(sheet):
    scar, core = rectangle(15.0, 45.0, 10.0, 30.0), rectangle(25.0, 35.0, 15.0, 25.0)
    regions = regions_within(sheet, {1: scar, 4: core[::-1]})
    assert set(np.unique(regions)) == {0, 1, 4}
    volumes = discretise(sheet).weights.sum(axis=1)
    assert volumes[regions > 0].sum() == pytest.approx(600.0 * 2.0, rel=0.1)
    middles = sheet.nodes[sheet.corners].mean(axis=1)
    inside = (np.abs(middles[:, 0] - 30.0) < 5.0) & (np.abs(middles[:, 1] - 20.0) < 5.0)
    np.testing.assert_array_equal(regions == 4, inside)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"thickness": 0.0}, "thickness 0.0 mm"),
        ({"size": -1.0}, "edges of -1.0 mm"),
        ({"pads": {}}, "one pad or more"),
        ({"pads": {"top": PADS["fixed"]}}, "not called edge"),
        ({"pads": {"a": np.zeros((4, 2))}}, "no area"),
        ({"pads": {"a": np.zeros((4, 3))}}, "corners \\(k, 2\\)"),
        ({"pads": {"a": rectangle(50.0, 70.0, 10.0, 20.0)}}, "cross"),
        ({"pads": {"a": rectangle(70.0, 80.0, 10.0, 20.0)}}, "outside"),
    ],
)
def test_outlines_that_cannot_be_are_refused_in_a_line(changes, words):
    if words in ("cross", "outside"):
        pytest.importorskip("gmsh")
    entries = {"thickness": 2.0, "size": 2.0, "pads": PADS, **changes}
    with pytest.raises(InputError, match=words) as error:
        mesh_sheet(AROUND, entries.pop("thickness"), **entries)
    assert "\n" not in str(error.value)


def test_a_region_in_another_unit_is_refused(sheet):
    with pytest.raises(InputError, match="no element lies in region 1"):
        regions_within(sheet, {1: 1e3 * rectangle(15.0, 45.0, 10.0, 30.0)})
