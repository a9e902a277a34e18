"""Words and JSON of an observation, from the declaration of its kind."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from calibrate.measurements.observation import Observation
from calibrate.measurements.points import PointObservation
from emulator.core.errors import InputError
from emulator.core.rooms import offered
from emulator.scenes.forward_problem import ForwardProblem


def kinds_of(scene: ForwardProblem) -> Mapping[str, type[Observation]]:
    """Return the kinds of observation of a problem by name: of another program, its outputs."""
    (of_problem,) = offered(*scene.observed_by.split(":"))
    kinds: Mapping[str, type[Observation]] = of_problem(scene)
    return kinds


def kinds_of_bodies(_: ForwardProblem) -> Mapping[str, type[Observation]]:
    """Return the kinds of observation of a body at rest or a specimen, by name."""
    from calibrate.measurements import OBSERVATIONS  # which imports this file

    return OBSERVATIONS


def names_of(part: Observation) -> tuple[str, ...]:
    """Return the possible names of an observation in a data file, the usual one first."""
    if isinstance(part, PointObservation):
        return (part.name.format(*part.selection),)
    name = ":".join([part.kind, *(str(getattr(part, argument)) for argument in part.arguments)])
    return (part.kind, name) if part.kind_is_name else (name,)


def usage_of(kind: type[Observation]) -> str:
    """Return the words that ask for a kind, for help and errors."""
    words = [
        f"{name[:-1]},...".upper() if name.endswith("s") else name.replace("_", "").upper()
        for name in kind.arguments
    ]
    if issubclass(kind, PointObservation) and kind.spread is not None:
        words.append("N")
    usage = ":".join([kind.kind, *words])
    return f"{kind.kind}, {usage}{kind.hint}" if kind.kind_is_name and words else usage + kind.hint


def parse(
    kind: type[Observation], scene: ForwardProblem, word: str, seed: int = 0
) -> tuple[str, Observation]:
    """Return the name and the observation that ``word`` of the command line asks for.

    The word is the kind, its arguments and, of places drawn at random from ``seed``, their number,
    joined by colons.

    :class:`InputError` for a word that the kind cannot read.
    """
    spread = kind.spread if issubclass(kind, PointObservation) else None
    misuse = InputError(f"observe '{word}': give {usage_of(kind)}")
    rest = word.partition(":")[2]
    count = len(kind.arguments) + (spread is not None)
    texts = rest.split(":") if count > 1 else [rest] if count or rest else []
    # A single number may make do without its only argument, as the volume of the only cavity does.
    may_be_empty = count == 1 and not issubclass(kind, PointObservation)
    if len(texts) != count or not (all(texts) or may_be_empty):
        raise misuse
    try:
        if spread is None:
            part = kind.of(scene, *texts)
        else:
            *selection, number = texts
            if not (number.isascii() and number.isdigit()) or int(number) < 1:
                raise InputError(f"observe '{word}': '{number}' is not a number of {kind.kind}")
            part = kind.of(scene, *selection, spread(scene, *selection, int(number), seed))
    except InputError:
        raise
    except ValueError:  # text that is no number
        raise misuse from None
    return (names_of(part)[0] if isinstance(part, PointObservation) else word), part


def to_json(part: Observation) -> dict[str, Any]:
    """Return plain JSON from which :func:`from_json` makes the observation again."""
    if not isinstance(part, PointObservation):
        return {"kind": part.kind, "word": names_of(part)[-1]}
    names = [*part.arguments, *([part.place] if part.place else [])]
    values = {name: getattr(part, name) for name in names}
    plain = {n: v if isinstance(v, str) else np.asarray(v).tolist() for n, v in values.items()}
    return {"kind": part.kind, **plain}


def from_json(
    kind: type[Observation], scene: ForwardProblem, description: Mapping[str, Any]
) -> Observation:
    """Return the observation that :func:`to_json` described."""
    if not issubclass(kind, PointObservation):
        return parse(kind, scene, description["word"])[1]
    places = [np.asarray(description[kind.place])] if kind.place else []
    return kind.of(scene, *(description[name] for name in kind.arguments), *places)
