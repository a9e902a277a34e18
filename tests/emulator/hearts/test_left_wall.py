"""The left wall cut from a heart of two ventricles: a generator's, and a scanner's."""

import numpy as np
import pytest

from cli_support import complaint
from emulator.core.errors import InputError
from emulator.geometry.generators.biventricle import biventricle
from emulator.geometry.generators.ellipsoid import HUMAN
from emulator.hearts.heart import mesh_wall
from emulator.hearts.left_wall import left_wall
from emulator.hearts.surfaces import Surface, read_surface, surface
from surface_support import write

NAMES = {"endocardium": "lv_endocardium", "epicardium": "epicardium", "right": "rv_endocardium"}
FRAMES = range(0, 25, 2)


@pytest.fixture(scope="module")
def surfaces():
    """Left endocardium, epicardium and right endocardium of an idealised heart."""
    mesh = biventricle(rings=20, around=48)
    return [surface(name, mesh.nodes, mesh.facet_set(of)) for name, of in NAMES.items()]


def test_the_outside_is_the_ellipsoid_that_the_left_ventricle_was_made_from(surfaces):
    found = left_wall(*surfaces)
    np.testing.assert_allclose(found.axis, [0.0, 0.0, 1.0], atol=1e-6)
    assert found.height == pytest.approx(HUMAN.base)
    x, y, z = found.outside.points.T
    short, long = HUMAN.short_epicardium, HUMAN.long_epicardium
    below = z < 0.8 * HUMAN.base  # at the base normals of the inner surface point above it
    level = np.sqrt((x**2 + y**2) / short**2 + (z / long) ** 2)[below]
    np.testing.assert_allclose(level, 1.0, atol=0.025)  # 0.8 mm
    volume = (found.outside.volume - surfaces[0].volume) / 1000.0
    assert volume == pytest.approx(HUMAN.volume / 1000.0, rel=0.03)


def test_surfaces_of_no_one_heart_are_refused(surfaces):
    endocardium, epicardium, right = surfaces
    far = Surface("epicardium", epicardium.points + 500.0, epicardium.triangles)
    away = Surface("right", right.points + 500.0, right.triangles)
    with pytest.raises(InputError, match="of one heart, in one unit"):
        left_wall(endocardium, far, away)
    ball = biventricle(rings=8, around=16)
    closed = surface("endocardium", ball.nodes, ball.surface)
    with pytest.raises(InputError, match="it is closed"):
        left_wall(closed, epicardium, right)


def test_by_the_command_line(surfaces, tmp_path, capsys):
    pytest.importorskip("gmsh", reason="no gmsh here", exc_type=(ImportError, OSError))
    from calibrate.cli import main

    files = [
        str(write(tmp_path / f"{name}.stl", each.points[each.triangles]))
        for name, each in zip(NAMES, surfaces, strict=True)
    ]
    words = ["mesh", "--endocardium", files[0], "--epicardium", files[1], "--out"]
    out = str(tmp_path / "lv.vtu")
    assert main([*words, out, "--right", files[2], "--ventricles", "left", "--size", "12"]) == 0
    assert "over the wall 0.7" in capsys.readouterr().out
    assert "does not exist" in complaint(capsys, *words, out, "--right", "nowhere.stl")


@pytest.mark.slow
def test_every_frame_of_a_real_heart_is_meshed(measured):
    pytest.importorskip("gmsh", reason="no gmsh here", exc_type=(ImportError, OSError))
    folder, walls = measured / "human_heart", []
    for frame in FRAMES:
        inner, outer, right = (
            folder / f"{name}_{frame:03d}.obj"
            for name in ("LV_ENDOCARDIAL", "EPICARDIAL", "RV_ENDOCARDIAL")
        )
        found = mesh_wall(inner, outer, right=right, ventricles="left")
        own = read_surface(inner, "endocardium").volume / 1000.0
        assert (
            0.75 * own < found.cavities["endocardium"][0] < own
        )  # the rest is above the base plane
        assert found.cavities["endocardium"][0] == pytest.approx(
            found.cavities["endocardium"][1], rel=5e-3
        )
        assert found.thickness.least > 2.5
        assert found.quality.angle > 8.0
        assert found.warnings == ()
        walls.append(found.wall[0])
    # Muscle keeps its volume over the cycle, what the base plane cuts off apart.
    assert np.ptp(walls) < 0.2 * np.mean(walls)
