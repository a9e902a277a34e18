"""Terms integrated out, made diagonal once or eliminated anew, against dense covariances."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_normal

import calibrate as cal
from calibrate.model_error.algebra import check_algebra, marginalised
from calibrate.model_error.marginal import ModelError, Term, inferred_size
from emulator.core.errors import InputError

MEANS = {"a": jnp.array([1.0, -2.0]), "b": jnp.array([[3.0, 0.5], [1.5, -1.0]])}
RESIDUAL = {"a": jnp.array([0.3, 0.1]), "b": jnp.array([[-0.2, 0.4], [0.0, 0.7]])}
FLAT, R = (np.concatenate([np.ravel(d["a"]), np.ravel(d["b"])]) for d in (MEANS, RESIDUAL))
RNG = np.random.default_rng(1)
SIZE = 0.4  # where one is inferred
KNOWN = Term(RNG.normal(size=(3, 6)), names=("k0", "k1", "k2"))
GAIN = Term(RNG.normal(size=(1, 6)), 0.3 * RNG.normal(size=(1, 6)), names=("gain",))
SIZED = Term(RNG.normal(size=(4, 6)), size=inferred_size("size", 0.5), names=tuple("abcd"))
CURVE = replace(SIZED, shares=0.3 * RNG.normal(size=(4, 6)))
SIZES = (0.4, 0.4, 1.0, 0.4)  # of CURVE in rows of which the third has a known size
LISTS = {
    "known": [KNOWN],
    "shares": [GAIN],
    "sized": [SIZED],
    "known and sized": [KNOWN, SIZED],
    "known and shares": [KNOWN, GAIN, replace(KNOWN, modes=2.0 * KNOWN.modes)],
    "sized shares": [CURVE],
    "all of a measurement": [GAIN, SIZED, KNOWN, CURVE],
}


@pytest.fixture(scope="module", params=["correlated noise", "independent noise"])
def information(request):
    half = np.random.default_rng(0).normal(size=(6, 6))
    W = half @ half.T + np.eye(6)
    return W if request.param == "correlated noise" else np.diagonal(W)


def whole(information):
    return np.diag(information) if information.ndim == 1 else information


def dense(terms, size):
    """The covariance that the terms add, by hand."""
    S = np.zeros((6, 6))
    for term in terms:
        V = term.modes if term.shares is None else term.modes + term.shares * FLAT
        if term.size is not None:
            V = V * size
        S += V.T @ V
    return S


@pytest.mark.parametrize("terms", LISTS.values(), ids=LISTS)
@pytest.mark.parametrize("size", [0.0, 0.4, 2.0])
def test_the_ratio_and_the_information_are_those_of_dense_covariances(terms, information, size):
    error, C = marginalised(terms, information), np.linalg.inv(whole(information))
    S = C + dense(terms, size)
    wanted = [multivariate_normal(np.zeros(6), each).logpdf(R) for each in (S, C)]
    found = float(error.log_ratio(size, RESIDUAL, MEANS))
    assert found == pytest.approx(wanted[0] - wanted[1], rel=1e-9, abs=1e-12)
    left = error.information_left(jnp.asarray(information), size, MEANS)
    np.testing.assert_allclose(whole(np.asarray(left)), np.linalg.inv(S), atol=1e-9)


@pytest.mark.parametrize("terms", LISTS.values(), ids=LISTS)
def test_terms_that_were_integrated_out_may_be_so_again(terms, information):
    once = marginalised(terms, information)
    again = marginalised(once.declarations, information)
    found, wanted = (e.log_ratio(SIZE, RESIDUAL, MEANS) for e in (again, once))
    assert float(found) == pytest.approx(float(wanted), rel=1e-9)


@pytest.mark.parametrize("terms", LISTS.values(), ids=LISTS)
def test_what_is_kept_is_restored(terms, information):
    error = marginalised(terms, information)
    back = ModelError.restore(error.arrays(), error.words)
    assert back.fingerprint == error.fingerprint
    assert back.words == error.words
    assert back.priors.keys() == error.priors.keys()
    np.testing.assert_array_equal(
        back.log_ratio(SIZE, RESIDUAL, MEANS), error.log_ratio(SIZE, RESIDUAL, MEANS)
    )
    arrays = error.arrays()
    for name in ("weights", "modes"):
        with pytest.raises(TypeError, match="missing"):
            ModelError.restore({n: v for n, v in arrays.items() if n != name}, error.words)
    with pytest.raises(TypeError, match="colour"):
        ModelError.restore({**arrays, "colour": np.zeros(1)}, error.words)


def test_arrays_have_the_names_that_saved_errors_have():
    """Files of earlier versions are read by these names."""
    diagonal, varying = ["weights", "strength", "modes"], ["modes", "shares", "sized"]
    W = np.ones(6)

    def names(*terms):
        return list(marginalised(terms, W).arrays())

    assert names(KNOWN) == [*diagonal, "mixing"]
    assert names(SIZED) == [*diagonal, "mixing", *(f"sized_{n}" for n in diagonal), "size_scale"]
    of_varying = [f"varying_{n}" for n in (*varying, "information")]
    assert names(KNOWN, CURVE) == [*diagonal, "mixing", *of_varying, "size_scale"]
    assert names(GAIN) == [*diagonal, "mixing", *of_varying]
    # Rows of an inferred size may be between others.
    arrays = marginalised([GAIN, CURVE], W).arrays() | {
        "varying_sized": np.array([0.0, 1, 1, 0, 1])
    }
    words = marginalised([CURVE], W).words
    back = ModelError.restore(arrays, words)
    V = back.terms[1].at(0.4, jnp.asarray(FLAT))
    kept = [GAIN.at(1.0, FLAT), *(size * CURVE.at(1.0, FLAT)[k] for k, size in enumerate(SIZES))]
    np.testing.assert_allclose(V, np.vstack(kept))
    assert back.fingerprint == ModelError.restore(back.arrays(), words).fingerprint


@pytest.mark.parametrize("name", ["known and sized", "all of a measurement", "sized shares"])
def test_it_is_differentiable_and_batched(name, information):
    terms = LISTS[name]
    error = marginalised(terms, information)
    sizes = SIZE + jnp.linspace(-0.2, 0.2, 5)

    def ratio(x):
        return error.log_ratio(x, RESIDUAL, MEANS)

    slopes = jax.jit(jax.vmap(jax.grad(ratio)))(sizes)
    for x, slope in zip(sizes, slopes, strict=True):
        by_differences = (ratio(x + 1e-5) - ratio(x - 1e-5)) / 2e-5
        np.testing.assert_allclose(slope, by_differences, rtol=1e-5, atol=1e-8)


@pytest.mark.parametrize("name", ["known and sized", "all of a measurement", "known and shares"])
def test_replicates_and_the_largest_errors_have_the_covariance(name):
    terms = LISTS[name]
    error = marginalised(terms, np.ones(6))
    keys = jax.random.split(jax.random.key(0), 40_000)
    drawn = jax.vmap(lambda key: error.draw(key, SIZE, MEANS))(keys)
    flat = np.concatenate([np.reshape(drawn[n] - MEANS[n], (len(keys), -1)) for n in MEANS], axis=1)
    S = dense(terms, SIZE)
    np.testing.assert_allclose(np.cov(flat.T), S, atol=0.02 * np.abs(S).max())
    largest = error.largest(MEANS)
    wanted = dense(terms, 1.5)  # three scales of its prior
    np.testing.assert_allclose(largest.T @ largest, wanted, atol=1e-9 * np.abs(wanted).max())


def test_no_errors_change_nothing(information):
    none = ModelError()
    assert float(none.log_ratio(1.0, RESIDUAL, MEANS)) == 0.0
    assert none.information_left(information, 1.0, MEANS) is information
    drawn = none.draw(jax.random.key(0), 1.0, MEANS)
    for name, mean in MEANS.items():
        np.testing.assert_array_equal(drawn[name], mean)
    assert none.largest(MEANS).shape == (0, 6)
    assert not none.priors
    assert not none.names


@pytest.mark.parametrize(
    ("terms", "reason"),
    [
        ([KNOWN, SIZED], "the size 'size' is inferred"),
        ([GAIN], "some are shares of what is predicted"),
    ],
)
def test_unknowns_of_errors_that_vary_are_not_told(terms, reason):
    with pytest.raises(InputError, match=f"what is known of errors: {reason}"):
        marginalised(terms, np.ones(6)).unknowns(RESIDUAL)


HEAVY, INFERRED = cal.StudentTNoise(4.0, scale=0.1), cal.GaussianNoise(sd_scale=0.1)


@pytest.mark.parametrize(
    ("noise", "sizes", "needs", "message"),
    [
        (HEAVY, (), {}, "e: the noise of volume must be Gaussian; it is student_t"),
        (HEAVY, (), {"gaussian": False}, None),
        (INFERRED, (), {}, "e: the noise of volume must be of known sd; noise_sd is inferred"),
        (INFERRED, (), {"known": False}, None),
        (cal.GaussianNoise(sd=0.1), (SIZED.unknown_size,), {}, None),
        (
            cal.GaussianNoise(sd=0.1),
            (SIZED.unknown_size, replace(SIZED, size=inferred_size("b", 2.0)).unknown_size),
            {},
            "e: the size 'b' is inferred .scale 2. and the size 'size' is inferred .scale 0.5.; "
            "only one size can be unknown, by one name and scale",
        ),
    ],
)
def test_a_missing_property_has_one_wording(noise, sizes, needs, message):
    if message is None:
        check_algebra("e", {"volume": noise}, sizes, **needs)
        return
    with pytest.raises(InputError, match=message) as refusal:
        check_algebra("e", {"volume": noise}, sizes, **needs)
    assert "\n" not in str(refusal.value)
