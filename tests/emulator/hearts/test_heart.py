"""Both ventricles from three surfaces: a generator's, with valves anywhere, and a scanner's."""

from dataclasses import replace

import numpy as np
import pytest

from cli_support import answer, complaint
from emulator.core.errors import InputError
from emulator.geometry.facets import Cavity
from emulator.geometry.generators.biventricle import biventricle
from emulator.geometry.generators.ellipsoid import HUMAN
from emulator.hearts.checks import mirrored
from emulator.hearts.heart import mesh_wall
from emulator.hearts.joints import zipped
from emulator.hearts.remeshing import Unmeshable, triangulate
from emulator.hearts.surfaces import Surface, clipped, read_surface, rim_loops, surface
from emulator.scenes.draft import draft_scene
from emulator.scenes.fibre_rules import Biventricle
from surface_support import write


def both(left, right, outer, **words):
    return mesh_wall(left, outer, right=right, **words)


SETS = ("lv_endocardium", "rv_endocardium", "epicardium")
FRAMES = range(0, 25, 2)
LID = 6.0  # mm of tissue above the cavities of a heart with valves


def needs_gmsh():
    pytest.importorskip("gmsh", reason="no gmsh here", exc_type=(ImportError, OSError))


@pytest.fixture(scope="module")
def flat():
    """Left and right endocardium and epicardium of an idealised heart, cut off at the base."""
    mesh = biventricle(rings=16, around=40)
    return [surface(name, mesh.nodes, mesh.facet_set(name)) for name in SETS]


def with_lid(cup, height, holes):
    """A cup with flat lid, so many mm above its rim, and round ``holes``: middle and radius."""
    (loop,) = rim_loops(cup)
    rim = cup.points[loop]
    points, rows = [cup.points], [cup.triangles]
    if height:
        points.append(rim + [0.0, 0.0, height])
        upper = len(cup.points) + np.arange(len(loop))
        rows.append(zipped(np.vstack(points), loop, upper))
        loop = upper
    turn = 2.0 * np.pi * np.arange(24) / 24
    circles = [
        middle + radius * np.column_stack([np.cos(turn), np.sin(turn)]) for middle, radius in holes
    ]
    flat, triangles = triangulate([rim[:, :2], *circles], 4.0)
    inner = flat[len(loop) :]
    count = sum(map(len, points))
    number = np.concatenate([loop, np.arange(count, count + len(inner))])
    level = np.full((len(inner), 1), rim[:, 2].mean() + height)
    points.append(np.hstack([inner, level]))
    return surface(cup.name, np.vstack(points), np.vstack([*rows, number[triangles]]))


def with_valves(flat, seed):
    """The idealised heart with a lid of tissue and two valves in each ventricle, anywhere in it."""
    rng = np.random.default_rng(seed)
    turn = rng.uniform(-0.5, 0.5)
    left = flat[0].points[rim_loops(flat[0])[0]]
    right = flat[1].points[rim_loops(flat[1])[0]]
    middle, reach = left[:, :2].mean(axis=0), np.ptp(left[:, 0]) / 2.0
    away = np.array([np.cos(turn), np.sin(turn)])
    holes = [
        (middle - 0.42 * reach * away, 0.4 * reach),
        (middle + 0.5 * reach * away, 0.3 * reach),
    ]
    # The right ventricle is a crescent: valves along the middle of its width.
    about = np.arctan2(*(right[:, :2] - middle).T[::-1])
    places = []
    for share, part in ((rng.uniform(0.38, 0.46), 0.4), (rng.uniform(0.66, 0.72), 0.36)):
        near = np.abs(about - about.min() - share * np.ptp(about)) < 0.15
        ways = np.linalg.norm(right[near, :2] - middle, axis=1)
        angle = about.min() + share * np.ptp(about)
        way = (ways.min() + ways.max()) / 2.0
        places.append(
            (middle + way * np.array([np.cos(angle), np.sin(angle)]), part * np.ptp(ways))
        )
    return [
        with_lid(flat[0], 0.0, holes),
        with_lid(flat[1], 0.0, places),
        with_lid(flat[2], LID, [*holes, *places]),
    ]


def test_a_heart_with_a_flat_base(flat):
    needs_gmsh()
    found = both(*flat, size=9.0)
    assert set(found.cavities) == set(SETS[:2])
    for cavity, own in found.cavities.values():
        assert cavity == pytest.approx(own, rel=0.01)
    base = found.mesh.nodes[found.mesh.node_set("base")]
    np.testing.assert_allclose(base[:, 2], HUMAN.base, atol=1e-6)
    assert found.quality.flat == 0
    assert found.quality.parts == 1
    np.testing.assert_allclose(found.axis, [0.0, 0.0, 1.0], atol=1e-6)
    fibres, _ = Biventricle((60.0, -60.0)).directions(found.mesh)
    assert np.isfinite(fibres).all()


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(20))
def test_valves_may_be_anywhere(flat, seed):
    needs_gmsh()
    surfaces = with_valves(flat, seed)
    found = both(*surfaces, size=6.0)
    sets = found.mesh.facet_sets
    assert {"mitral", "aortic", "tricuspid", "pulmonary", "base"} < set(sets)
    for name, (cavity, own) in found.cavities.items():
        assert cavity == pytest.approx(own, rel=0.03)  # the lid's edge is rounded off
        assert Cavity(found.mesh, name).rest == cavity
    assert len(sets["base"]) == sum(len(sets[n]) for n in set(sets) - {*SETS, "base"})
    assert found.wall[0] == pytest.approx(found.wall[1], rel=0.02)
    assert found.quality.flat == 0


def moved(each, shift):
    return Surface(each.name, each.points + shift, each.triangles)


def holed(each, place, radius=6.0):
    return clipped(each, radius - np.linalg.norm(each.points - place, axis=1))


def closed_cup(each):
    return surface(each.name, each.points, biventricle(rings=8, around=16).surface)


def doubled(each):
    points = np.vstack([each.points, each.points + 300.0])
    return [points, np.vstack([each.triangles, each.triangles + len(each.points)])]


def bad(flat):
    """Three surfaces that are no heart, words, and what is said."""
    left, right, outer = flat
    apex = left.points[np.argmin(left.points[:, 2])]
    outside = outer.points[np.argmin(outer.points[:, 2])]
    yield (outer, right, left), {}, "lv_endocardium and epicardium are swapped"
    yield (left, left, outer), {}, "are one surface; give one of each wall"
    yield (left, right, left), {}, "are one surface; give one of each wall"
    yield (left, moved(left, 0.0), outer), {}, "are one surface; give one of each wall"
    yield (holed(left, apex), right, outer), {}, "no opening of the epicardium is at its opening"
    yield (left, right, holed(outer, outside)), {}, "neither endocardium has an opening at that"
    twice = holed(holed(left, apex), left.points[len(left.points) // 2])
    yield (twice, right, outer), {}, "it has 3 openings, the smallest of"
    yield (left, moved(right, [-12.0, 0.0, 0.0]), outer), {}, "crosses"
    yield (moved(left, [0.0, 14.0, 0.0]), right, outer), {}, "crosses"
    yield (moved(left, 400.0), right, outer), {}, "lv_endocardium lies outside of epicardium"
    small = [Surface(e.name, e.points / 1000.0, e.triangles) for e in flat]
    yield small, {}, "mm from corner to corner, lengths being taken as mm"
    yield flat, {"unit": "feet"}, "unit 'feet'"
    yield flat, {"size": 80.0}, "below a quarter of the epicardium's"
    yield flat, {"order": 3}, "order 3: expected 1 or 2"
    yield flat, {"least": 0.0}, "above 0 mm"


@pytest.mark.parametrize("number", range(15))
def test_what_is_no_heart_is_refused(flat, number):
    surfaces, words, said = list(bad(flat))[number]
    named = [
        Surface(name, each.points, each.triangles)
        for name, each in zip(SETS, surfaces, strict=True)
    ]
    with pytest.raises(InputError, match=said):
        both(*named, **words)


def test_openings_that_touch_are_refused(flat):
    left, right, outer = flat
    at = int(np.argmin(left.points[:, 2]))
    ring = np.flatnonzero((left.triangles == at).any(axis=1))
    rows = np.delete(left.triangles, ring[[0, len(ring) // 2]], axis=0)
    with pytest.raises(InputError, match="two of its openings touch at"):
        both(replace(left, triangles=rows), right, outer)


def test_rims_that_cross_are_not_given_to_gmsh():
    turn = 2.0 * np.pi * np.arange(12) / 12
    circle = np.column_stack([np.cos(turn), np.sin(turn)])
    for inner, said in ((8.0 * circle + [15.0, 0.0], "cross"), (circle + 40.0, "outside")):
        with pytest.raises(Unmeshable, match=said):
            triangulate([20.0 * circle, inner], 3.0)


def test_by_the_command_line_to_a_scene(flat, tmp_path, capsys):
    needs_gmsh()
    from calibrate.cli import main

    files = [
        str(write(tmp_path / f"{each.name}.stl", each.points[each.triangles])) for each in flat
    ]
    out = str(tmp_path / "heart.vtu")
    words = ["mesh", "--endocardium", files[0], "--right", files[1], "--epicardium", files[2]]
    assert main([*words, "--out", out, "--size", "11"]) == 0
    assert "cavity of rv_endocardium" in capsys.readouterr().out
    draft = draft_scene(out, tmp_path / "heart.toml")
    assert draft.scene.parameter_names[-2:] == ("pressure", "right_pressure")
    assert 'rule = "biventricle"' in draft.path.read_text()
    assert main([*words, "--out", out, "--size", "11", "--base-height", "10"]) == 0
    assert "above the base plane" in capsys.readouterr().out
    one = ["mesh", "--endocardium", files[0], "--epicardium", files[2], "--out", out]
    assert "give the right ventricle's" in complaint(capsys, *one, "--ventricles", "left")
    swapped = ["mesh", "--endocardium", files[2], "--right", files[1], "--epicardium", files[0]]
    assert "are swapped" in complaint(capsys, *swapped, "--out", out)


@pytest.mark.slow
def test_every_frame_of_a_real_heart_is_meshed(measured):
    needs_gmsh()
    folder = measured / "human_heart"
    walls = []
    for frame in FRAMES:
        files = (f"{n}_{frame:03d}.obj" for n in ("LV_ENDOCARDIAL", "RV_ENDOCARDIAL", "EPICARDIAL"))
        found = both(*(folder / name for name in files))
        for cavity, own in found.cavities.values():
            assert cavity == pytest.approx(own, rel=6e-3)
        assert found.wall[0] == pytest.approx(found.wall[1], abs=2.0)  # mL, of thin walls and rims
        assert found.shift < 1.5
        assert found.quality.angle > 3.0
        assert found.quality.parts == 1
        walls.append(found.wall[0])
    # Muscle keeps its volume; the surfaces were fitted to images, each frame by itself.
    assert np.ptp(walls) < 0.25 * np.mean(walls)


def test_two_endocardia_that_are_swapped_are_refused(flat, tmp_path, capsys):
    left, right, outer = (
        write(tmp_path / f"{each.name}.stl", each.points[each.triangles]) for each in flat
    )
    words = ["mesh", "--endocardium", right, "--right", left, "--epicardium", outer]
    for more in ([], ["--ventricles", "left"]):
        line = complaint(capsys, *map(str, [*words, *more, "--out", tmp_path / "heart.vtu"]))
        assert (
            "lv_endocardium and rv_endocardium are swapped: the left ventricle is the round" in line
        )


LEFT, RIGHT, OUTSIDE = "LV_ENDOCARDIAL", "RV_ENDOCARDIAL", "EPICARDIAL"
MIXED_UP = [
    ((LEFT, LEFT, OUTSIDE), "lv_endocardium and rv_endocardium are one surface; give one of each"),
    ((LEFT, OUTSIDE, OUTSIDE), "rv_endocardium and epicardium are one surface; give one of each"),
    ((OUTSIDE, RIGHT, LEFT), "lv_endocardium and epicardium are swapped: the latter lies within"),
    ((LEFT, OUTSIDE, RIGHT), "rv_endocardium and epicardium are swapped: the latter lies within"),
    ((OUTSIDE, None, LEFT), "endocardium and epicardium are swapped: the latter lies within"),
]


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("more", [[], ["--ventricles", "left"]])
@pytest.mark.parametrize(("names", "said"), MIXED_UP)
def test_walls_that_are_mixed_up_are_named(names, said, more, measured, tmp_path, capsys):
    words = ["mesh", "--out", tmp_path / "heart.vtu"]
    for option, name in zip(("--endocardium", "--right", "--epicardium"), names, strict=True):
        words += [option, measured / "human_heart" / f"{name}_000.obj"] if name else []
    assert complaint(capsys, *words, *(more if names[1] else [])).startswith(f"calibrate: {said}")


def scaled(folder, each, factor):
    return write(folder / f"{each.name}.stl", factor * each.points[each.triangles])


def test_centimetres_and_metres_are_asked_about(flat, tmp_path, capsys):
    needs_gmsh()
    options = "--endocardium", "--right", "--epicardium"

    def words(*factors):
        files = [scaled(tmp_path, *of) for of in zip(flat, factors, strict=True)]
        pairs = zip(options, files, strict=True)
        return ["mesh", "--out", tmp_path / "heart.vtu", *(w for pair in pairs for w in pair)]

    line = complaint(capsys, *words(0.001, 0.001, 0.001))
    assert line.endswith("lengths being taken as mm: give the file's own --unit, m")
    line = complaint(capsys, *words(1.0, 0.1, 1.0))
    assert "rv_endocardium is " in line
    assert "give surfaces of one heart, in one unit" in line
    # What is meshed in millimetres is meshed in centimetres, too, its walls no thicker, and asked.
    code, large = answer(capsys, *words(1.0, 1.0, 1.0))
    code, small = answer(capsys, *words(0.1, 0.1, 0.1))
    assert code == 0
    assert any("as a mouse's or a rat's: if" in line for line in small["warnings"])
    assert large["warnings"] == []
    assert 1000.0 * small["wall"]["mesh"] == pytest.approx(large["wall"]["mesh"], rel=0.02)


def test_valves_tell_a_mirrored_heart(measured):
    folder = measured / "human_heart"
    for frame in FRAMES:
        surfaces = [
            read_surface(folder / f"{name}_{frame:03d}.obj", name)
            for name in ("LV_ENDOCARDIAL", "RV_ENDOCARDIAL", "EPICARDIAL")
        ]
        assert not list(mirrored(surfaces))
        turned = [surface(s.name, s.points * [-1.0, 1.0, 1.0], s.triangles) for s in surfaces]
        (line,) = mirrored(turned)
        assert "as in a mirrored heart, whose fibres by rule have the wrong hand" in line


def test_a_mirrored_heart_is_questioned_by_the_command(measured, tmp_path, capsys):
    needs_gmsh()
    words = ["mesh", "--out", tmp_path / "heart.vtu"]
    for option, name in (
        ("--endocardium", "LV_ENDOCARDIAL"),
        ("--right", "RV_ENDOCARDIAL"),
        ("--epicardium", "EPICARDIAL"),
    ):
        original = read_surface(measured / "human_heart" / f"{name}_018.obj", name)
        mirror = original.points * [1.0, -1.0, 1.0]
        words += [option, write(tmp_path / f"{name}.stl", mirror[original.triangles])]
    code, told = answer(capsys, *words)
    assert code == 0
    assert ["mirrored heart" in line for line in told["warnings"]] == [True]
