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
from dataclasses import dataclass
from functools import cache
from math import prod
from pathlib import Path
from threading import Timer
from typing import Any

import jax
import jax.numpy as jnp
import jaxlib
import numpy as np
import sparsax
import sparsax_cpp
from threadpoolctl import ThreadpoolController

from emulator.core.errors import InputError
from emulator.fem.linear.pattern import Pattern
from emulator.fem.linear.solve import Outcome

_CHOLMOD, _UMFPACK = "calibrate_cholmod", "calibrate_umfpack"
_FACTORS = 2  # factors of each pattern that are kept by default


@dataclass(frozen=True)
class SuiteSparse:
    """CHOLMOD where the matrix must be definite, UMFPACK where not."""

    name = "suitesparse"
    on_host = False

    def check(self) -> None:
        """Prepare the library, which is always installed."""
        _prepare()

    def solve(
        self,
        pattern: Pattern,
        values: jax.Array,
        rhs: jax.Array,
        *,
        definite: bool,
        transposed: bool = False,
    ) -> tuple[jax.Array, jax.Array]:
        """Solve by CHOLMOD, or by UMFPACK, which takes both triangles."""
        if definite:
            matrix = pattern.rows, pattern.columns, values
            return _call(_CHOLMOD, matrix, rhs, mode=np.int64(0))
        return _call(_UMFPACK, pattern.both(values), rhs, trans=np.int64(transposed))


SUITESPARSE = SuiteSparse()


def _call(
    target: str, matrix: tuple[np.ndarray, np.ndarray, jax.Array], rhs: jax.Array, **flags: Any
) -> tuple[jax.Array, jax.Array]:
    _prepare()
    shapes = jax.ShapeDtypeStruct(rhs.shape, jnp.float64), jax.ShapeDtypeStruct((), jnp.int32)
    call = jax.ffi.ffi_call(target, shapes, vmap_method="sequential")
    x, outcome = call(*matrix, rhs, **flags)
    return x, outcome


@cache
def _prepare() -> None:
    """Register both solvers, set the threads of their BLAS and the sizes of their caches, once.

    The BLAS inside the sparse solver gets one thread: a second pool beside XLA's oversubscribes the
    cores, and a factorisation of 2.5 ms then took up to 250 ms. Only the library bundled with
    sparsax is changed, not NumPy's.

    By default sparsax caches up to 32 UMFPACK and 8 CHOLMOD factors of each pattern, for matrices
    that recur. Ours recur only in consecutive solves, and a factor of a large mesh takes a
    gigabyte.
    """
    register(_CHOLMOD, sparsax_cpp.solve_f64_capsule(), _outcome)
    register(_UMFPACK, sparsax_cpp.umf_solve_f64_capsule(), _outcome)
    for library in ThreadpoolController().lib_controllers:
        if "sparsax" in library.filepath:
            library.set_num_threads(1)
    sparsax.set_umf_cache_size(_FACTORS)
    sparsax.set_num_cache_size(_FACTORS)


def _outcome(message: str) -> int | None:
    """Return the outcome that sparsax's error message stands for; None for any other error."""
    if "not positive definite" in message:
        return int(Outcome.INDEFINITE)
    return int(Outcome.SINGULAR) if "singular" in message else None


# ---- the cache of factors ------------------------------------------------------------------------
class FactorCache:
    """The cache of factors, which is sparsax's and therefore one for the whole process.

    Its size is the number of Cholesky factors kept of each pattern: what the latest :meth:`keep`
    that is still open asks for.
    """

    def __init__(self) -> None:
        self._sizes = [_FACTORS]

    @contextmanager
    def keep(self, count: int) -> Iterator[None]:
        """Keep ``count`` Cholesky factors of each pattern inside the context.

        As many as threads that solve; or one, where two would not fit into memory: a factorisation
        then overwrites the one before. Contexts may be closed in any order.
        """
        _prepare()
        self._sizes.append(count)
        sparsax.set_num_cache_size(count)
        try:
            yield
        finally:
            self._sizes.remove(count)
            sparsax.set_num_cache_size(self._sizes[-1])

    def clear(self) -> None:
        """Free all factors, and all orderings of patterns, which cost as much as a factor."""
        sparsax.clear_cache()


FACTORS = FactorCache()


# ---- a foreign function of XLA whose failure is an output ---------------------------------------
Classify = Callable[[str], int | None]
"""Maps an error's message to the number to report; None lets the error end the program."""

INTERRUPTED = -1
"""The number reported where Python raised an exception inside the call."""

_API_MAJOR, _API_MINOR = 0, 3
_REPEAT_S = 0.05  # seconds after which an interrupt is repeated


class _Buffer(ctypes.Structure):
    """``XLA_FFI_Buffer``."""

    _fields_ = (
        ("struct_size", ctypes.c_size_t),
        ("extension", ctypes.c_void_p),
        ("dtype", ctypes.c_int),
        ("data", ctypes.c_void_p),
        ("rank", ctypes.c_int64),
        ("shape", ctypes.POINTER(ctypes.c_int64)),
    )

    def fill(self) -> None:
        """Write NaN everywhere: all bits are one."""
        count = prod(self.shape[k] for k in range(self.rank))
        ctypes.memset(self.data, 0xFF, 8 * count)


class CallFrame(ctypes.Structure):
    """``XLA_FFI_CallFrame`` up to its results."""

    _fields_ = (
        ("struct_size", ctypes.c_size_t),
        ("extension", ctypes.c_void_p),
        ("api", ctypes.c_void_p),
        ("context", ctypes.c_void_p),
        ("stage", ctypes.c_int),
        ("arguments_size", ctypes.c_size_t),
        ("arguments_extension", ctypes.c_void_p),
        ("arguments_count", ctypes.c_int64),
        ("arguments_types", ctypes.c_void_p),
        ("arguments", ctypes.c_void_p),
        ("results_size", ctypes.c_size_t),
        ("results_extension", ctypes.c_void_p),
        ("results_count", ctypes.c_int64),
        ("results_types", ctypes.c_void_p),
        ("results", ctypes.POINTER(ctypes.c_void_p)),
    )

    def result(self, number: int) -> _Buffer:
        """Return the buffer of one result."""
        return _Buffer.from_address(self.results[number])


class Api(ctypes.Structure):
    """``XLA_FFI_Api`` up to the functions of errors; its version is a struct inside it."""

    _fields_ = (
        ("struct_size", ctypes.c_size_t),
        ("extension", ctypes.c_void_p),
        ("version_size", ctypes.c_size_t),
        ("version_extension", ctypes.c_void_p),
        ("major", ctypes.c_int),
        ("minor", ctypes.c_int),
        ("internal", ctypes.c_void_p),
        ("error_create", ctypes.c_void_p),
        ("error_message", ctypes.c_void_p),
        ("error_destroy", ctypes.c_void_p),
    )


class _ErrorArguments(ctypes.Structure):
    """Arguments of both functions of errors; the second reads the first three."""

    _fields_ = (
        ("struct_size", ctypes.c_size_t),
        ("extension", ctypes.c_void_p),
        ("error", ctypes.c_void_p),
        ("message", ctypes.c_char_p),
        ("code", ctypes.c_int),
    )


_Handler = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)
_ErrorFunction = ctypes.CFUNCTYPE(None, ctypes.c_void_p)

# Prototypes of their own: whoever sets the types of ctypes.pythonapi's functions sets them for all.
_capsule_name = ctypes.PYFUNCTYPE(ctypes.c_char_p, ctypes.py_object)(
    ("PyCapsule_GetName", ctypes.pythonapi)
)
_capsule_pointer = ctypes.PYFUNCTYPE(ctypes.c_void_p, ctypes.py_object, ctypes.c_char_p)(
    ("PyCapsule_GetPointer", ctypes.pythonapi)
)

_alive: list[Any] = []  # XLA keeps bare pointers to registered functions, for the whole process


def api_version() -> tuple[int, int]:
    """Return the major and minor version of XLA's C interface, from the headers of jaxlib."""
    header = Path(jax.ffi.include_dir()) / "xla" / "ffi" / "api" / "c_api.h"
    text = header.read_text(errors="replace") if header.is_file() else ""
    numbers = [re.search(rf"XLA_FFI_API_{part} (\d+)", text) for part in ("MAJOR", "MINOR")]
    major, minor = (-1 if number is None else int(number[1]) for number in numbers)
    return major, minor


def check_api() -> None:
    """Raise :class:`InputError` unless the structs below have XLA's layout.

    A new minor version of the interface only adds fields at the ends of structs; a new major
    version may move any.
    """
    major, minor = api_version()
    if major != _API_MAJOR or minor < _API_MINOR:
        version = f"{major}.{minor}" if major >= 0 else "without a version"
        raise InputError(
            f"factorisation 'suitesparse': jaxlib {jaxlib.__version__} has XLA FFI {version}; this "
            f"version of the package needs {_API_MAJOR}.{_API_MINOR} or a later {_API_MAJOR}.x, as "
            "in jax 0.10.2 to 0.12"
        )


def register(target: str, capsule: Any, classify: Classify) -> None:
    """Register ``target`` with XLA: the function of ``capsule`` with one more result, an int32 ().

    The function has one result, of float64. The other is 0, or what ``classify`` says of the error.

    Raises
    ------
    InputError
        XLA's C interface is another than the one this binding was written for.
    """
    check_api()
    inner = _Handler(_capsule_pointer(capsule, _capsule_name(capsule)))

    def handler(address: int) -> int | None:
        frame = CallFrame.from_address(address)
        if frame.extension or frame.results_count != 2:  # XLA asks about the function itself
            return inner(address)
        status = ctypes.cast(frame.result(1).data, ctypes.POINTER(ctypes.c_int32))
        try:
            return _call_inner(inner, frame, status, classify)
        except BaseException as error:  # in ctypes it would become an invalid pointer
            frame.results_count = 2
            frame.result(0).fill()
            status[0] = INTERRUPTED
            if isinstance(error, KeyboardInterrupt):
                Timer(_REPEAT_S, interrupt_main).start()  # raises once the program has ended
            else:
                sys.excepthook(type(error), error, error.__traceback__)
            return None

    outer = _Handler(handler)
    _alive.extend((inner, outer))
    jax.ffi.register_ffi_target(target, jax.ffi.pycapsule(outer), platform="cpu")


def _call_inner(inner: Any, frame: CallFrame, status: Any, classify: Classify) -> int | None:
    """Call the original with its one result; write the number of an error into ``status``."""
    frame.results_count = 1
    error = inner(ctypes.addressof(frame))
    frame.results_count = 2
    if not error:
        status[0] = 0
        return None
    api = Api.from_address(frame.api)
    arguments = _ErrorArguments(ctypes.sizeof(_ErrorArguments), None, error, None, 0)
    _ErrorFunction(api.error_message)(ctypes.addressof(arguments))
    number = classify((arguments.message or b"").decode(errors="replace"))
    if number is None:
        return error
    _ErrorFunction(api.error_destroy)(ctypes.addressof(arguments))
    frame.result(0).fill()
    status[0] = number
    return None
