"""A foreign function of XLA whose failure is an output, not an exception.

A function called by a compiled program reports a failure as an error, which ends the program: XLA
has no way to catch one. But XLA calls it through a C interface (``xla/ffi/api/c_api.h``, in the
headers that jaxlib ships), and so can a function in between: it calls the original, and where that
returns an error, it drops the error, fills the result with NaN, and writes which error it was into
one more result, an int32. No callback into Python's arrays, nothing that keeps a program out of
JAX's cache on disk; 15 microseconds a call (docs/experiments.md, "A refusal that is data").
"""

from __future__ import annotations

import ctypes
import sys
from _thread import interrupt_main
from collections.abc import Callable
from math import prod
from threading import Timer
from typing import Any

import jax

Classify = Callable[[str], int | None]
"""An error's message to the number to report; None to let the error end the program."""

INTERRUPTED = -1
"""What is reported where Python raised in between."""

_AGAIN = 0.05  # seconds after which an interrupt is repeated


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


class _CallFrame(ctypes.Structure):
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


class _Api(ctypes.Structure):
    """``XLA_FFI_Api`` up to the functions of errors."""

    _fields_ = (
        ("struct_size", ctypes.c_size_t),
        ("extension", ctypes.c_void_p),
        ("version", ctypes.c_uint8 * 24),
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


_HANDLER = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)
_OF_ERRORS = ctypes.CFUNCTYPE(None, ctypes.c_void_p)

_get_name = ctypes.pythonapi.PyCapsule_GetName
_get_name.restype, _get_name.argtypes = ctypes.c_char_p, (ctypes.py_object,)
_get_pointer = ctypes.pythonapi.PyCapsule_GetPointer
_get_pointer.restype, _get_pointer.argtypes = ctypes.c_void_p, (ctypes.py_object, ctypes.c_char_p)
_new_capsule = ctypes.pythonapi.PyCapsule_New
_new_capsule.restype = ctypes.py_object
_new_capsule.argtypes = (ctypes.c_void_p, ctypes.c_char_p, ctypes.c_void_p)

_alive: list[Any] = []  # XLA keeps the bare pointers


def register(target: str, capsule: Any, classify: Classify) -> None:
    """Register ``target``: the function of ``capsule`` with one more result, an int32 ().

    The function has one result, of float64. The other is 0, or what ``classify`` says of the error.
    """
    inner = _HANDLER(_get_pointer(capsule, _get_name(capsule)))

    def handler(address: int) -> int | None:
        frame = _CallFrame.from_address(address)
        if frame.extension or frame.results_count != 2:  # XLA asks about the function itself
            return inner(address)
        told = ctypes.cast(_result(frame, 1).data, ctypes.POINTER(ctypes.c_int32))
        try:
            return told_by(frame, address, told)
        except BaseException as error:  # it must not leave: ctypes would return what is no pointer
            frame.results_count = 2
            _fill(_result(frame, 0))
            told[0] = INTERRUPTED
            if isinstance(error, KeyboardInterrupt):
                Timer(_AGAIN, interrupt_main).start()  # where the program has ended
            else:
                sys.excepthook(type(error), error, error.__traceback__)
            return None

    def told_by(frame: _CallFrame, address: int, told: Any) -> int | None:
        frame.results_count = 1
        error = inner(address)
        frame.results_count = 2
        if not error:
            told[0] = 0
            return None
        api = _Api.from_address(frame.api)
        arguments = _ErrorArguments(ctypes.sizeof(_ErrorArguments), None, error, None, 0)
        _OF_ERRORS(api.error_message)(ctypes.addressof(arguments))
        number = classify((arguments.message or b"").decode(errors="replace"))
        if number is None:
            return error
        _OF_ERRORS(api.error_destroy)(ctypes.addressof(arguments))
        _fill(_result(frame, 0))
        told[0] = number
        return None

    outer = _HANDLER(handler)
    _alive.extend((inner, outer))
    pointer = ctypes.cast(outer, ctypes.c_void_p)
    jax.ffi.register_ffi_target(
        target, _new_capsule(pointer, _get_name(capsule), None), platform="cpu"
    )


def _result(frame: _CallFrame, number: int) -> _Buffer:
    return _Buffer.from_address(frame.results[number])


def _fill(buffer: _Buffer) -> None:
    """Write NaN everywhere: all bits are one."""
    count = prod(buffer.shape[k] for k in range(buffer.rank))
    ctypes.memset(buffer.data, 0xFF, 8 * count)
