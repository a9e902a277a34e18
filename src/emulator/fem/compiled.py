"""Compilation of the FEM solver: one decorator, and control flow that Python and JAX share.

:func:`compiled` replaces ``jax.jit`` for functions that close over a mesh:

* ``jax.jit`` writes every array that a function closes over into the program. For a mesh of 37 000
  nodes that is a hundred megabytes, as many seconds of compilation as the solve takes, and as much
  again on disk. Here these arrays are handed over at every call.
* Bodies that differ in numbers only (three cubes of a heart, the members of a population) then have
  the same program text. :data:`PROGRAMS` finds it again, so that the first body compiles for all.

A solver compiled whole would hold every evaluation of the forces as often as its branches mention
it. So the functions that cost time are decorated, each compiled once, and the decisions in between
are taken by :func:`cond` and :func:`while_loop`. Both run in Python where the values are numbers,
and become ``jax.lax`` operations where they are traced: the same code serves a solve from Python
and a solve inside ``jit``.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from functools import partial, wraps
from threading import Lock
from typing import Any
from weakref import WeakValueDictionary

import jax
import jax.numpy as jnp
import numpy as np

Number = jax.Array | float
"""A number: an array (), or Python's."""


def compiled[**P, R](function: Callable[P, R]) -> Callable[P, R]:
    """Compile ``function`` once for each shape of its arguments, as ``jax.jit`` does.

    A first argument with a dictionary ``programs`` (a :class:`~emulator.fem.assembly.System`, or a
    formulation of one) is the object that the function is about, and keeps the function's programs;
    so the decorator serves methods too. All other arguments are trees of arrays. Python's numbers
    are taken as arrays, so that 1.0 and an array share a program.
    """
    unbound_programs: dict[Any, Callable[..., Any]] = {}

    @wraps(function)
    def run(*arguments: Any, **named: Any) -> R:
        call: Callable[..., R] = function
        programs, rest = unbound_programs, arguments
        if rest and hasattr(rest[0], "programs"):
            call, programs = partial(function, rest[0]), rest[0].programs
            rest = rest[1:]
        leaves, form = jax.tree.flatten((rest, named))
        leaves = [_without_weak_type(leaf) for leaf in leaves]
        key = run, form, tuple(jax.typeof(leaf) for leaf in leaves)
        if key not in programs:
            rest, by_name = jax.tree.unflatten(form, leaves)
            trace = jax.make_jaxpr(call, return_shape=True)(*rest, **by_name)
            programs[key] = _Program(_name(function), *trace)
        return programs[key](leaves)

    return run


def _name(function: Any) -> str:
    """Return the innermost function's name, under which XLA logs the program."""
    function = getattr(function, "fun", function)  # the function inside a custom derivative rule
    function = getattr(function, "func", function)  # the function inside functools.partial
    return str(getattr(function, "__name__", "program"))


class _Program:
    """A traced function, compiled as a function of the arrays it closes over and of its leaves.

    Calls with numbers go through the first body's program with the same text. Derivatives and
    ``vmap`` are not in that text, because custom rules close over arrays; so calls with tracers go
    through the body's own program.
    """

    def __init__(self, name: str, traced: Any, shapes: Any) -> None:
        form, jaxpr = jax.tree.structure(shapes), traced.jaxpr

        def evaluate(arrays: list[jax.Array], leaves: list[jax.Array]) -> Any:
            return jax.tree.unflatten(form, jax.core.eval_jaxpr(jaxpr, arrays, *leaves))

        evaluate.__name__ = name
        # Without unused arguments the texts of two bodies could agree where their shapes do not.
        self.program: Any = jax.jit(evaluate, keep_unused=True)
        self.shared: Any = None
        self.arrays = traced.consts
        self.inside = is_traced(self.arrays)  # whether this is part of a larger trace
        if not self.inside:
            with jax.ensure_compile_time_eval():  # as jnp.asarray, without a program a shape
                self.arrays = jax.device_put(self.arrays)

    def __call__(self, leaves: list[jax.Array]) -> Any:
        if self.inside or any(isinstance(leaf, jax.core.Tracer) for leaf in leaves):
            return self.program(self.arrays, leaves)
        if self.shared is None:
            text = self.program.lower(self.arrays, leaves).as_text()
            self.shared = PROGRAMS.same_as(text, self.program)
        return self.shared(self.arrays, leaves)


class SharedPrograms:
    """The programs of this process by their text before XLA compiles it.

    Beside the factors that SuiteSparse keeps (:mod:`emulator.fem.linear.suitesparse`) they are the
    process-wide state of the solver. A program is dropped with the last body that uses it. The text
    holds shapes, types and operations, no arrays: which program a body gets never changes its
    numbers. Without JAX's cache on disk, the first solve of a second coarse ventricle took 5 s
    where that of the first took 126 s (two busy cores).
    """

    def __init__(self) -> None:
        self._by_text: WeakValueDictionary[bytes, Callable[..., Any]] = WeakValueDictionary()
        self._lock = Lock()

    def __len__(self) -> int:
        """Return the number of programs in use."""
        return len(self._by_text)

    def same_as(self, text: str, program: Callable[..., Any]) -> Callable[..., Any]:
        """Return the first program with this ``text``, which ``program`` becomes if there is none.

        A Python callback appears in the text as an address, which another function may get later:
        programs with one are not shared.
        """
        if "callback" in text:
            return program
        with self._lock:
            return self._by_text.setdefault(hashlib.sha256(text.encode()).digest(), program)


PROGRAMS = SharedPrograms()


def is_traced(*values: Any) -> bool:
    """Return whether any leaf of ``values`` is an abstract value of a JAX transformation."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(values))


def cond[S](decision: jax.Array, yes: Callable[..., S], no: Callable[..., S], *operands: Any) -> S:
    """Return ``jax.lax.cond``; where ``decision`` is a number, only its branch is evaluated."""
    if is_traced(decision):
        return jax.lax.cond(decision, yes, no, *operands)
    return (yes if bool(decision) else no)(*operands)


def while_loop[S](proceeds: Callable[[S], jax.Array], body: Callable[[S], S], state: S) -> S:
    """Return ``jax.lax.while_loop``; where state and condition are numbers, loop in Python."""
    more = proceeds(state)
    if is_traced(more, state):
        return jax.lax.while_loop(proceeds, body, state)
    while bool(more):
        state = body(state)
        more = proceeds(state)
    return state


def scan[S, X, Y](body: Callable[[S, X], tuple[S, Y]], state: S, xs: X) -> tuple[S, Y]:
    """Return ``jax.lax.scan``; where ``state`` and ``xs`` are numbers, loop in Python.

    Python's loop compiles the parts of ``body`` alone, which other callers may have compiled.
    """
    if is_traced(state, xs):
        return jax.lax.scan(body, state, xs)
    outputs = []
    for k in range(len(jax.tree.leaves(xs)[0])):
        state, output = body(state, jax.tree.map(lambda x, k=k: x[k], xs))
        outputs.append(output)
    return state, jax.tree.map(lambda *parts: jnp.stack(parts), *outputs)


def one_by_one[R](function: Callable[..., R]) -> Callable[..., R]:
    """Return ``function(*arrays)`` with a ``vmap`` that evaluates one element after the other.

    Side by side, every element would take the iterations of the slowest, and both branches of every
    decision.
    """
    single = jax.custom_batching.custom_vmap(function)

    @single.def_vmap
    def batch(size: int, batched: list[bool], *arrays: jax.Array) -> tuple[R, Any]:
        wide = tuple(
            x if is_batched else jnp.broadcast_to(x, (size, *x.shape))
            for x, is_batched in zip(arrays, batched, strict=True)
        )
        results = jax.lax.map(lambda element: single(*element), wide)
        return results, jax.tree.map(lambda _: True, results)

    return single


def _without_weak_type(value: Any) -> Any:
    """Return ``value`` as an array whose type does not depend on how the number was written."""
    if isinstance(value, float | int):
        return np.asarray(value)
    if getattr(value, "weak_type", False):
        return jnp.asarray(value, dtype=value.dtype)
    return value
