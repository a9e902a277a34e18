"""Surfaces of triangles: cut, smoothed and laid out in the disc, against closed forms."""

import numpy as np
import pytest

from emulator.core.errors import InputError
from emulator.geometry.generators.ellipsoid import disc
from emulator.hearts.remeshing import DiscMap, Remeshed
from emulator.hearts.surfaces import (
    Surface,
    cut,
    inside,
    one_rim,
    read_surface,
    smoothed,
    surface,
)
from surface_support import ellipsoid, write

UP = np.array([0.0, 0.0, 1.0])


def of(soup, name="endocardium"):
    return surface(name, soup.reshape(-1, 3), np.arange(3 * len(soup)).reshape(-1, 3))


@pytest.fixture(scope="module")
def ball():
    """Radius 10 mm, its triangles in random senses."""
    soup = ellipsoid((10.0, 10.0), 1.0)
    turned = np.random.default_rng(0).random(len(soup)) < 0.5
    soup[turned] = soup[turned][:, ::-1]
    return of(soup)


def test_triangles_of_any_sense_enclose_their_volume(ball, tmp_path):
    assert not ball.rims
    assert ball.volume == pytest.approx(4000.0 * np.pi / 3.0, rel=0.01)
    for name in ("ball.stl", "ball.ply"):
        again = read_surface(write(tmp_path / name, ball.points[ball.triangles]), "x", 0.1)
        assert again.volume == pytest.approx(1e-3 * ball.volume, rel=1e-5)
        assert len(again.points) == len(ball.points)


def test_a_cap_has_the_volume_of_a_cap(ball):
    normal = np.array([2.0, 1.0, 2.0]) / 3.0
    height = 4.0
    cap = cut(ball, height * normal, normal)
    assert cap.volume == pytest.approx(np.pi / 3.0 * 14.0**2 * (30.0 - 14.0), rel=0.01)
    rim = cap.points[np.unique(one_rim(cap))]
    np.testing.assert_allclose(rim @ normal, height, atol=1e-9)
    even = smoothed(cap, 10)
    np.testing.assert_allclose(even.points[np.unique(one_rim(even))] @ normal, height, atol=1e-9)
    assert even.volume == pytest.approx(cap.volume, rel=0.005)


def test_smoothing_takes_noise_off(ball):
    noise = 0.2 * np.random.default_rng(1).normal(size=ball.points.shape)
    rough = Surface("rough", ball.points + noise, ball.triangles)
    left = [np.std(np.linalg.norm(each.points, axis=1)) for each in (rough, smoothed(rough, 20))]
    assert left[1] < 0.4 * left[0]


def test_what_is_inside(ball):
    cap = cut(ball, 3.0 * UP, UP)
    places = np.random.default_rng(2).uniform(-12.0, 12.0, (500, 3))
    places = places[(places[:, 2] < 3.0) & (np.abs(np.linalg.norm(places, axis=1) - 10.0) > 0.2)]
    np.testing.assert_array_equal(inside(cap, places), np.linalg.norm(places, axis=1) < 10.0)


def test_a_flat_disc_is_laid_out_as_it_is():
    """Mean value coordinates reproduce the plane, whatever the triangles."""
    radius, angle, triangles = disc(4, 12)
    points = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), 0.0 * angle])
    points[radius < 1.0, :2] += 0.05 * np.random.default_rng(0).normal(size=((radius < 1).sum(), 2))
    flat = DiscMap(Surface("disc", 20.0 * points, triangles))
    # The rim may begin anywhere: lengths between places are those of the disc.
    between = [np.linalg.norm(x[:, None] - x[None], axis=-1) for x in (flat.places, points)]
    np.testing.assert_allclose(*between, atol=1e-9)


@pytest.mark.slow
def test_no_triangle_of_a_cap_turns_over(ball):
    cap = cut(ball, 5.0 * UP, UP)
    flat = DiscMap(cap)
    corners = flat.places[cap.triangles]
    u, v = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    sign = np.sign(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0])
    assert abs(sign.sum()) == len(sign)
    whole = Remeshed(cap, flat.places, ())
    edges = np.arange(400).reshape(2, 200).T
    middle, ends = flat.middles(whole, edges), [flat.at(flat.places[k]) for k in edges.T]
    near = [np.linalg.norm(middle - end, axis=1) for end in ends]
    np.testing.assert_allclose(*near, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(middle, axis=1), 10.0, atol=0.1)


def broken():
    """Surfaces that are none, and what is said."""
    soup = ellipsoid((10.0, 10.0), 3.0)
    fin = np.array([soup[0, 0], soup[0, 1], soup[0].mean(axis=0) * 1.3])[None]
    nan = soup.copy()
    nan[3, 1] = np.nan
    flat = np.array([[[0, 0, 0], [1, 0, 0], [1, 1, 0]], [[0, 0, 0], [1, 1, 0], [0, 1, 0]]], float)
    flat = np.concatenate([flat, flat + np.array([1.0, 0, 0])])
    yield np.concatenate([soup, fin]), "more than two triangles meet at the edge at"
    yield np.concatenate([soup, soup + 50.0]), "it has 2 separate parts, the largest of"
    yield nan, "a coordinate is not finite"
    yield flat, "it encloses no volume"
    yield soup[:0], "it has no triangles"


@pytest.mark.parametrize(
    ("soup", "message"), list(broken()), ids=lambda x: x if isinstance(x, str) else ""
)
def test_what_is_no_surface_is_told_in_one_line(soup, message):
    with pytest.raises(InputError, match=f"^endocardium: {message}") as error:
        of(soup)
    assert "\n" not in str(error.value)


def test_a_plane_beside_the_surface_is_refused(ball):
    with pytest.raises(InputError, match="all of it is below the base plane through"):
        cut(ball, 11.0 * UP, UP)
    with pytest.raises(InputError, match="all of it is above the base plane through"):
        cut(ball, -11.0 * UP, UP)
