"""Errors that many numbers share, before data: dense covariances, and posteriors on grids."""

from dataclasses import replace

import numpy as np
import numpyro.distributions as dist
import pytest
from scipy.stats import halfnorm

import calibrate as cal
from calibrate.analysis.expected import expected_precision
from calibrate.analysis.identifiability import prior_table
from calibrate.model_error.systematic import Systematic, curve_correlation
from emulator.core.errors import InputError
from linear_support import about_zero, linear_forward
from scene_support import block

NODES, NOISE = [3, 11, 20], 0.1
SCENE = block()
FORWARD = linear_forward(SCENE)
A = FORWARD.matrix[NODES].reshape(-1, 2)


def displacements(prior, noise=NOISE, nodes=NODES, forward=FORWARD, **more):
    observe = cal.nodal_displacements(SCENE, nodes)
    noises = cal.GaussianNoise(sd=noise)
    return cal.model(forward, observe, noises, prior, check_scale=False, **more)


def curve(count, prior, noise=0.05):
    """lam itself, measured in ``count`` states along a curve of known mu."""
    names = [f"parameter:lam@{k}" for k in range(count)]
    return cal.model(
        FORWARD,
        dict.fromkeys(names, cal.MeasuredParameter(SCENE, "lam")),
        cal.GaussianNoise(sd=noise),
        prior,
        known={f"mu@{k}": 2.0 + k / count for k in range(count)},
        check_scale=False,
    )


CURVE = {"kind": "curve", "of": "parameter:lam", "along": "mu", "length": 0.4}
GAIN = {"kind": "gain", "of": "displacement", "share": 0.1}
BOTH = {name: dist.LogNormal(np.log(75.0), 0.3) for name in ("mu", "lam")}


def sds_of_dense(S, J, before):
    """Posterior sds relative to the prior's, of a linear map and a normal prior."""
    after = np.linalg.inv(J.T @ np.linalg.inv(S) @ J + np.linalg.inv(before))
    return np.sqrt(np.diagonal(after) / np.diagonal(before))


@pytest.mark.parametrize("size", [None, ("share", 0.5)])
def test_a_linear_map_has_the_dense_covariance(size):
    """S = C + V V^T + a^2 U U^T; a size that is inferred has each quantile of its prior."""
    prior = {"mu": dist.Normal(0.0, 20.0), "lam": dist.Normal(1.0, 30.0)}
    rng = np.random.default_rng(3)
    # Nearly changes of theta, by 5 mu and by 5 lam: what cannot be told from these.
    V, U = (5.0 * A[:, [k, k]].T + 1e-3 * rng.normal(size=(2, 9)) for k in (0, 1))
    known = Systematic(("a", "b"), {"displacement": V.reshape(2, 3, 3)})
    other = Systematic(("c", "d"), {"displacement": U.reshape(2, 3, 3)}, size)
    scene = about_zero(SCENE, "mu", "lam")
    bare = displacements(prior, forward=replace(FORWARD, scene=scene))
    found = expected_precision(
        cal.with_systematic(bare, known, other), at={"mu": 3.0, "lam": -4.0}
    )["sd"]
    before = np.cov(prior_table(bare), rowvar=False)
    noise = NOISE**2 * np.eye(9)
    sizes = [1.0] if size is None else halfnorm(scale=0.5).ppf((np.arange(32) + 0.5) / 32)
    wanted = [sds_of_dense(noise + V.T @ V + a**2 * U.T @ U, A, before) for a in sizes]
    np.testing.assert_allclose(list(found.values()), np.mean(wanted, axis=0), rtol=1e-8)
    # Noise alone would promise more.
    assert np.all(np.mean(wanted, axis=0) > 1.2 * sds_of_dense(noise, A, before))


def test_modes_follow_the_mean_of_each_set():
    """A gain of ten percent of what mu, lam predict: the dense covariance, in log theta."""
    model, at = displacements(BOTH), {"mu": 50.0, "lam": 90.0}
    found = expected_precision(model, at=at, systematic={"gain": GAIN})["sd"]
    theta = np.array(list(at.values()))
    g = A @ theta
    before = np.cov(np.log(prior_table(model)), rowvar=False)
    wanted = sds_of_dense(NOISE**2 * np.eye(9) + 0.01 * np.outer(g, g), A * theta, before)
    np.testing.assert_allclose(list(found.values()), wanted, rtol=1e-8)


@pytest.mark.slow
def test_sds_are_those_of_posteriors_of_data_with_a_gain():
    """Posteriors on a grid: the factor of simulated data integrated, C + 0.1^2 g g^T at each theta."""
    found = expected_precision(displacements(BOTH), systematic={"gain": GAIN}, data_sets=128)["sd"]
    rng, z = np.random.default_rng(2), np.linspace(-4.0, 4.0, 161)
    log_theta = np.log(75.0) + 0.3 * np.stack(np.meshgrid(z, z, indexing="ij"), -1).reshape(-1, 2)
    log_prior = -0.5 * np.sum(((log_theta - np.log(75.0)) / 0.3) ** 2, axis=1)
    g, sds = np.exp(log_theta) @ A.T, []
    strength = 0.01 * np.sum(g**2, axis=1) / NOISE**2
    for _ in range(200):
        exact = A @ (75.0 * np.exp(0.3 * rng.normal(size=2)))
        y = exact * (1.0 + 0.1 * rng.normal()) + NOISE * rng.normal(size=9)
        # The factor given theta is normal; what it leaves of the misfit, and its volume.
        b = 0.1 * np.sum(g * (y - g), axis=1) / NOISE**2
        misfit = np.sum((y - g) ** 2, axis=1) / NOISE**2 - b**2 / (1.0 + strength)
        log_weight = log_prior - 0.5 * (misfit + np.log1p(strength))
        weight = np.exp(log_weight - log_weight.max())
        weight /= weight.sum()
        sds.append(np.sqrt(weight @ (log_theta - weight @ log_theta) ** 2))
    np.testing.assert_allclose(list(found.values()), np.mean(sds, axis=0) / 0.3, rtol=0.06)


@pytest.mark.slow
def test_sds_are_those_of_posteriors_whose_share_is_inferred():
    """Six points of one curve; lam and the share on a grid."""
    words = {"law": {**CURVE, "share_scale": 0.1}}
    prior, count, noise = {"lam": dist.LogNormal(np.log(5.0), 0.5)}, 6, 0.05
    model = curve(count, prior, noise)
    found = expected_precision(model, systematic=words, data_sets=128)["sd"]["lam"]
    rng, at = np.random.default_rng(2), 2.0 + np.arange(count) / count
    shape = curve_correlation(at, 0.4)
    root = np.linalg.cholesky(shape)
    log_lam = np.log(5.0) + 0.5 * np.linspace(-4.0, 4.0, 401)
    shares = halfnorm(scale=0.1).ppf((np.arange(150) + 0.5) / 150)
    # In units of each lam, where data has S(share) = share^2 shape + (noise / lam)^2.
    lams, sds = np.exp(log_lam), []
    values, vectors = np.linalg.eigh(shape)
    S = shares[:, None, None] ** 2 * values + (noise / lams)[:, None] ** 2
    for _ in range(200):
        lam, share = 5.0 * np.exp(0.5 * rng.normal()), 0.1 * abs(rng.normal())
        y = lam + share * lam * root @ rng.normal(size=count) + noise * rng.normal(size=count)
        off = (y / lams[:, None] - 1.0) @ vectors
        logs = -0.5 * np.sum(off**2 / S + np.log(S), axis=2) - count * log_lam
        weight = np.exp(logs - logs.max()).sum(axis=0)
        weight *= np.exp(-0.5 * ((log_lam - np.log(5.0)) / 0.5) ** 2)
        weight /= weight.sum()
        sds.append(np.sqrt(weight @ (log_lam - weight @ log_lam) ** 2))
    # Told: importance sampling about the lam of each data set, sizes by quantiles.
    assert found == pytest.approx(np.mean(sds) / 0.5, rel=0.1)
    # Noise alone would promise a sd of half a percent.
    assert np.mean(sds) > 0.05


@pytest.mark.parametrize(
    ("at", "share"),
    [({"mu": 60.0, "lam": 80.0}, 1e-9), pytest.param(None, 0.0, marks=pytest.mark.slow)],
)
def test_errors_of_no_size_change_nothing(at, share):
    model = displacements(BOTH)
    bare = expected_precision(model, at, data_sets=4)["sd"]
    words = {"e": {**GAIN, "share": share}}
    found = expected_precision(model, at, systematic=words, data_sets=4)["sd"]
    assert found == pytest.approx(bare, rel=1e-12)


@pytest.mark.parametrize("nodes", [pytest.param([3], marks=pytest.mark.slow), list(range(20))])
def test_a_gain_of_ten_percent_leaves_ten_percent_however_many_points(nodes):
    """A scale of all data, beside noise of a thousandth of it."""
    matrix = FORWARD.matrix.copy()
    matrix[..., 1] = 0.0
    of_mu = type(FORWARD)(SCENE, FORWARD.nodes, matrix, FORWARD.shift)
    prior = {"mu": dist.LogNormal(np.log(75.0), 1.0)}
    model = displacements(prior, 1e-3, nodes, of_mu, known={"lam": 70.0})
    sd = expected_precision(model, systematic={"gain": GAIN}, data_sets=16)["sd"]["mu"]
    # log mu of a Gaussian of ten percent about mu: skewed, so somewhat above a tenth.
    assert 0.1 < sd < 0.108


def test_forty_points_of_a_curve_are_not_forty_facts_before_data_either():
    prior, at = {"lam": dist.LogNormal(np.log(5.0), 1.0)}, {"lam": 5.0}
    words = {"law": {**CURVE, "length": 1e3, "share": 0.1}}
    sds = [
        expected_precision(curve(count, prior), at=at, systematic=words)["sd"]["lam"]
        for count in (4, 40)
    ]
    before = float(np.log(prior_table(curve(4, prior))).var(ddof=1))
    # A hundredth is the noise of each point: forty facts would leave 0.0016.
    wanted = (1.0 / 0.1**2 + 1.0 / before) ** -0.5 / before**0.5
    np.testing.assert_allclose(sds, wanted, rtol=2e-3)


def test_errors_that_do_not_fit_are_refused():
    with pytest.raises(InputError, match="systematic 'e': of: 'volume' is not observed"):
        expected_precision(displacements(BOTH), systematic={"e": {**GAIN, "of": "volume"}})
    observe = cal.nodal_displacements(SCENE, NODES)
    heavy = cal.model(FORWARD, observe, cal.StudentTNoise(dof=4.0, scale=0.1), BOTH)
    with pytest.raises(InputError, match="must be Gaussian; it is student_t"):
        expected_precision(heavy, systematic={"e": GAIN})
