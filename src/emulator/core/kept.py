"""Results that are kept by the object they follow from.

A program compiled for a model, or the simulator of a scene, lives as long as the model or the scene
and no longer, and belongs to that object: nothing is found again by a name, an equal object or a
hash, as in a table of the process.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any, cast
from weakref import ref

_RESULTS = "_kept_results"


class _Results(dict[tuple[Any, ...], Any]):
    """Results by function and arguments; a copy of ``owner`` carries them, but may not use them."""

    def __init__(self, owner: object) -> None:
        super().__init__()
        self.owner = ref(owner)

    def __reduce__(self) -> tuple[Any, ...]:
        return dict, ()  # nothing goes to another process or to a deep copy


def kept[F: Callable[..., Any]](function: F) -> F:
    """Make ``function(owner, *arguments)`` return its first result for these arguments of an owner.

    owner : a frozen object whose class has no slots; it holds the results.
    arguments : hashable, and by position.

    Two threads that ask at once may both compute; both get the result of the one that ended first.
    """

    @wraps(function)
    def result_of(owner: Any, *arguments: Any) -> Any:
        attributes = vars(owner)  # past the class, which may be frozen
        results = attributes.get(_RESULTS)
        if not isinstance(results, _Results) or results.owner() is not owner:
            results = attributes[_RESULTS] = _Results(owner)
        key = (function, *arguments)
        if key not in results:
            results.setdefault(key, function(owner, *arguments))
        return results[key]

    return cast(F, result_of)
