"""Normal displacements of surfaces, and where on a surface a point lies."""

import json
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize

import emulator as em
from calibrate.measurements import (
    observations_from_json,
    parse_observation,
    spread_on_surface,
    surface_distances,
    surface_points,
)
from calibrate.measurements.data import read_measurements, write_data
from calibrate.measurements.location import closest_points, facet_shapes
from emulator.core.errors import InputError
from emulator.geometry.generators.ellipsoid import human_ventricle


@pytest.fixture(scope="module")
def curved():
    scene = em.scenes.left_ventricle_neo_hookean(rings=4, around=8, layers=1, order=1)
    return replace(scene, mesh=human_ventricle(4, 8, 1, order=2))


@pytest.fixture(params=["linear", "quadratic"])
def scene(request, ventricle, curved):
    return ventricle if request.param == "linear" else curved


def seen(observe, u):
    return np.asarray(observe(jnp.asarray(u)[..., observe.nodes, :], None))


@pytest.mark.parametrize("facet_set", ["epicardium", "endocardium"])
def test_the_foot_is_the_closest_point(scene, facet_set):
    """Against a search over each facet's coordinates by a general optimiser."""
    facets = scene.mesh.nodes[scene.mesh.facet_set(facet_set)]
    rng = np.random.default_rng(0)
    for point in spread_on_surface(scene, facet_set, 3, seed=1) + rng.normal(0.0, 2.0, (3, 3)):
        (row,), inside, (distance_of_foot,) = closest_points(facets, point[None])
        foot = facet_shapes(inside, facets.shape[1])[0][0] @ facets[row]
        assert distance_of_foot == pytest.approx(np.linalg.norm(foot - point), abs=1e-12)

        def distance(y, facet, point=point):
            L = np.abs(y) / np.abs(y).sum()
            return np.linalg.norm(facet_shapes(L[None], len(facet))[0][0] @ facet - point)

        corners = np.linalg.norm(facets[:, :3].mean(axis=1) - point, axis=1)
        near = facets[np.argsort(corners)[:10]]
        found = [
            minimize(
                distance,
                np.ones(3) / 3,
                (facet,),
                method="Nelder-Mead",
                options={"xatol": 1e-9, "fatol": 1e-11, "maxiter": 2000},
            ).fun
            for facet in near
        ]
        assert np.linalg.norm(foot - point) == pytest.approx(min(found), abs=1e-5)


def test_a_translation_moves_a_surface_by_its_normal_component(scene, strict):
    t = np.array([1.0, -2.0, 0.5])
    u = np.broadcast_to(t, scene.mesh.nodes.shape)
    points = spread_on_surface(scene, "epicardium", 20, seed=1)
    observe = surface_points(scene, "epicardium", points)
    np.testing.assert_allclose(observe.points, points, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(observe.normals, axis=1), 1.0)
    np.testing.assert_allclose(seen(observe, u), observe.normals @ t, atol=1e-12)
    # Out of the tissue: away from the axis outside, towards it inside.
    outward = np.sum(observe.normals[:, :2] * points[:, :2], axis=1)
    assert outward.min() > 0.0
    inside = surface_points(scene, "endocardium", spread_on_surface(scene, "endocardium", 9, 0))
    assert np.sum(inside.normals[:, :2] * inside.points[:, :2], axis=1).max() < 0.0


def test_a_linear_field_is_met_exactly(scene):
    H = 0.1 * np.random.default_rng(0).normal(size=(3, 3))
    points = spread_on_surface(scene, "epicardium", 20, seed=1)
    observe = surface_points(scene, "epicardium", points)
    expected = np.einsum("di,ij,dj->d", observe.normals, H, points)
    found = seen(observe, np.stack([scene.mesh.nodes @ H.T] * 2))
    np.testing.assert_allclose(found, [expected] * 2, atol=1e-6)


def test_distances_to_a_surface_without_correspondence(curved):
    """A uniform growth moves points along the normals of a sphere, nearly those of this wall.

    Points measured anywhere on the grown surface give the normal displacement at their feet, up to
    |u_t| tan(alpha) + kappa |u_t|^2 / 2, which is of second order in the growth.
    """
    errors = []
    for growth in (0.02, 0.01):
        u = growth * curved.mesh.nodes
        measured = (1.0 + growth) * spread_on_surface(curved, "epicardium", 60, seed=4)
        observe, values = surface_distances(curved, "epicardium", measured)
        away = observe.points[:, 2] < curved.mesh.nodes[:, 2].max() - 4.0  # feet beyond the rim
        errors.append(np.abs(seen(observe, u) - values)[away].max())
        assert errors[-1] < 0.02 * np.abs(values[away]).max()
    assert errors[1] < 0.3 * errors[0]


def test_words_files_json(ventricle, tmp_path):
    observe = parse_observation(
        ventricle, "surface:epicardium:7+surface:endocardium:4+landmarks:3", seed=3
    )
    assert list(observe.parts) == ["surface:epicardium", "surface:endocardium", "displacement"]
    rng = np.random.default_rng(0)
    data = {name: rng.normal(size=shape) for name, shape in observe.shapes.items()}
    data["surface:epicardium"][2] = np.nan
    for file in ("d.csv", "d.nc"):
        write_data(tmp_path / file, observe, data)
        back, values = read_measurements(ventricle, tmp_path / file)[:2]
        assert set(values) == set(data)
        for name in data:
            np.testing.assert_array_equal(values[name], data[name])
            np.testing.assert_allclose(
                back.parts[name].points, observe.parts[name].points, atol=1e-12
            )
    again = observations_from_json(ventricle, json.loads(json.dumps(observe.to_json())))
    for name, part in again.parts.items():
        np.testing.assert_allclose(part.points, observe.parts[name].points, atol=1e-12)
    sites = observe.sites("surface:endocardium")
    assert sites.positions.shape == (4, 3)
    assert not sites.component.any()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda s: parse_observation(s, "surface:epicardium"), "give surface:FACETSET:N"),
        (lambda s: parse_observation(s, "surface:skin:4"), "facet set 'skin' is not in the mesh"),
        (lambda s: parse_observation(s, "surface:epicardium:x"), "'x' is not a number of surface"),
        (lambda s: surface_points(s, "epicardium", [[0.0, 0.0, 0.0]]), "mm away from 'epicardium'"),
        (lambda s: surface_points(s, "epicardium", [[np.nan] * 3]), r"shape \(1, 3\); .*finite"),
    ],
)
def test_what_cannot_be_observed(ventricle, make, message):
    with pytest.raises(InputError, match=message) as caught:
        make(ventricle)
    assert "\n" not in str(caught.value)
