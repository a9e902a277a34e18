"""SuiteSparse through sparsax, inside compiled programs: CHOLMOD and UMFPACK.

CHOLMOD factorises positive definite matrices, UMFPACK any. sparsax raises an error for an
indefinite or singular matrix, and an error ends a compiled program: XLA has no way to catch one.
Newton's method needs the refusal as a number instead. XLA calls a foreign function through a C
interface (``xla/ffi/api/c_api.h``, in the headers of jaxlib), and so can a function in between:
:func:`register` makes one that calls the original and, where that returns an error, drops the
error, fills the result with NaN, and writes which error it was into one more result, an int32.
Such a call has no callback into Python's arrays, and nothing that keeps a program out of JAX's
cache on disk; it costs 15 microseconds (docs/experiments.md, "A refusal that is data"). The
binding goes when sparsax returns a status itself (docs/large_meshes.md, "A note to sparsax").
"""

from __future__ import annotations

import ctypes
import re
import sys
from _thread import interrupt_main
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from enum import IntEnum
from functools import cache, partial
from math import prod
from pathlib import Path
from threading import Timer
from typing import Any, Literal

import jax
import jax.numpy as jnp
import jaxlib
import numpy as np
import sparsax
import sparsax_cpp
from threadpoolctl import ThreadpoolController

from emulator.core.errors import InputError
from emulator.core.machine import cores
from emulator.fem.linear.pattern import Pattern

_CHOLMOD, _UMFPACK = "calibrate_cholmod", "calibrate_umfpack"
_FACTORS = 2  # factors of each pattern that are kept by default


class Outcome(IntEnum):
    """How a linear solve ended, as a number that compiled programs can carry.

    The solution is NaN unless the outcome is OK.
    """

    OK = 0
    INDEFINITE = 1  # not positive definite; a general factorisation may still solve
    SINGULAR = 2


LARGE = 40_000
"""Unknowns of a factorisation that gains by several threads."""

Solved = tuple[jax.Array, jax.Array]
"""A solution x, (size,) or (size, k), and its :class:`Outcome`, int32 ()."""

Kind = Literal["definite", "general", "transposed"]
"""What is solved with: a matrix that must be positive definite, given by its upper triangle, or
else is INDEFINITE; any matrix; or the transpose of any."""


def factor_and_solve(pattern: Pattern, values: jax.Array, rhs: jax.Array, kind: Kind) -> Solved:
    """Return ``x`` with ``A x = rhs``, and the outcome.

    CHOLMOD where the matrix must be definite, UMFPACK, which takes both triangles, where not.
    """
    prepare()
    shapes = jax.ShapeDtypeStruct(rhs.shape, jnp.float64), jax.ShapeDtypeStruct((), jnp.int32)
    call = partial(jax.ffi.ffi_call, result_shape_dtypes=shapes, vmap_method="sequential")
    if kind == "definite":
        x, outcome = call(_CHOLMOD)(pattern.rows, pattern.columns, values, rhs, mode=np.int64(0))
    else:
        trans = np.int64(kind == "transposed")
        x, outcome = call(_UMFPACK)(*pattern.both(values), rhs, trans=trans)
    return x, outcome


@cache
def prepare() -> None:
    """Register both solvers, set the threads of their BLAS and the sizes of their caches, once.

    The BLAS inside the sparse solver gets one thread, but for :func:`on_all_cores`: a second pool
    beside XLA's oversubscribes the cores, and a factorisation of 2.5 ms then took up to 250 ms.
    Only the library bundled with sparsax is changed, not NumPy's.

    By default sparsax caches up to 32 UMFPACK and 8 CHOLMOD factors of each pattern, for matrices
    that recur. Ours recur only in consecutive solves, and a factor of a large mesh takes a
    gigabyte.
    """
    register(_CHOLMOD, sparsax_cpp.solve_f64_capsule(), _outcome)
    register(_UMFPACK, sparsax_cpp.umf_solve_f64_capsule(), _outcome)
    _set_threads(1)
    sparsax.set_umf_cache_size(_FACTORS)
    sparsax.set_num_cache_size(_FACTORS)


@cache
def _blas() -> list[Any]:
    """Return the controllers of the BLAS inside the sparse solver."""
    libraries = ThreadpoolController().lib_controllers
    return [library for library in libraries if "sparsax" in library.filepath]


def _set_threads(count: int) -> None:
    for library in _blas():
        library.set_num_threads(count)


def _outcome(message: str) -> int | None:
    """Return the outcome that sparsax's error message stands for; None for any other error."""
    if "not positive definite" in message:
        return int(Outcome.INDEFINITE)
    return int(Outcome.SINGULAR) if "singular" in message else None


# ---- the cache of factors ------------------------------------------------------------------------
_kept = [_FACTORS]  # what the contexts ask for that are open; the cache is sparsax's, one a process


@contextmanager
def keeping_factors(count: int) -> Iterator[None]:
    """Keep ``count`` Cholesky factors of each pattern inside the context.

    As many as threads that solve; or one, where two would not fit into memory: a factorisation
    then overwrites the one before. Contexts may be closed in any order; the latest one counts.
    """
    prepare()
    _kept.append(count)
    sparsax.set_num_cache_size(count)
    try:
        yield
    finally:
        _kept.remove(count)
        sparsax.set_num_cache_size(_kept[-1])


@contextmanager
def on_all_cores(unknowns: int) -> Iterator[None]:
    """Let factorisations inside the context use all cores, if they are large and alone.

    They are alone where no threads keep factors (:func:`keeping_factors`). Two threads take 0.67 of
    the time of one at 100 000 unknowns of quadratic elements, and gain nothing at 14 000.
    """
    alone = unknowns >= LARGE and len(_kept) == 1
    if alone:
        _set_threads(cores())
    try:
        yield
    finally:
        if alone:
            _set_threads(1)


def free_factors() -> None:
    """Free all factors, and all orderings of patterns, which cost as much as a factor."""
    sparsax.clear_cache()


# ---- a foreign function of XLA whose failure is an output ---------------------------------------
Classify = Callable[[str], int | None]
"""Maps an error's message to the number to report; None lets the error end the program."""

INTERRUPTED = -1
"""The number reported where Python raised an exception inside the call."""

_API_MAJOR, _API_MINOR = 0, 3
_REPEAT_S = 0.05  # seconds after which an interrupt is repeated


def _words(names: str) -> list[tuple[str, type]]:
    """Return fields of a struct, each in a word of its own, as XLA's are."""
    return [(name, ctypes.c_size_t) for name in names.split()]


class _Buffer(ctypes.Structure):
    """``XLA_FFI_Buffer``."""

    _fields_ = (
        *_words("struct_size extension dtype data rank"),
        ("shape", ctypes.POINTER(ctypes.c_int64)),
    )

    def fill(self) -> None:
        """Write NaN everywhere: all bits are one."""
        ctypes.memset(self.data, 0xFF, 8 * prod(self.shape[: self.rank]))


class CallFrame(ctypes.Structure):
    """``XLA_FFI_CallFrame`` up to its results."""

    _fields_ = (
        *_words("struct_size extension api context stage"),
        *_words("arguments_size arguments_extension arguments_count arguments_types arguments"),
        *_words("results_size results_extension results_count results_types"),
        ("results", ctypes.POINTER(ctypes.c_void_p)),
    )

    def result(self, number: int) -> _Buffer:
        """Return the buffer of one result."""
        return _Buffer.from_address(self.results[number])


class Api(ctypes.Structure):
    """``XLA_FFI_Api`` up to the functions of errors; its version is a struct inside it."""

    _fields_ = (
        *_words("struct_size extension version_size version_extension"),
        ("major", ctypes.c_int),
        ("minor", ctypes.c_int),
        *_words("internal error_create error_message error_destroy"),
    )


class _ErrorArguments(ctypes.Structure):
    """Arguments of both functions of errors; the second reads the first three."""

    _fields_ = (
        *_words("struct_size extension error"),
        ("message", ctypes.c_char_p),
        *_words("code"),
    )


_Handler = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)
_ErrorFunction = ctypes.CFUNCTYPE(None, ctypes.c_void_p)

# Prototypes of their own: whoever sets the types of ctypes.pythonapi's functions sets them for all.
_NameOf = ctypes.PYFUNCTYPE(ctypes.c_char_p, ctypes.py_object)
_PointerOf = ctypes.PYFUNCTYPE(ctypes.c_void_p, ctypes.py_object, ctypes.c_char_p)
_capsule_name = _NameOf(("PyCapsule_GetName", ctypes.pythonapi))
_capsule_pointer = _PointerOf(("PyCapsule_GetPointer", ctypes.pythonapi))

_alive: list[Any] = []  # XLA keeps bare pointers to registered functions, for the whole process


def api_version() -> tuple[int, int]:
    """Return the major and minor version of XLA's C interface, from the headers of jaxlib."""
    header = Path(jax.ffi.include_dir()) / "xla" / "ffi" / "api" / "c_api.h"
    text = header.read_text(errors="replace") if header.is_file() else ""
    numbers = [re.search(rf"XLA_FFI_API_{part} (\d+)", text) for part in ("MAJOR", "MINOR")]
    major, minor = (-1 if number is None else int(number[1]) for number in numbers)
    return major, minor


def check_api() -> None:
    """Raise :class:`InputError` unless the structs above have XLA's layout.

    A new minor version of the interface only adds fields at the ends of structs; a new major
    version may move any.
    """
    major, minor = api_version()
    if major != _API_MAJOR or minor < _API_MINOR:
        version = f"{major}.{minor}" if major >= 0 else "without a version"
        raise InputError(
            f"SuiteSparse: jaxlib {jaxlib.__version__} has XLA FFI {version}; this "
            f"version of the package needs {_API_MAJOR}.{_API_MINOR} or a later {_API_MAJOR}.x, as "
            "in jax 0.10.2 to 0.12"
        )


def register(target: str, capsule: Any, classify: Classify) -> None:
    """Register ``target`` with XLA: the function of ``capsule`` with one more result, an int32 ().

    The function has one result, of float64. The other is 0, or what ``classify`` says of the error.

    Raises :class:`InputError`: XLA's C interface is another than the one this binding was written
    for.
    """
    check_api()
    inner = _Handler(_capsule_pointer(capsule, _capsule_name(capsule)))

    def handler(address: int) -> int | None:
        frame = CallFrame.from_address(address)
        if frame.extension or frame.results_count != 2:  # XLA asks about the function itself
            return inner(address)
        frame.results_count = 1
        number: int | None = INTERRUPTED
        try:
            error = inner(address)
            number = _number_of(error, Api.from_address(frame.api), classify) if error else 0
        except KeyboardInterrupt:
            Timer(_REPEAT_S, interrupt_main).start()  # raises once the program has ended
        except BaseException as failure:  # in ctypes it would become an invalid pointer
            sys.excepthook(type(failure), failure, failure.__traceback__)
        frame.results_count = 2
        if number is None:
            return error
        if number:
            frame.result(0).fill()
        ctypes.c_int32.from_address(frame.result(1).data).value = number
        return None

    outer = _Handler(handler)
    _alive.extend((inner, outer))
    jax.ffi.register_ffi_target(target, jax.ffi.pycapsule(outer), platform="cpu")


def _number_of(error: int, api: Api, classify: Classify) -> int | None:
    """Return the number of an error, and free it; None for one that ends the program."""
    arguments = _ErrorArguments(ctypes.sizeof(_ErrorArguments), 0, error)
    _ErrorFunction(api.error_message)(ctypes.addressof(arguments))
    number = classify((arguments.message or b"").decode(errors="replace"))
    if number is not None:
        _ErrorFunction(api.error_destroy)(ctypes.addressof(arguments))
    return number
