"""Strains against E = (F^T F - I)/2 of homogeneous deformations, by NumPy."""

import json
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr

import emulator as em
from calibrate.measurements import (
    landmarks,
    observations,
    observations_from_json,
    parse_observation,
    segment_strains,
    spread_landmarks,
    strains,
)
from calibrate.measurements.data import read_measurements, write_data
from calibrate.measurements.location import locate
from calibrate.measurements.strain import COMPONENTS, local_directions
from emulator.core.errors import InputError
from emulator.fem.fields import element_fields
from emulator.geometry.discretisation import quadrature_points
from emulator.geometry.heart_wall import aha_segments
from scene_support import rotation

EVERY = tuple(COMPONENTS)


@pytest.fixture(scope="module")
def curved():
    """A ventricle of quadratic elements with curved walls, and fibres at their points."""
    return em.scenes.left_ventricle(rings=4, around=8, layers=1, grading=1.0)


@pytest.fixture(params=["linear", "quadratic"])
def scene(request, ventricle, curved):
    return ventricle if request.param == "linear" else curved


def seen(observe, scene, u):
    return np.asarray(jax.jit(lambda u: observe(u, None))(np.asarray(u)[..., observe.nodes, :]))


def directions_at(scene, components, points):
    """Unit vectors (d, c, 3): in an element linear through those at its quadrature points."""
    element, inside = locate(scene.mesh, points)
    e = local_directions(scene, components)[element]
    if scene.mesh.order == 1:
        return e[:, 0]
    corners = np.linalg.solve(quadrature_points(2), e.reshape(len(e), 4, -1)).reshape(e.shape)
    here = np.einsum("da,daci->dci", inside, corners)
    return here / np.linalg.norm(here, axis=-1, keepdims=True)


def test_a_homogeneous_deformation_has_its_strain_everywhere(scene, strict):
    H = 0.2 * np.random.default_rng(0).normal(size=(3, 3))
    F = np.eye(3) + H
    E = 0.5 * (F.T @ F - np.eye(3))
    u = scene.mesh.nodes @ H.T + [1.0, 2.0, 3.0]
    points = spread_landmarks(scene, 12, seed=1)
    along = lambda e: np.einsum("...ci,ij,...cj->...c", e, E, e)
    found = seen(strains(scene, EVERY, points), scene, u)
    np.testing.assert_allclose(found, along(directions_at(scene, EVERY, points)), atol=1e-12)
    # Averaged over segments, each quadrature point with its volume.
    expected = along(local_directions(scene, EVERY))
    labels, volume = aha_segments(scene.mesh), scene.discretisation.weights
    means = [
        np.einsum("mqc,mq->c", expected[labels == s], volume[labels == s])
        / volume[labels == s].sum()
        for s in range(1, 18)
    ]
    found = seen(segment_strains(scene, EVERY), scene, u)
    np.testing.assert_allclose(found, means, atol=1e-12)
    np.testing.assert_allclose(seen(segment_strains(scene, EVERY, [9, 2]), scene, u), np.array(means)[[8, 1]], atol=1e-12)  # fmt: skip


def test_rotations_leave_no_strain(scene):
    u = scene.mesh.nodes @ (rotation() - np.eye(3)).T + [5.0, -3.0, 1.0]
    points = spread_landmarks(scene, 12, seed=1)
    for observe in (strains(scene, EVERY, points), segment_strains(scene, EVERY)):
        np.testing.assert_allclose(seen(observe, scene, u), 0.0, atol=1e-12)
        assert np.abs(seen(observe, scene, 1.1 * u)).max() > 0.01


def test_the_basis_is_orthonormal_and_points_where_its_names_say(scene):
    found = local_directions(scene, EVERY)
    grid = scene.discretisation
    assert found.shape == (*grid.weights.shape, len(EVERY), 3)
    e = dict(zip(EVERY, np.moveaxis(found.reshape(-1, len(EVERY), 3), 1, 0), strict=True))
    for one, two in (("fibre", "cross_fibre"), ("circumferential", "longitudinal"),
                     ("longitudinal", "radial"), ("circumferential", "radial"),
                     ("cross_fibre", "radial")):  # fmt: skip
        np.testing.assert_allclose(np.sum(e[one] * e[two], axis=1), 0.0, atol=1e-9)
    for direction in e.values():
        np.testing.assert_allclose(np.linalg.norm(direction, axis=1), 1.0)
    X = np.einsum("qa,mai->mqi", grid.values, scene.mesh.nodes[scene.mesh.elements]).reshape(-1, 3)
    outward = X * [1.0, 1.0, 0.0]
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    wall = X[:, 2] > np.median(X[:, 2])  # where the wall is nearly upright
    assert np.sum(e["radial"] * outward, axis=1)[wall].min() > 0.7
    assert e["longitudinal"][wall, 2].min() > 0.7
    around = np.cross([0.0, 0.0, 1.0], outward)
    assert np.sum(e["circumferential"] * around, axis=1)[wall].min() > 0.9


@pytest.mark.parametrize("told", ["rule", "base"])
def test_the_basis_turns_with_the_body(scene, told):
    """Its axis is the fibre rule's, or the normal of the base where fibres are given."""
    R = rotation()
    mesh = replace(scene.mesh, nodes=scene.mesh.nodes @ R.T)
    fibres = scene.fibres_at_points @ R.T
    rule = replace(scene.fibre_rule, axis=tuple(2.0 * R[:, 2])) if told == "rule" else None
    assert rule is not None or "base" in mesh.facet_sets
    turned = replace(scene, mesh=mesh, fibres=fibres, fibre_rule=rule, origin={})
    found = local_directions(turned, EVERY)
    np.testing.assert_allclose(found, local_directions(scene, EVERY) @ R.T, atol=1e-6)


def test_strains_agree_with_the_fields_of_fem(ventricle):
    """Another path: whole tensors of every element, for a field that is not homogeneous."""
    u = 0.3 * np.random.default_rng(3).normal(size=ventricle.mesh.nodes.shape)
    E = element_fields(ventricle, jnp.asarray(u), ventricle.centre)["green_lagrange"]
    points = spread_landmarks(ventricle, 9, seed=2)
    k = locate(ventricle.mesh, points)[0]
    f = ventricle.fibres[k]
    found = seen(strains(ventricle, "fibre", points), ventricle, u)[:, 0]
    np.testing.assert_allclose(found, np.einsum("di,dij,dj->d", f, E[k], f), atol=1e-12)


def test_quadratic_strains_against_differences_of_the_field(curved):
    """Directional derivatives of the interpolated field, within one element."""
    rng = np.random.default_rng(3)
    u = 0.3 * rng.normal(size=curved.mesh.nodes.shape)
    X = curved.mesh.nodes[curved.mesh.elements[:, :4]].mean(axis=1)[[5, 40, 100]]
    e = directions_at(curved, ("fibre",), X)[:, 0]
    step = 1e-4
    ends = [seen(landmarks(curved, X + s * step * e), curved, u) for s in (1.0, -1.0)]
    d = (ends[0] - ends[1]) / (2.0 * step)
    expected = np.sum(e * d, axis=1) + 0.5 * np.sum(d * d, axis=1)
    found = seen(strains(curved, "fibre", X), curved, u)[:, 0]
    np.testing.assert_allclose(found, expected, rtol=1e-6)


def test_words_files_json_and_batches(ventricle, tmp_path):
    observe = parse_observation(
        ventricle, "strain:fibre,radial:5+segment_strain:circumferential+landmarks:3", seed=1
    )
    assert {n: p.shape for n, p in observe.parts.items()} == {
        "strain": (5, 2), "segment_strain": (17, 1), "displacement": (3, 3),
    }  # fmt: skip
    u = np.random.default_rng(0).normal(size=(2, 1, *ventricle.mesh.nodes.shape))
    data = observe(jnp.asarray(u[:, :, observe.nodes]), jnp.zeros((2, 1, 5)))
    for name, part in observe.parts.items():
        for k in range(2):
            np.testing.assert_allclose(data[name][k], seen(part, ventricle, u[k, 0]), rtol=1e-12)
    one = {name: np.abs(np.asarray(values[0])) for name, values in data.items()}
    one["strain"][2] = one["strain"][4, 0] = np.nan
    for file in ("d.csv", "d.nc"):
        write_data(tmp_path / file, observe, one)
        back, values = read_measurements(ventricle, tmp_path / file)[:2]
        assert set(back.parts) == set(observe.parts)
        for name in one:
            np.testing.assert_array_equal(values[name], one[name])
            for one_way, other in zip(back.sites(name), observe.sites(name), strict=True):
                np.testing.assert_array_equal(one_way, other)
    again = observations_from_json(ventricle, json.loads(json.dumps(observe.to_json())))
    for name, part in again.parts.items():
        np.testing.assert_allclose(
            seen(part, ventricle, u[0, 0]), seen(observe.parts[name], ventricle, u[0, 0])
        )


def test_at_sites_of_segments_are_inside_them(ventricle):
    observe = segment_strains(ventricle, "radial")
    X, labels = (
        ventricle.mesh.nodes[ventricle.mesh.elements].mean(axis=1),
        aha_segments(ventricle.mesh),
    )
    for s, centre in zip(observe.segments, observe.points, strict=True):
        nearest = labels[np.argsort(np.linalg.norm(X - centre, axis=1))[:3]]
        assert s in nearest


def test_derivatives_are_those_of_the_strain(ventricle):
    observe = segment_strains(ventricle, "circumferential")
    rng = np.random.default_rng(0)
    u, v = (jnp.asarray(0.2 * rng.normal(size=(len(observe.nodes), 3))) for _ in range(2))
    _, slope = jax.jvp(lambda u: observe(u, None), (u,), (v,))
    step = 1e-5
    central = (observe(u + step * v, None) - observe(u - step * v, None)) / (2 * step)
    np.testing.assert_allclose(slope, central, rtol=1e-6, atol=1e-10)


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("strain:fibre", "'strain:fibre': give strain:COMPONENT,...:N; components: fibre, cross"),
        ("strain:fibre:many", "'many' is not a number of strain"),
        ("strain:helical:3", "strain along 'helical' is unknown; known: fibre, cross_fibre"),
        ("strain:fibre,fibre:3", "strain along 'fibre' is observed twice"),
        ("segment_strain", "give segment_strain:COMPONENT,...; components: fibre"),
    ],
)
def test_words_that_ask_for_nothing(ventricle, word, message):
    with pytest.raises(InputError, match=message) as caught:
        parse_observation(ventricle, word)
    assert "\n" not in str(caught.value)


def test_what_cannot_be_observed(ventricle, beam):
    with pytest.raises(InputError, match="'fibre': scene 'once_clamped_beam' has no fibres"):
        strains(beam, "fibre", [[5.0, 5.0, 5.0]])
    with pytest.raises(
        InputError, match="needs facet sets endocardium and epicardium; scene 'once"
    ):
        strains(beam, "radial", [[5.0, 5.0, 5.0]])
    with pytest.raises(InputError, match="lies outside the body"):
        strains(ventricle, "fibre", [[500.0, 0.0, 0.0]])
    with pytest.raises(InputError, match="segment 18 is unknown; there are 1 to 17"):
        segment_strains(ventricle, "fibre", [1, 18])
    with pytest.raises(InputError, match="segment 3 is observed twice"):
        segment_strains(ventricle, "fibre", [3, 3])
    observe = observations(segment_strains(ventricle, "fibre"))
    with pytest.raises(InputError, match="goes down to -20; a Green-Lagrange strain is above -0.5"):
        observe.check("segment_strain", np.full((17, 1), -20.0))
    with pytest.raises(InputError, match=r"shape \(16, 1\); the observation expects \(17, 1\)"):
        observe.check("segment_strain", np.zeros((16, 1)))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("segment,mean_E_circ\n1.5,0.1\n", "segment 1.5 is unknown"),
        ("segment,E_circ\n1,0.1\n", "column 'mean_E_circ' is missing"),
        ("x,y,z,E_circ\n0,0,900,0.1\n", "lies outside the body"),
        ("x,y,z,E_circ\n0,0,,0.1\n", "row 1, column 'z' is empty"),
        ("x,y,z,E_circ\n30,0,-20,-12\n", "goes down to -12"),
    ],
)
def test_files_that_are_wrong(ventricle, tmp_path, text, message):
    (tmp_path / "d.csv").write_text(text)
    with pytest.raises(InputError, match=message):
        read_measurements(ventricle, tmp_path / "d.csv")


@pytest.mark.parametrize(
    ("arrays", "said"),
    [
        ({"E_circ": 6, "E_rad": 5}, "components of strains have 6, 5 values"),
        ({"E_circ": 4, "E_rad": 6}, "components of strains have 4, 6 values"),
        ({"E_circ": 5, "E_rad": 5}, "6 points have 5 strains"),
        ({"E_circ": (), "E_rad": 6}, "components of strains have 1, 6 values"),
        (
            {"segment": 3, "mean_E_circ": 3, "mean_E_rad": 2},
            "components of strains have 3, 2 values",
        ),
        ({"segment": (3, 3), "mean_E_circ": 3}, "'segment' has shape (3, 3); give a row a point"),
        ({"segment": (), "mean_E_circ": 1}, "'segment' has shape (); give a row a point"),
        (
            {"position_strain": (6, 3, 3), "E_circ": 6},
            "'position_strain' has shape (6, 3, 3); give a row a point",
        ),
    ],
)
def test_netcdf_arrays_that_do_not_fit_are_told_in_one_line(ventricle, tmp_path, arrays, said):
    arrays = {name: np.zeros(shape) for name, shape in arrays.items()}
    if "E_circ" in arrays and "position_strain" not in arrays:
        mesh = ventricle.mesh
        arrays["position_strain"] = mesh.nodes[mesh.elements[:6]].mean(axis=1)
    variables = {
        name: ([f"{name}_{k}" for k in range(values.ndim)], values)
        for name, values in arrays.items()
    }
    xr.Dataset(variables).to_netcdf(tmp_path / "d.nc", engine="h5netcdf")
    with pytest.raises(InputError) as error:
        read_measurements(ventricle, tmp_path / "d.nc")
    assert str(error.value) == f"data file {tmp_path / 'd.nc'}: {said}"
