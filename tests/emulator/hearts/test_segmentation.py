"""Surfaces of labels: where bodies are that have closed forms, and what is refused."""

import sys

import nibabel
import numpy as np
import pytest

from cli_support import answer, complaint
from emulator.core.errors import InputError
from emulator.geometry.generators.ellipsoid import HUMAN
from emulator.geometry.io import read_mesh
from emulator.hearts.images import label_image, read_labels
from emulator.hearts.segmentation import label_surface, left_ventricle
from surface_support import INSIDE, OUTSIDE, ellipsoid, write

MIDDLE = np.array([31.0, -24.0, 12.0])
TURN = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
TURN[:, 0] *= -np.linalg.det(TURN)  # a reflection


def affine_of(spacing, shape, turn=None, middle=MIDDLE):
    """Voxels of ``spacing`` along the columns of ``turn``, the grid's middle at ``middle``."""
    affine = np.eye(4)
    affine[:3, :3] = (np.eye(3) if turn is None else turn) * np.asarray(spacing)
    affine[:3, 3] = middle - affine[:3, :3] @ (0.5 * (np.array(shape) - 1.0))
    return affine


def places(affine, shape):
    return np.indices(shape).reshape(3, -1).T @ affine[:3, :3].T + affine[:3, 3]


def within(x, semi_axes, middle=MIDDLE):
    return np.sum(((x - middle) / semi_axes) ** 2, axis=1) < 1.0


def labels_of(affine, shape, semi_axes, value=1):
    return value * within(places(affine, shape), semi_axes).reshape(shape).astype(np.uint8)


def ventricle(affine, shape, base=HUMAN.base):
    """Blood 1 and myocardium 2, cut flat at ``base`` above the middle."""
    x = places(affine, shape)
    (a, b), (c, d) = INSIDE, OUTSIDE
    below = x[:, 2] < MIDDLE[2] + base
    labels = np.where(within(x, (c, c, d)) & below, 2, 0)
    labels[within(x, (a, a, b)) & below] = 1
    return labels.reshape(shape).astype(np.int16)


def write_nrrd(path, values, **header):
    """Write bytes as a NRRD file, its header by hand."""
    sizes = " ".join(map(str, values.shape))
    lines = ["NRRD0005", "type: uint8", f"dimension: {values.ndim}", f"sizes: {sizes}"]
    lines += [f"{key.replace('_', ' ')}: {value}" for key, value in header.items()]
    lines += ["encoding: raw", "", ""]
    path.write_bytes("\n".join(lines).encode() + values.tobytes(order="F"))


def vector(numbers):
    return "(" + ",".join(repr(float(x)) for x in numbers) + ")"


def off(points, semi_axes):
    """Distances in mm to an ellipsoid, along rays from its middle."""
    x = points - MIDDLE
    radius = np.linalg.norm(x, axis=1)
    return radius - radius / np.linalg.norm(x / semi_axes, axis=1)


@pytest.mark.parametrize("turn", [None, TURN], ids=["along the axes", "oblique reflection"])
@pytest.mark.parametrize("semi_axes", [(20.0, 20.0, 20.0), (15.0, 19.0, 26.0)])
def test_a_body_lies_where_the_affine_says(semi_axes, turn):
    spacing, shape = (0.9, 1.2, 2.0), (64, 50, 34)
    affine = affine_of(spacing, shape, turn)
    assert turn is None or np.linalg.det(affine[:3, :3]) < 0.0
    image = label_image("x.nii", labels_of(affine, shape, semi_axes, 7), affine)
    surface, notes = label_surface(image, [7], "organ")
    assert surface.rims == []
    assert surface.volume == pytest.approx(1000.0 * image.volumes[7], rel=1e-3)
    assert surface.volume == pytest.approx(4.0 / 3.0 * np.pi * np.prod(semi_axes), rel=0.01)
    assert np.abs(off(surface.points, semi_axes)).max() < 0.5 * max(spacing)
    np.testing.assert_allclose(surface.mesh.center_mass, MIDDLE, atol=0.05)
    outward = np.sum(surface.mesh.face_normals * (surface.mesh.triangles_center - MIDDLE), axis=1)
    assert np.median(outward) > 10.0
    assert len(notes) == 1


@pytest.mark.parametrize(("unit", "code"), [(1.0, "mm"), (1e-3, "meter")])
def test_formats_and_units_give_one_surface(tmp_path, unit, code):
    shape = (30, 26, 20)
    affine = affine_of((1.5, 2.0, 2.5), shape, TURN)
    values = labels_of(affine, shape, (12.0, 15.0, 10.0), 3)
    scale = np.diag([unit, unit, unit, 1.0])
    file = nibabel.Nifti1Image(values, scale @ affine)
    file.header.set_xyzt_units(code)
    nibabel.save(file, tmp_path / "a.nii.gz")
    nibabel.save(file, tmp_path / "a.nii")
    lps = scale @ np.diag([-1.0, -1.0, 1.0, 1.0]) @ affine
    write_nrrd(
        tmp_path / "a.nrrd",
        values,
        space="left-posterior-superior",
        space_directions=" ".join(map(vector, lps[:3, :3].T)),
        space_origin=vector(lps[:3, 3]),
        space_units={"mm": '"mm" "mm" "mm"', "meter": '"m" "m" "m"'}[code],
    )
    expected, _ = label_surface(label_image("a", values, affine), [3], "organ")
    for name in ("a.nii", "a.nii.gz", "a.nrrd"):
        surface, notes = label_surface(read_labels(tmp_path / name), [3], "organ")
        assert len(notes) == 1
        np.testing.assert_array_equal(surface.triangles, expected.triangles)
        np.testing.assert_allclose(surface.points, expected.points, atol=1e-4)


def test_what_the_header_lacks_is_noted(tmp_path):
    values = labels_of(affine_of((1, 1, 1), (20, 20, 20), middle=MIDDLE), (20, 20, 20), (6, 6, 6))
    write_nrrd(tmp_path / "a.nrrd", values, spacings="1 1 2")
    image = read_labels(tmp_path / "a.nrrd")
    assert image.voxel == pytest.approx(2.0)
    assert "has spacings alone" in image.notes[0]
    nibabel.save(nibabel.Nifti1Image(values, None), tmp_path / "a.nii")
    assert "neither sform nor qform" in read_labels(tmp_path / "a.nii").notes[0]


def test_pieces_holes_and_borders_are_said():
    shape = (40, 40, 40)
    affine = affine_of((1.0, 1.0, 1.0), shape)
    values = labels_of(affine, shape, (15.0, 15.0, 15.0))
    values[20, 20, 20] = 0
    values[1:4, 1:4, 1:3] = 1
    surface, notes = label_surface(label_image("x", values, affine), [1], "organ")
    assert "1 smaller piece of 0.018 mL dropped" in notes[1]
    assert "holes of 0.001 mL filled" in notes[2]
    assert surface.volume == pytest.approx(values.sum() - 18 + 1, rel=1e-3)
    half = values[:, :, 20:]
    surface, notes = label_surface(label_image("x", half, affine), [1], "organ")
    assert "cut flat by the image's border" in notes[-1]
    assert surface.rims == []
    assert surface.volume == pytest.approx(half.sum(), rel=2e-3)


def test_labels_join_and_blur_may_be_none():
    shape = (30, 30, 30)
    affine = affine_of((1.0, 1.0, 1.5), shape)
    values = labels_of(affine, shape, (10.0, 10.0, 10.0))
    values[:15] *= 4
    image = label_image("x", values.astype(float), affine)
    count = np.count_nonzero(values) * image.voxel
    for blur in (0.0, 2.0):
        surface, _ = label_surface(image, [1, 4], "organ", blur)
        assert surface.volume == pytest.approx(count, rel=1e-3)


@pytest.fixture(scope="module")
def lv():
    shape = (84, 70, 56)
    affine = affine_of((1.8, 2.0, 2.5), shape, TURN)
    return label_image("lv.nii", ventricle(affine, shape), affine)


def test_a_ventricle_has_its_walls_axis_and_base(lv):
    seen = left_ventricle(lv, [1], [2])
    assert len(seen.notes) == 2
    assert np.degrees(np.arccos(seen.axis[2])) < 2.0
    assert -6.5 < (seen.base - MIDDLE) @ seen.axis - HUMAN.base < -2.0
    assert seen.endocardium.volume == pytest.approx(1000.0 * lv.volumes[1], rel=1e-3)
    whole = 1000.0 * (lv.volumes[1] + lv.volumes[2])
    assert seen.epicardium.volume == pytest.approx(whole, rel=1e-3)
    for surface, (short, long) in ((seen.endocardium, INSIDE), (seen.epicardium, OUTSIDE)):
        below = surface.points[(surface.points - seen.base) @ seen.axis < 0.0]
        assert np.abs(off(below, (short, short, long))).max() < 0.5 * 2.5


def test_a_ventricle_without_an_open_base_or_with_a_hole(lv):
    values = lv.labels.copy()
    at = np.round(np.linalg.inv(lv.affine) @ [*(MIDDLE - [0, 0, INSIDE[1] + 3]), 1.0]).astype(int)[
        :3
    ]
    around = tuple(slice(i - 3, i + 4) for i in at)
    values[around][values[around] == 2] = 0
    seen = left_ventricle(label_image("lv", values, lv.affine), [1], [2])
    assert "the myocardium has holes besides the base" in seen.notes[-1]
    assert np.degrees(np.arccos(seen.axis[2])) < 2.0
    shape = (30, 30, 30)
    affine = affine_of((3.0, 3.0, 4.0), shape)
    around = label_image("lv", ventricle(affine, shape, 90.0), affine)
    with pytest.raises(InputError, match="the myocardium is all around the blood"):
        left_ventricle(around, [1], [2])
    apart = np.where(lv.labels == 1, 1, 0)
    apart[2:5, 2:5, 2:5] = 2
    with pytest.raises(InputError, match="no voxel of the myocardium touches the blood"):
        left_ventricle(label_image("lv", apart, lv.affine), [1], [2])
    with pytest.raises(InputError, match=r"--blood 2 is a label of --myocardium, too"):
        left_ventricle(lv, [2], [2])


CUBE = np.pad(np.ones((4, 4, 4), dtype=np.uint8), 2)
WRONG = {
    "background": (0 * CUBE, np.eye(4), "all of its voxels are 0"),
    "frames": (np.stack([CUBE, CUBE], axis=3), np.eye(4), r"its shape is \(8, 8, 8, 2\); expected three"),
    "slice": (CUBE[0], np.eye(4), r"its shape is \(8, 8\); expected three axes"),
    "probabilities": (0.37 * CUBE, np.eye(4), "64 voxels are no whole numbers, such as 0.37; expected labels"),
    "nan": (np.where(CUBE, np.nan, 0.0), np.eye(4), "such as nan; expected labels"),
    "colours": (CUBE.astype(complex), np.eye(4), "its voxels are complex128"),
    "singular": (CUBE, np.diag([1.0, 1.0, 0.0, 1.0]), "is singular; expected three edges"),
    "infinite": (CUBE, np.diag([1.0, 1.0, np.inf, 1.0]), "is singular"),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG)
def test_no_image_of_labels(case):
    values, affine, message = WRONG[case]
    with pytest.raises(InputError, match=message) as error:
        label_image("x.nii", values, affine)
    assert "\n" not in str(error.value)


def test_other_choices_are_refused():
    image = label_image("x.nii", CUBE, np.eye(4))
    with pytest.raises(InputError, match=r"it has no label 7; labels: 1 \(0.064 mL\)"):
        label_surface(image, [7], "organ")
    with pytest.raises(InputError, match="blur -1.0 mm: expected a standard deviation"):
        label_surface(image, [1], "organ", -1.0)
    thread = CUBE.copy()
    thread[:, :, :] = 0
    thread[0, 0, 0] = thread[7, 7, 7] = 1
    label_surface(label_image("x", thread, np.eye(4)), [1], "organ")
    two = np.pad(np.zeros((20, 12, 12), dtype=np.uint8), 2)
    two[2:10], two[10:14, 8, 8], two[14:22] = 1, 1, 1
    with pytest.raises(InputError, match="parts are thinner than the blur, 1.5 mm; give less"):
        label_surface(label_image("x", two, np.eye(4)), [1], "organ", 1.5)


def test_files_that_are_no_images_are_refused_in_one_line(tmp_path, capsys):
    out = tmp_path / "o.vtu"

    def refused(path, *more):
        return complaint(capsys, "mesh", "--image", path, *more, "--out", out)

    (tmp_path / "text.nii").write_text("this is no image\n")
    (tmp_path / "text.nrrd").write_text("this is no image\n")
    (tmp_path / "empty.nii.gz").write_bytes(b"")
    for name in ("text.nii", "text.nrrd", "empty.nii.gz"):
        assert "cannot be read: " in refused(tmp_path / name, "--label", 1)
    assert "does not exist; expected a .nii" in refused(tmp_path / "no.nii", "--label", 1)
    assert "is a folder" in refused(tmp_path, "--label", 1)
    (tmp_path / "a.stl").write_text("solid\n")
    assert "expected a .nii, .nii.gz or .nrrd file" in refused(tmp_path / "a.stl", "--label", 1)
    nibabel.save(nibabel.Nifti1Image(CUBE, np.eye(4)), tmp_path / "a.nii")
    data = (tmp_path / "a.nii").read_bytes()
    (tmp_path / "short.nii").write_bytes(data[:-200])
    assert "cannot be read: " in refused(tmp_path / "short.nii", "--label", 1)
    assert "name its labels, --label N of a body, or --blood N" in refused(tmp_path / "a.nii")
    assert "labels: 1 (0.064 mL)" in refused(tmp_path / "a.nii")
    assert "--blood has no effect with --image --label" in refused(tmp_path / "a.nii", "--label", 1, "--blood", 1)  # fmt: skip
    assert "--unit has no effect on an image" in refused(tmp_path / "a.nii", "--label", 1, "--unit", "cm")  # fmt: skip
    line = complaint(capsys, "mesh", "--surface", tmp_path / "a.stl", "--label", 1, "--out", out)
    assert "--label has no effect with --surface" in line
    assert "give --endocardium and --epicardium of a wall" in complaint(
        capsys, "mesh", "--out", out
    )


@pytest.mark.parametrize("lacking", ["nibabel", "nrrd", "skimage.measure"])
def test_without_the_extra_the_command_names_it(tmp_path, capsys, monkeypatch, lacking):
    nibabel.save(nibabel.Nifti1Image(CUBE, np.eye(4)), tmp_path / "a.nii")
    for name in ("images", "segmentation"):
        monkeypatch.delitem(sys.modules, f"emulator.hearts.{name}", raising=False)
    monkeypatch.setitem(sys.modules, lacking, None)
    line = complaint(
        capsys, "mesh", "--image", tmp_path / "a.nii", "--label", 1, "--out", tmp_path / "o.vtu"
    )
    assert line.endswith("scikit-image: pip install 'soft-tissue-calibrate[images]'")


def test_an_organ_becomes_a_mesh(tmp_path, capsys):
    pytest.importorskip("gmsh", reason="no gmsh here", exc_type=(ImportError, OSError))
    shape, semi_axes = (44, 40, 30), (15.0, 19.0, 26.0)
    affine = affine_of((1.5, 1.5, 2.0), shape, TURN)
    nibabel.save(nibabel.Nifti1Image(labels_of(affine, shape, semi_axes, 5), affine), tmp_path / "a.nii")  # fmt: skip
    out = tmp_path / "organ.vtu"
    code, told = answer(capsys, "mesh", "--image", tmp_path / "a.nii", "--label", 5, "--out", out)
    assert code == 0
    assert told["volume"]["mesh"] == pytest.approx(told["volume"]["surface"], rel=5e-3)
    assert told["quality"]["parts"] == 1
    mesh = read_mesh(out)
    assert len(mesh.elements) == told["elements"] > 1000
    on_it = mesh.nodes[mesh.node_set("surface")]
    assert np.abs(off(on_it, semi_axes)).max() < 1.0
    assert len(mesh.facet_set("surface")) == len(mesh.surface)
    short = complaint(capsys, "mesh", "--image", tmp_path / "a.nii", "--label", 5, "--size", 90, "--out", out)  # fmt: skip
    assert "below a quarter of the body's extent" in short


def test_a_closed_surface_becomes_a_mesh(tmp_path, capsys):
    pytest.importorskip("gmsh", reason="no gmsh here", exc_type=(ImportError, OSError))
    write(tmp_path / "body.stl", 0.1 * ellipsoid((15.0, 22.0)))
    words = "mesh", "--surface", tmp_path / "body.stl", "--out", tmp_path / "body.vtu"
    code, told = answer(capsys, *words, "--unit", "cm", "--order", 1, "--size", 5)
    assert code == 0
    exact = 4.0 / 3.0 * np.pi * 15.0**2 * 22.0 / 1000.0
    assert told["volume"]["surface"] == pytest.approx(exact, rel=0.03)
    assert told["volume"]["mesh"] == pytest.approx(exact, rel=0.05)
    soup = ellipsoid((15.0, 22.0))
    write(tmp_path / "body.stl", soup[soup[:, :, 2].max(axis=1) < 10.0])
    assert "surface: it is open, with 1 rims; expected it closed" in complaint(capsys, *words)


def test_a_ventricle_becomes_a_wall(lv, tmp_path, capsys):
    pytest.importorskip("gmsh", reason="no gmsh here", exc_type=(ImportError, OSError))
    nibabel.save(nibabel.Nifti1Image(lv.labels, lv.affine), tmp_path / "lv.nii.gz")
    words = ["mesh", "--image", tmp_path / "lv.nii.gz", "--myocardium", 2, "--size", 12]
    words += ["--out", tmp_path / "lv.vtu"]
    code, told = answer(capsys, *words, "--blood", 1)
    assert code == 0
    assert told["axis"][2] > 0.999
    assert told["warnings"] == []
    assert set(read_mesh(tmp_path / "lv.vtu").facet_sets) >= {"endocardium", "epicardium", "base"}  # fmt: skip
    height = (np.array(told["base"]) - MIDDLE)[2]
    short, long = INSIDE
    cavity = np.pi * short**2 * (height - height**3 / (3 * long**2) + 2.0 * long / 3.0) / 1000.0
    assert told["cavities"]["endocardium"]["surface"] == pytest.approx(cavity, rel=0.015)
    code, alone = answer(capsys, *words)
    assert code == 0
    assert alone["axis"][2] > 0.99
    code, lower = answer(capsys, *words, "--blood", 1, "--base-point", 31, -24, 17)
    assert code == 0
    assert lower["cut_off"] > told["cut_off"]
