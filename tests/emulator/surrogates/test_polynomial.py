"""A polynomial as a part of an emulator."""

import jax
import jax.numpy as jnp
import numpy as np

from emulator.surrogates.polynomial import Polynomial, compressed, degrees_up_to, legendre, terms

RNG = np.random.default_rng(1)


def test_terms_by_their_number():
    for parameters, degree in ((1, 4), (2, 3), (5, 2)):
        assert len(degrees_up_to(parameters, degree)) == terms(parameters, degree)


def test_terms_are_numpys_products():
    degrees, x = degrees_up_to(2, 3), RNG.random((4, 2))
    for row, alpha in enumerate(degrees):
        expected = np.ones(4)
        for j, k in enumerate(alpha):
            unit = np.polynomial.legendre.Legendre.basis(k, domain=[0.0, 1.0])
            expected *= np.sqrt(2 * k + 1) * unit(x[:, j])
        np.testing.assert_allclose(legendre(x, degrees)[:, row], expected, rtol=1e-13)
    np.testing.assert_allclose(legendre(jnp.asarray(x), degrees), legendre(x, degrees), rtol=1e-13)


def test_fewer_modes_are_off_by_no_more_than_was_allowed():
    """Root mean square over box and nodes, by Gauss points."""
    degrees = degrees_up_to(2, 4)
    fields = RNG.normal(size=(15, 7, 3)) * 10.0 ** -np.arange(15)[:, None, None]
    whole = Polynomial(degrees, np.eye(15), fields)
    nodes, weights = np.polynomial.legendre.leggauss(6)
    x = jnp.asarray(np.stack(np.meshgrid(nodes, nodes), axis=-1).reshape(-1, 2) / 2.0 + 0.5)
    mass = np.outer(weights, weights).ravel() / 4.0
    for error in (1e-2, 1e-6, 0.0):
        found = compressed(degrees, fields, error)
        off = np.mean(np.sum(np.asarray(found(x) - whole(x)) ** 2, axis=-1), axis=-1)
        assert np.sqrt(mass @ off) <= error + 1e-14
        single = np.array_equal(found.modes, found.modes.astype(np.float32))
        assert single == (error > 1e-7)
    assert len(compressed(degrees, fields, 1e-2).modes) < 5
    assert len(compressed(degrees, 0.0 * fields, 1.0).modes) == 1


def test_the_cache_is_the_part_over_some_nodes():
    part = Polynomial(degrees_up_to(3, 2), RNG.normal(size=(10, 4)), RNG.normal(size=(4, 9, 3)))
    nodes, x = np.array([8, 0, 3]), jnp.array([0.2, 0.9, 0.5])
    cached = part.cache(nodes)
    found = cached.offset + jnp.tensordot(cached.coefficients(x), cached.modes, axes=1)
    np.testing.assert_allclose(found, part(x)[nodes], rtol=1e-13)
    assert jax.jit(cached.coefficients)(x).shape == (4,)
