"""Results live with the object they follow from, and with no other."""

import gc
import weakref
from copy import copy, deepcopy
from dataclasses import dataclass, replace

import numpy as np

from emulator.core.kept import kept


@dataclass(frozen=True)
class Body:
    """A frozen owner, equal to others of its size."""

    size: float


class Box:
    """A result that can be referred to weakly."""


CALLS = []


@kept
def box_of(body, count=1):
    """Return a new box."""
    CALLS.append((body, count))
    return Box()


@kept
def other_of(body):
    """Return a box, too."""
    return Box()


def test_a_result_is_made_once_for_each_owner_function_and_arguments():
    CALLS.clear()
    body = Body(1.0)
    first = box_of(body)
    assert box_of(body) is first
    assert box_of(body, 2) is not first
    assert other_of(body) is not first
    assert len(CALLS) == 2


def test_an_equal_owner_has_results_of_its_own():
    body, equal = Body(2.0), Body(2.0)
    assert body == equal
    assert box_of(body) is not box_of(equal)
    for other in (replace(body), copy(body), deepcopy(body)):
        assert box_of(other) is not box_of(body)
        assert box_of(other) is box_of(other)


def test_results_go_with_their_owner():
    body = Body(np.pi)
    result = weakref.ref(box_of(body))
    assert result() is not None
    del body
    CALLS.clear()
    gc.collect()
    assert result() is None
