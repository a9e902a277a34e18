"""Systematic errors and loading curves, against dense multivariate normals."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import multivariate_normal

import calibrate as cal
from calibrate.model_error.kinds import read_systematic
from calibrate.model_error.systematic import (
    Systematic,
    curve_correlation,
    curve_modes,
)
from calibrate.noise import information_about_means
from emulator.core.errors import InputError
from linear_support import linear_forward
from scene_support import block

SD = 0.1
NODES = [3, 11, 20]


@pytest.fixture(scope="module")
def model():
    scene = block()
    seen = cal.nodal_displacements(scene, NODES)
    observe = {"displacement@a": seen, "displacement@b": seen}
    return cal.model(linear_forward(scene), observe, cal.GaussianNoise(sd=SD))


def positions(model):
    nodes = model.forward.scene.mesh.nodes[NODES]
    return {"displacement@a": nodes, "displacement@b": nodes + 0.3}


@pytest.fixture(scope="module")
def errors(model):
    camera = cal.model_error.rigid_motion(
        "camera", {"displacement@b": positions(model)["displacement@b"]}, 0.5, (1.0, 2.0, 0.0)
    )
    return camera, cal.model_error.placement(
        "pin", tuple(model.observe.parts), np.full((3, 3), 0.2)
    )


def dense(model, errors):
    """Covariance of all data, in the observations' order."""
    parts = list(model.observe.parts)
    rows = []
    for error in errors:
        for k in range(len(error.names)):
            zeros = np.zeros((3, 3))
            rows.append(
                np.concatenate([np.ravel(error.modes.get(n, [zeros] * 99)[k]) for n in parts])
            )
    V = np.array(rows)
    return SD**2 * np.eye(V.shape[1]) + V.T @ V, V


def some_data(model, seed=0):
    rng = np.random.default_rng(seed)
    return {name: jnp.asarray(0.3 * rng.normal(size=(3, 3))) for name in model.observe.parts}


DRAW = {"mu": jnp.asarray(3.0), "lam": jnp.asarray(4.0)}


def test_the_likelihood_is_that_of_the_dense_covariance(model, errors):
    whole, data = cal.with_systematic(model, *errors), some_data(model)
    means, _ = model.predict(DRAW)
    C, _ = dense(model, errors)
    residual = np.concatenate([np.ravel(data[n] - means[n]) for n in model.observe.parts])
    expected = multivariate_normal(np.zeros(len(C)), C).logpdf(residual)
    assert float(whole.map_log_likelihood(DRAW, data)) == pytest.approx(expected, rel=1e-10)
    # FEM's data has them, too.
    by_fem = whole.log_likelihood(DRAW, means, data)
    assert float(by_fem) == pytest.approx(expected, rel=1e-10)


def test_its_unknowns_given_the_data_are_conditional_normals(model, errors):
    whole, data = cal.with_systematic(model, *errors), some_data(model)
    means, _ = model.predict(DRAW)
    C, V = dense(model, errors)
    residual = np.concatenate([np.ravel(data[n] - means[n]) for n in model.observe.parts])
    mean, covariance = whole.error.unknowns({n: data[n] - means[n] for n in data})
    np.testing.assert_allclose(mean, V @ np.linalg.solve(C, residual), atol=1e-10)
    np.testing.assert_allclose(covariance, np.eye(len(V)) - V @ np.linalg.solve(C, V.T), atol=1e-10)
    assert whole.error.names[:2] == ("camera shift x", "camera shift y")
    assert whole.error.names[6] == "pin 0,0"


def test_replicates_have_its_covariance(model, errors):
    whole = cal.with_systematic(model, *errors)
    means, _ = model.predict(DRAW)
    keys = jax.random.split(jax.random.key(0), 20_000)
    drawn = jax.vmap(lambda key: whole.means_with_errors(key, DRAW, means))(keys)
    flat = np.concatenate(
        [np.reshape(drawn[n] - means[n], (len(keys), -1)) for n in model.observe.parts], axis=1
    )
    C, _ = dense(model, errors)
    np.testing.assert_allclose(np.cov(flat.T), C - SD**2 * np.eye(len(C)), atol=0.015)


def test_information_left_is_the_inverse_of_the_dense_covariance(model, errors):
    whole = cal.with_systematic(model, *errors)
    means, _ = model.predict(DRAW)
    C, _ = dense(model, errors)
    information = information_about_means(model.noise, means)
    left = whole.error.information_left(information, 1.0, means)
    np.testing.assert_allclose(left, np.linalg.inv(C), atol=1e-8)


def test_a_camera_that_turned_is_told_from_material(model):
    """Rotated data, exactly: the angle comes out, and the likelihood does not mind."""
    at = positions(model)
    centre = at["displacement@b"].mean(axis=0)
    turn = Rotation.from_rotvec(np.deg2rad([0.0, 1.5, 0.0])).as_matrix()
    means, _ = model.predict(DRAW)
    seen = (at["displacement@b"] - centre) @ turn.T + centre
    data = {**means, "displacement@b": means["displacement@b"] + seen - at["displacement@b"]}
    camera = cal.model_error.rigid_motion(
        "camera", {"displacement@b": at["displacement@b"]}, 0.5, 2.0
    )
    quiet = cal.model(model.full, dict(model.observe.parts), cal.GaussianNoise(sd=1e-3))
    whole = cal.with_systematic(quiet, camera)
    told, covariance = whole.error.unknowns({n: data[n] - means[n] for n in means})
    angle = dict(zip(whole.error.names, 2.0 * told, strict=True))
    assert angle["camera turn y"] == pytest.approx(1.5, abs=0.02)
    assert abs(angle["camera turn x"]) < 0.02
    assert np.all(np.diag(covariance) < 0.01)


def test_data_may_be_as_far_off_as_its_errors_are(model):
    """Ten millimetres where the body moves by hundredths: another unit, or a camera that moved."""
    data = {name: np.full((3, 3), 10.0) for name in model.observe.parts}
    with pytest.raises(InputError, match="larger than predicted"):
        model.check_data(data)
    camera = cal.model_error.rigid_motion("camera", positions(model), 10.0, 0.0)
    assert cal.with_systematic(model, camera).check_data(data).keys() == data.keys()


def test_nothing_unknown_changes_nothing(model):
    still = cal.model_error.rigid_motion("camera", positions(model), 0.0, 0.0)
    whole, data = cal.with_systematic(model, still), some_data(model)
    expected = float(model.map_log_likelihood(DRAW, data))
    assert float(whole.map_log_likelihood(DRAW, data)) == pytest.approx(expected, rel=1e-14)


def test_a_placement_is_one_offset_a_number_shared_by_states():
    sd = np.array([[0.1, 0.2, 0.3]])
    pins = cal.model_error.placement("pin", ("a", "b"), sd)
    assert pins.names == ("pin 0,0", "pin 0,1", "pin 0,2")
    for modes in pins.modes.values():
        np.testing.assert_array_equal(modes[:, 0], np.diag(sd[0]))


def test_what_changes_the_likelihood_changes_the_fingerprint(model, errors):
    error = cal.with_systematic(model, *errors).error
    assert error.fingerprint == cal.with_systematic(model, *errors).error.fingerprint
    assert error.fingerprint != cal.with_systematic(model, errors[0]).error.fingerprint


def test_errors_that_are_added_one_by_one_are_those_added_together(model, errors):
    together, data = cal.with_systematic(model, *errors), some_data(model)
    one_by_one = cal.with_systematic(cal.with_systematic(model, errors[0]), errors[1])
    expected = float(together.map_log_likelihood(DRAW, data))
    assert float(one_by_one.map_log_likelihood(DRAW, data)) == pytest.approx(expected, rel=1e-10)
    means, _ = model.predict(DRAW)
    residual = {n: data[n] - means[n] for n in data}
    for found, wanted in zip(
        one_by_one.error.unknowns(residual), together.error.unknowns(residual), strict=True
    ):
        np.testing.assert_allclose(found, wanted, atol=1e-10)
    assert one_by_one.error.names == together.error.names


def test_what_cannot_be(model, errors):
    with pytest.raises(InputError, match="'volume' is not observed; observed: displacement@a"):
        cal.with_systematic(model, Systematic(("bias",), {"volume": np.ones((1,))}))
    with pytest.raises(InputError, match=r"modes of 'displacement@a' have shape \(1, 2\)"):
        cal.with_systematic(model, Systematic(("bias",), {"displacement@a": np.ones((1, 2))}))
    with pytest.raises(InputError, match="give one or more"):
        cal.with_systematic(model)
    learned = cal.model(model.full, dict(model.observe.parts), cal.GaussianNoise(sd_scale=1.0))
    with pytest.raises(InputError, match="must be of known sd; noise_sd is inferred"):
        cal.with_systematic(learned, *errors)
    sized = Systematic(("a",), {"displacement@a": np.ones((1, 3, 3))}, ("lam", 0.1))
    with pytest.raises(InputError, match="a size is called 'lam', as an unknown of the model"):
        cal.with_systematic(model, sized)
    with pytest.raises(InputError, match="camera: sds -1 mm"):
        cal.model_error.rigid_motion("camera", positions(model), -1, 0.0)


AT = np.array([0.0, 0.1, 0.3, -0.2])
VALUES = np.array([1.0, 2.0, 4.0, -1.5])


def curve_covariance(at, values, length, share=0.0, sd=0.0, constant=0.0):
    return (share**2 * np.outer(values, values) + sd**2) * curve_correlation(at, length, constant)


def test_one_entry_by_hand():
    """Points 0.1 and 0.3 apart by one length: (1 + sqrt 3) exp(-sqrt 3) of Matern's kernel."""
    C = curve_covariance(AT, VALUES, 0.2, share=0.1, sd=0.05, constant=0.25)
    near = (1.0 + np.sqrt(3.0)) * np.exp(-np.sqrt(3.0))
    assert C[1, 2] == pytest.approx((0.01 * 8.0 + 0.0025) * (0.25 + 0.75 * near))
    assert C[2, 2] == pytest.approx(0.01 * 16.0 + 0.0025)


@pytest.mark.parametrize("constant", [0.0, 0.5])
def test_modes_make_the_covariance(constant):
    """Of sd 1; as shares of values they make that of a share."""
    V = curve_modes(AT, 0.2, constant=constant)
    C = curve_covariance(AT, VALUES, 0.2, sd=1.0, constant=constant)
    np.testing.assert_allclose(V.T @ V, C, atol=1e-6)
    C = curve_covariance(AT, VALUES, 0.2, share=0.1, constant=constant)
    share = 0.1 * V * VALUES
    np.testing.assert_allclose(share.T @ share, C, atol=1e-6)


def test_a_curve_that_is_off_as_one_has_one_mode():
    assert curve_modes(AT, 0.2, constant=1.0).shape == (1, 4)


def test_what_no_curve_can_be():
    curve = {"kind": "curve", "of": "a", "along": "b"}
    with pytest.raises(InputError, match="length is 0.0; it must be above 0"):
        read_systematic("e", {**curve, "length": 0, "constant": 0.5})
    with pytest.raises(InputError, match=r"constant is 1.5; it is a part, 0 to 1"):
        read_systematic("e", {**curve, "length": 0.1, "constant": 1.5})


def test_several_curves_at_once():
    at, lengths = np.stack([AT, 2.0 * AT]), np.array([0.2, 0.4])[:, None, None]
    found = curve_correlation(at, lengths, 0.5)
    for C, a, length in zip(found, at, (0.2, 0.4), strict=True):
        one = curve_correlation(a, length, 0.5)
        np.testing.assert_allclose(C, one, rtol=1e-14)
