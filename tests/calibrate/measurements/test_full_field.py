"""Tables of points over frames: three formats, what cannot be, and the data they become."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import emulator as em  # noqa: F401 - float64
from calibrate.measurements.full_field import (
    FullField,
    _zigzag,
    field_data,
    field_doubts,
    read_amounts,
    read_curve,
    read_full_field,
    sign_of,
    spread_points,
)
from cli_support import answer
from emulator.core.errors import InputError
from emulator.scenes import Support
from emulator.scenes.parameter_space import Parameter
from scene_support import between_plates

AMOUNTS = {"0": 0.0, "3": 0.5, "6": 1.0, "9": 1.5, "12": 2.0}


@pytest.fixture
def field():
    rng = np.random.default_rng(0)
    points = rng.uniform(0.5, 3.5, (12, 2))
    amounts = np.array(list(AMOUNTS.values()))
    u = amounts[:, None, None] * (0.1 + 0.02 * rng.normal(size=(12, 2)))
    u[2, 4] = np.nan
    return FullField(points, u, tuple(AMOUNTS))


def tables(folder, field):
    rows = ["point,x,y"] + [f"{k},{x},{y}" for k, (x, y) in enumerate(field.points)]
    (folder / "points.csv").write_text("\n".join(rows))
    rows = ["frame,point,ux,uy"]
    for frame, u in zip(field.frames, field.displacement, strict=True):
        rows += [f"{frame},{k},{a},{b}" for k, (a, b) in enumerate(u) if np.isfinite(a)]
    (folder / "moved.csv").write_text("\n".join(rows))
    return folder / "points.csv", folder / "moved.csv"


def same(found, field, frames=True):
    np.testing.assert_array_equal(found.points, field.points)
    np.testing.assert_array_equal(found.displacement, field.displacement)
    assert not frames or found.frames == field.frames


def test_every_format_gives_the_same_field(tmp_path, field):
    same(read_full_field(*tables(tmp_path, field)), field)
    np.savez(
        tmp_path / "f.npz",
        points=field.points,
        displacement=field.displacement,
        frames=np.array(field.frames),
    )
    same(read_full_field(tmp_path / "f.npz"), field)
    folder = tmp_path / "matrices"
    folder.mkdir()
    for name, values in {
        "x": np.repeat(field.points[:, :1], 5, axis=1),
        "y": np.repeat(field.points[:, 1:], 5, axis=1),
        "ux": field.displacement[..., 0].T,
        "uy": field.displacement[..., 1].T,
    }.items():
        np.savetxt(folder / f"{name}.txt", values)
    same(read_full_field(folder), field, frames=False)


def test_it_becomes_landmarks_whose_third_component_is_missing(field):
    scene = between_plates()
    observe, data = field_data(scene, field, AMOUNTS)
    assert list(observe.parts) == [f"displacement@{frame}" for frame in AMOUNTS]
    part = observe.parts["displacement@0"]
    np.testing.assert_allclose(part.points[:, 2], 4.0)
    np.testing.assert_array_equal(part.points[:, :2], field.points)
    for k, name in enumerate(data):
        np.testing.assert_array_equal(data[name][:, :2], field.displacement[k])
        assert np.isnan(data[name][:, 2]).all()
    only = field.only(("6", "3"), np.array([1, 5]))
    np.testing.assert_array_equal(only.displacement, field.displacement[[2, 1]][:, [1, 5]])


def test_amounts_and_curves_are_read_by_name(tmp_path):
    (tmp_path / "pads.csv").write_text("frame,ux\n0,0\n3,-0.5\n")
    assert read_amounts(tmp_path / "pads.csv", "ux") == {"0": 0.0, "3": -0.5}
    (tmp_path / "force.csv").write_text("u,F\n-0.2,-2\n-0.1,-1\n")
    # A sensor may count the other way round; compression is no tension otherwise.
    for like, expected in ([1.0], [0.1, 0.2]), ([-1.0], [-0.2, -0.1]), ([], [-0.2, -0.1]):
        amounts, force = read_curve(tmp_path / "force.csv", "u", "F", like)
        np.testing.assert_array_equal(amounts, expected)
        np.testing.assert_array_equal(np.sort(force), [-2.0, -1.0])
    (tmp_path / "cycle.csv").write_text("u,F\n" + "0,0\n1,1\n2,3\n1,0.5\n0,0\n" * 2)
    with pytest.raises(InputError, match="'u' goes back at row 4: a curve of loading and"):
        read_curve(tmp_path / "cycle.csv", "u", "F")
    (tmp_path / "twice.csv").write_text("frame,ux\n3,0.1\n3,0.5\n")
    with pytest.raises(InputError, match="row 2 is of frame '3', and so is one before"):
        read_amounts(tmp_path / "twice.csv", "ux")


def test_a_pull_keeps_its_sign_unless_the_scene_knows_one_alone():
    amounts = {"1": 0.0, "2": -0.5}
    signed = [Parameter("pull", "", low, 1.0) for low in (0.0, -1.0)]
    scenes = [SimpleNamespace(parameters=(parameter,)) for parameter in signed]
    assert [sign_of(scene, "pull", amounts) for scene in scenes] == [-1.0, 1.0]
    assert sign_of(scenes[0], "pull", {"1": -0.5, "2": 0.5}) == 1.0
    assert sign_of(scenes[0], "pull", {"1": 0.0, "2": 0.5}) == 1.0


def test_branches_of_a_cycle_that_were_sorted_into_one_are_asked_about():
    pull = np.linspace(0.0, 1.0, 21)
    loading, unloading = pull**2, 0.6 * pull**2
    noisy = loading + 0.01 * np.random.default_rng(0).normal(size=21)
    assert list(_zigzag("f.csv", loading)) == list(_zigzag("f.csv", noisy)) == []
    both = np.where(np.arange(21) % 2, loading, unloading)
    (said,) = _zigzag("f.csv", both)
    assert "are loading and unloading sorted into one curve?" in said


def test_points_are_spread_over_the_field():
    points = np.stack(np.meshgrid(np.arange(9.0), np.arange(9.0)), axis=-1).reshape(-1, 2)
    chosen = spread_points(points, 9)
    assert len(set(chosen.tolist())) == 9
    apart = np.linalg.norm(points[chosen][:, None] - points[chosen], axis=2) + 99.0 * np.eye(9)
    assert apart.min() >= 3.0


def wrong(change):
    """Return tables that somebody might give."""

    def make(folder, field):
        points, moved = tables(folder, field)
        texts = change(points.read_text().split("\n"), moved.read_text().split("\n"))
        for path, lines in zip((points, moved), texts, strict=True):
            path.write_text("\n".join(lines))
        return points, moved

    return make


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (wrong(lambda p, m: (p, [*m, m[-1]])), "is twice in frame '12'"),
        (wrong(lambda p, m: ([*p, p[-1]], m)), "point '11' is twice"),
        (wrong(lambda p, m: (p[:-1], m)), "point '11' is not in"),
        (wrong(lambda p, m: (p, ["frame,point,u,v", *m[1:]])), "column 'ux' is missing"),
        (wrong(lambda p, m: (["point,x,z", *p[1:]], m)), "column 'y' is missing"),
        (wrong(lambda p, m: (p, [*m, "12,11,a,b"])), "twice"),
        (lambda folder, _: (folder / "none.csv",), "does not exist"),
        (lambda folder, field: (tables(folder, field)[0],), "name the file of displacements"),
    ],
)
def test_tables_that_cannot_be_are_refused_in_a_line(tmp_path, field, make, words):
    with pytest.raises(InputError, match=words) as error:
        read_full_field(*make(tmp_path, field))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda f, a: (f, {k: v for k, v in a.items() if k != "9"}), "frame '9' has no amount"),
        (lambda f, a: (f, dict(zip(a, [2.0, 0.1, 1.5, 0.0, 0.7], strict=True))), "in the order"),
        (
            lambda f, a: (FullField(30.0 * f.points, f.displacement, f.frames), a),
            "pixels instead of mm",
        ),
        (lambda f, a: (FullField(f.points + 9.0, f.displacement, f.frames), a), "outside the body"),
        (lambda f, a: (f.only(("3", "99")), a), "no frame '99'"),
    ],
)
def test_fields_that_cannot_be_data_are_refused_in_a_line(field, change, words):
    with pytest.raises(InputError, match=words) as error:
        field_data(between_plates(), *change(field, dict(AMOUNTS)))
    assert "\n" not in str(error.value)


def test_frames_without_force_without_its_amount(tmp_path):
    (tmp_path / "force.csv").write_text("F\n1\n2\n")
    with pytest.raises(InputError, match="column 'u' is missing"):
        read_curve(tmp_path / "force.csv", "u", "F")


def test_matrices_of_different_shapes_are_refused(tmp_path):
    for name, columns in {"x": 2, "y": 2, "ux": 2, "uy": 3}.items():
        np.savetxt(tmp_path / f"{name}.txt", np.ones((4, columns)))
    with pytest.raises(InputError, match=r"ux of shape \(4, 2\) and uy of \(4, 3\)"):
        read_full_field(tmp_path)


def pulled(parameter="pull", y=True):
    """A block between x = 0 and 4, pulled along x, and along y too."""
    supports = (
        *(
            Support(name, components=c)
            for name, c in zip(("left", "front", "bottom"), "xyz", strict=True)
        ),
        Support("right", (1.0, 0.0, 0.0), "x", amount=parameter),
        *([Support("back", (0.0, 2.0, 0.0), "y", amount=parameter)] if y else []),
    )
    return replace(
        between_plates(),
        supports=supports,
        parameters=(Parameter(parameter, "", 0.0, 1.0),),
        constants={"mu": 2.0, "lam": 8.0},
    )


PULLED = {"1": 0.4, "2": 0.8}


def seen(u):
    x = np.stack(np.meshgrid(np.linspace(0.5, 3.5, 4), np.linspace(0.5, 3.5, 4)), -1).reshape(-1, 2)
    return FullField(x, np.stack([u(x, amount) for amount in PULLED.values()]), tuple(PULLED))


@pytest.mark.parametrize(
    ("y", "u", "question"),
    [
        (True, lambda x, a: a * x / 4.0 * [1, 2], None),
        (True, lambda x, a: 12.0 * a * x / 4.0 * [1, 2], "displacements in pixels?"),
        (True, lambda x, a: a * x / 4.0 * [1, -2], "move against the pull along y: does y of the"),
        (False, lambda x, a: a * (x - [0, 2]) / 4.0 * [1, -0.4], None),
        (
            False,
            lambda x, a: a * (x - [0, 2]) / 4.0 * [1, 0.4],
            "across the pull, by 20 % along it",
        ),
        (False, lambda x, a: 0.0 * x, None),
    ],
)
def test_a_field_is_held_beside_what_pulls(y, u, question):
    lines = list(field_doubts(pulled(y=y), seen(u), PULLED, "pull"))
    assert [question in line for line in lines] == ([] if question is None else [True])
    assert not list(field_doubts(pulled("other"), seen(u), PULLED, "pull"))


def test_a_place_counts_once(field):
    points = np.vstack([field.points, field.points[3] + 1e-6])
    u = np.concatenate([field.displacement, field.displacement[:, 3:4]], axis=1)
    with pytest.raises(InputError, match=r"points 4 and 13 are 1.4e-06 mm apart, .* counts once"):
        FullField(points, u, field.frames)
    every = np.vstack([field.points, field.points + 1e-6])
    u = np.concatenate([field.displacement, field.displacement], axis=1)
    with pytest.raises(InputError, match=r"are 1.4e-06 mm apart, of 0.\d+ usually: one place"):
        FullField(every, u, field.frames)


@pytest.mark.parametrize(
    ("scale", "question"),
    [
        ((1.0, 1.0), None),
        ((10.0, 10.0), "displacements in pixels?"),
        ((1.0, -1.0), "rows count down"),
    ],
)
def test_doubts_are_said_by_the_command(cases, scale, question, tmp_path, capsys):
    folder = cases / "tables" / "two_forces"
    head, *rows = (folder / "moved.csv").read_text().splitlines()
    lines = [head]
    for row in rows:
        frame, point, *u = row.split(",")
        lines.append(
            ",".join([frame, point, *(str(s * float(v)) for s, v in zip(scale, u, strict=True))])
        )
    (tmp_path / "moved.csv").write_text("\n".join(lines))
    words = [
        "frames",
        folder / "plate.toml",
        "--field",
        folder / "points.csv",
        tmp_path / "moved.csv",
    ]
    words += ["--amount", f"pull={folder / 'amount.csv'}:pull", "--out", tmp_path / "field.csv"]
    code, told = answer(capsys, *words)
    assert code == 0
    assert [question in line for line in told["warnings"]] == ([] if question is None else [True])


def test_amounts_that_are_turned_are_said(cases, tmp_path, capsys):
    """A machine that counts pulls as negative, in a scene that knows positive ones."""
    folder = cases / "tables" / "two_forces"
    (tmp_path / "amount.csv").write_text("frame,pull\n1,-0.4\n2,-0.8\n")
    words = ["frames", folder / "plate.toml", "--field", folder / "points.csv"]
    words += [folder / "moved.csv", "--amount", f"pull={tmp_path / 'amount.csv'}:pull"]
    code, told = answer(capsys, *words, "--out", tmp_path / "field.csv")
    assert code == 0
    (said,) = told["warnings"]
    assert "are taken as pulls counted the other way round; give 'pull' a range below 0" in said


@pytest.mark.parametrize("name", ["keloid", "healthy"])
def test_measured_skin_raises_no_doubt(measured, name):
    folder = measured / "living_skin"
    field = read_full_field(folder / f"{name}_points.csv", folder / f"{name}_displacements.csv")
    amounts = {k: abs(a) for k, a in read_amounts(folder / f"{name}_pads.csv", "moving_ux").items()}
    supports = (Support("right"), Support("left", (-1.0, 0.0, 0.0), "x", amount="pull"))
    scene = replace(
        between_plates(),
        supports=supports,
        parameters=(Parameter("pull", "", 0.0, 4.0),),
        constants={"mu": 2.0, "lam": 8.0},
    )
    assert list(field_doubts(scene, field, amounts, "pull")) == []
