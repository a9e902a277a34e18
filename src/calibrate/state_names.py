"""Names of quantities in one load state of several.

``volume@end-diastole`` is the volume measured in the state called ``end-diastole``, and
``pressure@end-diastole`` the pressure there. Without ``@`` there is one state, without a name.
"""

from __future__ import annotations

from collections.abc import Iterable

from emulator.core.errors import InputError

_AT = "@"


def split(name: str) -> tuple[str, str]:
    """Return name and state of ``name@state``; the state is empty where none is named."""
    base, _, state = name.partition(_AT)
    return base, state


def in_state(name: str, state: str) -> str:
    """Return ``name@state``, or ``name`` itself in the only state."""
    return f"{name}{_AT}{state}" if state else name


def states_of(names: Iterable[str], what: str = "observations") -> tuple[str, ...]:
    """Return the states that ``names`` name, each once.

    :class:`InputError` where some names have a state and others do not, or a state is an empty
    word.
    """
    names = tuple(names)
    for name in names:
        if name.count(_AT) > 1 or name.endswith(_AT) or name.startswith(_AT):
            raise InputError(f"'{name}': write name{_AT}state, as in volume{_AT}end-diastole")
    states = tuple(dict.fromkeys(split(name)[1] for name in names))
    if "" in states and len(states) > 1:
        bare = next(name for name in names if not split(name)[1])
        raise InputError(
            f"{what}: '{bare}' names no load state, others do: {', '.join(filter(None, states))}"
        )
    return states
