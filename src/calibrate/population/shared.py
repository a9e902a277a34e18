"""Which unknowns the members of a population share, and on which scale they vary."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import jax.numpy as jnp

from calibrate.state_names import split
from calibrate.statistical_model import Model
from emulator.core.errors import InputError
from emulator.scenes.parameter_space import Parameter


def to_scale(parameter: Parameter, value: Any) -> Any:
    """``value`` on the parameter's scale: its logarithm, or itself."""
    return jnp.log(value) if parameter.scale == "log" else value


def from_scale(parameter: Parameter, x: Any) -> Any:
    """Inverse of :func:`to_scale`."""
    return jnp.exp(x) if parameter.scale == "log" else x


def ends(parameter: Parameter) -> tuple[float, float]:
    """Both ends of the parameter's range, on its scale."""
    if parameter.scale == "log":
        return math.log(parameter.low), math.log(parameter.high)
    return parameter.low, parameter.high


def shared_names(
    members: Mapping[str, Model], asked: Sequence[str] | None = None
) -> tuple[str, ...]:
    """Unknowns of theta that follow the population, in the first member's order.

    By default all that every member has and that are no parameters of its loads.

    Raises
    ------
    InputError
        One that a member does not infer, or none at all.
    """
    unknowns = {member: model.states.unknowns for member, model in members.items()}
    if asked is None:
        first, *others = unknowns
        loads = {p for model in members.values() for p in model.forward.scene.load_parameters}
        found = tuple(
            name
            for name in unknowns[first]
            if split(name)[0] not in loads and all(name in unknowns[m] for m in others)
        )
        if not found:
            raise InputError("hierarchy: no unknown but those of loads is one of every member")
        return found
    if not asked or len(set(asked)) != len(asked) or isinstance(asked, str):
        raise InputError(f"hierarchy: shared is {asked!r}; give one or more names, each once")
    for name in asked:
        for member, names in unknowns.items():
            if name not in names:
                raise InputError(
                    f"hierarchy: member '{member}' does not infer '{name}'; it infers "
                    f"{', '.join(names)}"
                )
    return tuple(asked)


def check_same(members: Mapping[str, Model], name: str) -> Parameter:
    """The parameter behind the unknown ``name``, one and the same of every member.

    Raises
    ------
    InputError
        Another unit, scale or range of some member's scene.
    """
    found: dict[str, Parameter] = {}
    for member, model in members.items():
        scene = model.forward.scene
        found[member] = scene.parameters[scene.parameter_names.index(split(name)[0])]
    (first, parameter), *others = found.items()
    for member, other in others:
        if other != parameter:
            raise InputError(
                f"hierarchy: '{name}' is {_words(parameter)} for '{first}' and {_words(other)} for "
                f"'{member}': a population has one range and one scale"
            )
    return parameter


def check_own(members: Mapping[str, Model], shared: Sequence[str]) -> None:
    """:class:`InputError` where a prior ties a member's own unknowns to shared ones."""
    for member, model in members.items():
        tied = () if model.dependence is None else model.dependence.names
        if len({name in shared for name in tied}) > 1:
            raise InputError(
                f"hierarchy: the prior of member '{member}' correlates {', '.join(tied)}, of which "
                "only some follow the population"
            )


def _words(parameter: Parameter) -> str:
    return f"{parameter.low:g} to {parameter.high:g} {parameter.unit} ({parameter.scale})".replace(
        "  ", " "
    )
