"""Solves and their outcomes, in Python, inside ``jit``, ``vmap`` and loops."""

import ctypes
import signal
import time
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from emulator.core.errors import InputError
from emulator.fem.linear import Outcome, block_pattern, suitesparse, whole_blocks
from emulator.fem.linear import solve as solving
from emulator.fem.linear.solve import attempt, solve
from emulator.fem.linear.suitesparse import (
    INTERRUPTED,
    Api,
    CallFrame,
    api_version,
    check_api,
    factor_and_solve,
    register,
)


def test_a_large_factorisation_that_is_alone_has_all_cores(monkeypatch):
    """And no other: small ones, and those of several threads, have one thread each."""
    threads = lambda: {library.num_threads for library in suitesparse._blas()}
    monkeypatch.setattr(suitesparse, "cores", lambda: 2)
    suitesparse.prepare()
    with suitesparse.on_all_cores(suitesparse.LARGE):
        assert threads() == {2}
    assert threads() == {1}
    with suitesparse.on_all_cores(suitesparse.LARGE - 1):
        assert threads() == {1}
    with suitesparse.keeping_factors(2), suitesparse.on_all_cores(suitesparse.LARGE):
        assert threads() == {1}


def matrix(size=12, shift=4.0, *, symmetric=True, seed=0):
    """Dense matrix, pattern, values and right-hand side."""
    rng = np.random.default_rng(seed)
    groups = [whole_blocks(np.arange(size // 3)[None]), whole_blocks(np.arange(size // 6)[None])]
    pattern = block_pattern(groups, np.arange(size), symmetric=symmetric)
    A = rng.normal(size=(size, size))
    A = (A + A.T if symmetric else A) + shift * np.eye(size)
    return (
        A,
        pattern,
        jnp.asarray(A[pattern.rows, pattern.columns]),
        jnp.asarray(rng.normal(size=size)),
    )


@pytest.mark.parametrize("shift", [20.0, 0.0])
@pytest.mark.parametrize("symmetric", [True, False])
def test_solutions_and_derivatives_are_those_of_the_dense_matrix(shift, symmetric):
    A, pattern, values, b = matrix(shift=shift, symmetric=symmetric)
    ours = partial(solve, pattern)
    expected = np.linalg.solve(A, b)
    for found in (ours(values, b), jax.jit(ours)(values, b)):
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)
    both = jnp.stack([b, 2.0 * b], axis=1)
    np.testing.assert_allclose(ours(values, both)[:, 1], 2.0 * expected, rtol=1e-9, atol=1e-9)
    in_rows = jax.vmap(ours, in_axes=(None, 0))(values, both.T)
    np.testing.assert_allclose(in_rows[1], 2.0 * expected, rtol=1e-9, atol=1e-9)
    matrices = jax.jit(jax.vmap(ours))(jnp.stack([values, 2.0 * values]), both.T)
    np.testing.assert_allclose(matrices[1], expected, rtol=1e-9, atol=1e-9)

    # d/db (c . x) = A^-T c, and d/dA_ij = -(A^-T c)_i x_j, twice over where A_ij is also A_ji.
    c = np.linspace(0.0, 1.0, len(b))
    by_values, by_rhs = jax.jit(jax.grad(lambda v, r: c @ ours(v, r), argnums=(0, 1)))(values, b)
    adjoint = np.linalg.solve(A.T, c)
    slope = -np.outer(adjoint, expected)
    slope = slope + slope.T - np.diag(np.diag(slope)) if symmetric else slope
    np.testing.assert_allclose(by_rhs, adjoint, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(
        by_values, slope[pattern.rows, pattern.columns], rtol=1e-9, atol=1e-8
    )
    curvature = jax.jit(jax.jacfwd(jax.grad(lambda r: 0.5 * ours(values, r) @ ours(values, r))))(b)
    inverse = np.linalg.inv(A)
    np.testing.assert_allclose(curvature, inverse.T @ inverse, rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize("shift", [20.0, -20.0, 0.0])
@pytest.mark.parametrize("wrap", [lambda f: f, jax.jit], ids=["python", "jit"])
def test_a_symmetric_matrix_with_both_triangles(wrap, shift, monkeypatch):
    """Definite of either sign it is CHOLMOD's; UMFPACK's where it is neither, or not symmetric."""
    A, pattern, _, b = matrix(symmetric=False)
    A = 0.5 * (A + A.T) + (shift - 4.0) * np.eye(len(b))
    values = jnp.asarray(A[pattern.rows, pattern.columns])
    used = []

    def told(pattern, values, rhs, kind):
        x, outcome = factor_and_solve(pattern, values, rhs, kind)
        jax.debug.callback(lambda: used.append(kind == "definite"), ordered=True)
        return x, outcome

    monkeypatch.setattr(solving, "factor_and_solve", told)
    trial = wrap(partial(attempt, pattern))
    for entries, matrix_ in ((values, A), (values.at[1].add(1e-6), None)):
        used.clear()
        x, outcome = jax.block_until_ready(trial(entries, b))
        jax.effects_barrier()
        assert outcome == Outcome.OK
        if matrix_ is None:
            assert used == [False]
        else:
            np.testing.assert_allclose(x, np.linalg.solve(A, b), rtol=1e-9, atol=1e-9)
            assert used == ([True, False] if shift == 0.0 else [True])


@pytest.mark.parametrize("wrap", [lambda f: f, jax.jit], ids=["python", "jit"])
def test_an_outcome_is_data(wrap):
    A, pattern, values, b = matrix(shift=20.0)
    trial = wrap(partial(attempt, pattern))
    x, outcome = trial(values, b)
    assert outcome == Outcome.OK
    np.testing.assert_allclose(x, np.linalg.solve(A, b), rtol=1e-9)
    diagonal = pattern.rows == pattern.columns
    x, outcome = trial(values - 40.0 * diagonal, b)
    assert outcome == Outcome.INDEFINITE
    assert np.isnan(x).all()
    _, whole, plain, _ = matrix(symmetric=False)
    trial = wrap(partial(attempt, whole))
    assert trial(0.0 * plain, b)[1] == Outcome.SINGULAR
    # What was refused harms nobody after it.
    np.testing.assert_array_equal(wrap(partial(attempt, pattern))(values, b)[1], 0)


def test_outcomes_of_a_batch_and_in_a_loop():
    _, pattern, values, b = matrix(shift=20.0)
    diagonal = jnp.asarray(pattern.rows == pattern.columns, float)
    trial = partial(attempt, pattern)
    shifts = jnp.array([0.0, -40.0, 1.0])
    outcomes = jax.jit(jax.vmap(lambda s: trial(values + s * diagonal, b)[1]))(shifts)
    np.testing.assert_array_equal(outcomes, [Outcome.OK, Outcome.INDEFINITE, Outcome.OK])

    def lower(state):
        shift, _ = state
        return shift - 1.0, trial(values + shift * diagonal, b)[1]

    wanted = lambda state: state[1] == Outcome.OK
    shift, outcome = jax.jit(lambda: jax.lax.while_loop(wanted, lower, (0.0, jnp.int32(0))))()
    assert outcome == Outcome.INDEFINITE
    whole = np.zeros((pattern.size,) * 2)
    whole[pattern.rows, pattern.columns] = values
    least = np.linalg.eigvalsh(whole, UPLO="U")[0]
    assert least + shift + 1.0 < 0.0 <= least + shift + 2.0


def test_other_failures_still_end_the_program():
    import sparsax_cpp

    register("calibrate_test_strict", sparsax_cpp.solve_f64_capsule(), lambda message: None)
    _, pattern, values, b = matrix(shift=-20.0)
    shapes = jax.ShapeDtypeStruct(b.shape, b.dtype), jax.ShapeDtypeStruct((), jnp.int32)
    call = jax.ffi.ffi_call("calibrate_test_strict", shapes)
    with pytest.raises((jax.errors.JaxRuntimeError, ValueError), match="not positive definite"):
        jax.block_until_ready(call(pattern.rows, pattern.columns, values, b, mode=np.int64(0)))


def test_the_version_of_the_headers_is_the_one_that_a_call_carries():
    jax.devices("cpu")  # a function registered before there is a device is looked at later
    versions = []

    @ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)
    def handler(address):
        api = Api.from_address(CallFrame.from_address(address).api)
        versions.append((api.major, api.minor))

    target = "calibrate_test_version"
    # XLA first asks a handler for its own version, which this one does not answer. It is refused.
    with pytest.raises(jax.errors.JaxRuntimeError, match="API version"):
        jax.ffi.register_ffi_target(target, jax.ffi.pycapsule(handler), platform="cpu")
    assert set(versions) == {api_version()}
    check_api()


@pytest.mark.parametrize(
    ("header", "version"),
    [
        ("#define XLA_FFI_API_MAJOR 1\n#define XLA_FFI_API_MINOR 5\n", "1.5"),
        ("#define XLA_FFI_API_MAJOR 0\n#define XLA_FFI_API_MINOR 2\n", "0.2"),
        ("", "without a version"),
    ],
)
def test_another_interface_of_xla_is_refused_in_one_line(tmp_path, monkeypatch, header, version):
    folder = tmp_path / "xla" / "ffi" / "api"
    folder.mkdir(parents=True)
    (folder / "c_api.h").write_text(header)
    monkeypatch.setattr(jax.ffi, "include_dir", lambda: str(tmp_path))
    with pytest.raises(
        InputError, match=f"has XLA FFI {version}; .* needs 0.3 or a later"
    ) as refusal:
        register("calibrate_test_other_interface", None, lambda message: None)
    assert "\n" not in str(refusal.value)


@pytest.fixture
def interruptible():
    """Ctrl-C raises, as it does from a terminal; in the background it would be ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("interruptible")
def test_what_python_raises_in_between_is_no_answer():
    """Ctrl-C in the middle of a solve: NaN, and the interrupt as soon as the program has ended."""
    import sparsax_cpp

    def interrupted(message):
        raise KeyboardInterrupt

    register("calibrate_test_interrupted", sparsax_cpp.solve_f64_capsule(), interrupted)
    _, pattern, values, b = matrix(shift=-20.0)
    shapes = jax.ShapeDtypeStruct(b.shape, b.dtype), jax.ShapeDtypeStruct((), jnp.int32)
    call = jax.ffi.ffi_call("calibrate_test_interrupted", shapes)
    found = []
    with pytest.raises(KeyboardInterrupt):  # noqa: PT012 - the interrupt comes when it comes
        found += call(pattern.rows, pattern.columns, values, b, mode=np.int64(0))
        found[1].block_until_ready()
        time.sleep(1.0)
    x, outcome = found
    assert outcome == INTERRUPTED
    assert np.isnan(x).all()
