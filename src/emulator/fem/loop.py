"""Programs of a system of equations: compiled in parts, put together by Python or inside ``jit``.

A solver compiled whole holds every evaluation of the forces as often as its branches mention it,
and compiling it takes longer than a hundred solves. So what costs time to run is compiled by
itself, once for each system (:func:`compiled`), and the decisions between are taken by
:func:`cond` and :func:`while_loop`: in Python where the numbers are known, by ``jax.lax`` where
they are traced. The same code serves both.

Bodies that differ in numbers only (three cubes of a heart, the members of a population) have the
same programs, to the letter; the first one compiles them for all.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from functools import partial, wraps
from typing import Any, Concatenate, Protocol
from weakref import WeakValueDictionary

import jax
import jax.numpy as jnp
import numpy as np


class HasPrograms(Protocol):
    """What keeps its programs: ``programs`` by the function they were compiled from."""

    @property
    def programs(self) -> dict[Callable, Callable]:
        """Compiled functions."""


def compiled[H: HasPrograms, **P, R](
    function: Callable[Concatenate[H, P], R],
) -> Callable[Concatenate[H, P], R]:
    """``function(system, *arrays)``, compiled once for each system; also as a method of it.

    Python's numbers are taken as arrays, so that 1.0 and an array are not two programs.
    """

    @wraps(function)
    def run(system: H, /, *arguments: P.args, **named: P.kwargs) -> R:
        program = system.programs.get(function)
        if program is None:
            program = system.programs[function] = jit(partial(function, system))
        by_name = {name: _strong(value) for name, value in named.items()}
        return program(*[_strong(value) for value in arguments], **by_name)

    return run


def jit[**P, R](function: Callable[P, R]) -> Callable[P, R]:
    """``jax.jit`` of a function of arrays whose own arrays are not written into the program.

    What a function closes over becomes part of what is compiled, and of what is kept on disk: a
    hundred megabytes for a mesh of 37 000 nodes, and as many seconds of compiling as the solve has.
    Here it is handed over at every call.
    """
    programs: dict[Any, Callable[..., R]] = {}

    def run(*arguments: P.args, **named: P.kwargs) -> R:
        leaves, form = jax.tree.flatten((arguments, named))
        key = form, tuple(jax.typeof(leaf) for leaf in leaves)
        if key not in programs:
            programs[key] = with_arrays(function, arguments, named)
        return programs[key](leaves)

    return run


def with_arrays[R](function: Callable[..., R], arguments: Any, named: Any) -> Callable[..., R]:
    """The program of :func:`jit` for arguments like these: of the arrays, and of their leaves."""
    traced, shapes = jax.make_jaxpr(function, return_shape=True)(*arguments, **named)
    form = jax.tree.structure(shapes)
    jaxpr, arrays = traced.jaxpr, traced.consts
    inside = any(isinstance(array, jax.core.Tracer) for array in arrays)
    if not inside:
        with jax.ensure_compile_time_eval():
            arrays = jax.device_put(arrays)  # as jnp.asarray, without a program for each shape

    def evaluate(arrays: list[jax.Array], leaves: list[jax.Array]) -> Any:
        return jax.tree.unflatten(form, jax.core.eval_jaxpr(jaxpr, arrays, *leaves))

    evaluate.__name__ = getattr(function, "__name__", getattr(function, "func", evaluate).__name__)
    program = jax.jit(evaluate)
    return partial(program if inside else _Shared(program), arrays)


_programs: WeakValueDictionary[bytes, Callable[..., Any]] = WeakValueDictionary()


class _Shared:
    """A program, or an earlier one that computes the same for numbers.

    The same is what has the same text before XLA compiles it. Derivatives and ``vmap`` are not in
    that text (rules of one's own close over arrays), so that what is traced has its own program.
    """

    def __init__(self, program: Callable[..., Any]) -> None:
        self.own = program
        self._for_numbers: Callable[..., Any] | None = None

    def __call__(self, arrays: list[jax.Array], leaves: list[jax.Array]) -> Any:
        if any(isinstance(leaf, jax.core.Tracer) for leaf in leaves):
            return self.own(arrays, leaves)
        if self._for_numbers is None:
            text = self.own.lower(arrays, leaves).as_text()  # type: ignore[attr-defined]
            key = hashlib.sha256(text.encode()).digest()
            # A function of Python's is an address in the text, where another may lie later.
            shared = "callback" not in text
            self._for_numbers = _programs.setdefault(key, self.own) if shared else self.own
        return self._for_numbers(arrays, leaves)


def cond[S](decision: jax.Array, yes: Callable[..., S], no: Callable[..., S], *operands: Any) -> S:
    """``jax.lax.cond``; where ``decision`` is a number, only the branch it takes."""
    if isinstance(decision, jax.core.Tracer):
        return jax.lax.cond(decision, yes, no, *operands)
    return (yes if bool(decision) else no)(*operands)


def while_loop[S](wanted: Callable[[S], jax.Array], body: Callable[[S], S], state: S) -> S:
    """``jax.lax.while_loop``, or Python's where ``state`` and what ``wanted`` says are numbers."""
    more = wanted(state)
    if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves((more, state))):
        return jax.lax.while_loop(wanted, body, state)
    while bool(more):
        state = body(state)
        more = wanted(state)
    return state


def scan[S, X, Y](body: Callable[[S, X], tuple[S, Y]], state: S, xs: X) -> tuple[S, Y]:
    """``jax.lax.scan``, or Python's loop where ``state`` and ``xs`` are numbers.

    Python's compiles the parts of ``body`` alone, which other callers may have compiled already.
    """
    leaves, form = jax.tree.flatten(xs)
    if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves((state, xs))):
        return jax.lax.scan(body, state, xs)
    each = []
    for k in range(len(leaves[0])):
        state, found = body(state, jax.tree.unflatten(form, [leaf[k] for leaf in leaves]))
        each.append(found)
    return state, jax.tree.map(lambda *parts: jnp.stack(parts), *each)


def one_by_one[R](function: Callable[..., R]) -> Callable[..., R]:
    """``function(*arrays)`` whose ``vmap`` takes one after the other.

    Side by side, every one would take the iterations of the slowest, and both branches of every
    decision.
    """
    alone = jax.custom_batching.custom_vmap(function)

    @alone.def_vmap
    def together(size: int, batched: list[bool], *arrays: jax.Array) -> tuple[R, Any]:
        every = tuple(
            x if is_batched else jnp.broadcast_to(x, (size, *x.shape))
            for x, is_batched in zip(arrays, batched, strict=True)
        )
        found = jax.lax.map(lambda each: alone(*each), every)
        return found, jax.tree.map(lambda _: True, found)

    return alone


def _strong(value: Any) -> Any:
    """``value`` as an array of a type of its own, which decides which program it is for."""
    if isinstance(value, float | int):
        return np.asarray(value)
    if getattr(value, "weak_type", False):
        return jnp.asarray(value, dtype=value.dtype)
    return value
