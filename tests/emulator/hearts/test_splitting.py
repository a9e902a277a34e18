"""One closed surface of the muscle, split into its walls at the base."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cli_support import answer, complaint
from emulator.core.errors import InputError
from emulator.geometry.fibres import BOTH
from emulator.geometry.generators.biventricle import biventricle
from emulator.geometry.generators.ellipsoid import HUMAN
from emulator.hearts.splitting import split_muscle
from emulator.hearts.surfaces import surface
from surface_support import INSIDE, OUTSIDE, ellipsoid, marching, write

TURN = Rotation.from_rotvec([0.4, -0.7, 0.3]).as_matrix()
STEP = 2.5


def muscle(tilt=0.0):
    """A cup of voxels between two ellipsoids, cut off by a plane that leans; (t, 3, 3) mm."""
    inner, outer = (np.array([short, short, long]) for short, long in (INSIDE, OUTSIDE))
    normal = np.array([np.sin(tilt), 0.0, np.cos(tilt)])

    def level(x):
        out = 30.0 * (np.linalg.norm(x / outer, axis=1) - 1.0)
        within = 22.0 * (1.0 - np.linalg.norm(x / inner, axis=1))
        return np.max([out, within, x @ normal - HUMAN.base], axis=0)

    return marching(level, outer + STEP, STEP), normal


def of(soup):
    return surface("the muscle", soup.reshape(-1, 3), np.arange(3 * len(soup)).reshape(-1, 3))


@pytest.mark.parametrize("tilt", [0.0, 0.3])
def test_a_rough_cup_anywhere_is_split_at_its_base(tilt):
    soup, normal = muscle(tilt)
    (inner, outer), axis = split_muscle(of(soup @ TURN.T + [30.0, 10.0, -50.0]))
    assert axis @ TURN @ normal > 0.9995
    assert len(inner.rims) == len(outer.rims) == 1
    # The plane is a little below the ring, which is rough.
    assert 0.93 * HUMAN.cavity_volume < inner.volume < 1.03 * HUMAN.cavity_volume
    assert outer.volume - inner.volume == pytest.approx(HUMAN.volume, rel=0.05)


def test_both_ventricles_in_one_surface_are_told_apart():
    mesh = biventricle(rings=16, around=40)
    pieces, axis = split_muscle(surface("heart", mesh.nodes, mesh.surface))
    np.testing.assert_allclose(axis, [0.0, 0.0, 1.0], atol=1e-6)
    for piece, name in zip(pieces, BOTH, strict=True):
        expected = surface(name, mesh.nodes, mesh.facet_set(name))
        assert piece.volume == pytest.approx(expected.volume, rel=1e-6)


def test_a_closed_cavity_is_no_muscle():
    with pytest.raises(InputError, match="leaves two walls: if it is the whole muscle"):
        split_muscle(of(ellipsoid((30.0, 40.0))))


def test_by_the_command_line(cases, tmp_path, capsys):
    file, out = cases / "tables" / "closed_myocardium" / "myocardium.ply", tmp_path / "lv.vtu"
    words = ["mesh", "--endocardium", file, "--epicardium", file, "--out", out]
    pytest.importorskip("gmsh", reason="no gmsh here", exc_type=(ImportError, OSError))
    code, told = answer(capsys, *words)
    assert code == 0
    assert told["cavities"]["endocardium"]["mesh"] == pytest.approx(27.7, rel=0.01)
    assert "one closed surface has both walls: split at 5 mm" in told["warnings"][0]


def test_a_wall_within_another_surface_names_the_way(tmp_path, capsys):
    soup, _ = muscle()
    files = write(tmp_path / "muscle.stl", soup), write(tmp_path / "epi.stl", ellipsoid(OUTSIDE))
    words = [
        "mesh",
        "--endocardium",
        files[0],
        "--epicardium",
        files[1],
        "--out",
        tmp_path / "o.vtu",
    ]
    for more in ([], ["--axis", 0, 0, 1, "--base-height", 10]):
        line = complaint(capsys, *map(str, [*words, *more]))
        assert "with both walls" in line
        assert "is given as endocardium and as epicardium" in line
