"""Every kind of forward map by name: the one list of them.

To add one, write its map and its :class:`~emulator.surrogates.protocol.ForwardKind` in a file, and
add it here; command line, calibration and evaluation then know it.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from emulator.core.errors import InputError, look_up
from emulator.core.rooms import offered
from emulator.core.store import read_arrays, save_arrays
from emulator.surrogates.corrected import CORRECTED
from emulator.surrogates.emulator import EMULATOR
from emulator.surrogates.fem import FEM
from emulator.surrogates.pod_gp import REDUCED
from emulator.surrogates.protocol import ForwardKind, ForwardMap, Ingredients, Option
from emulator.surrogates.taught import ROUNDS

FORWARD_MAPS: dict[str, ForwardKind] = {
    kind.name: kind
    for kind in (
        EMULATOR,
        CORRECTED,
        REDUCED,
        ROUNDS,
        FEM,
        *offered("emulator.specimens.homogeneous", "HOMOGENEOUS"),
        *offered("emulator.specimens.homogeneous", "INCOMPRESSIBLE"),
        *offered("emulator.external.rows", "ROWS"),
    )
}


def forward_kind(name: str) -> ForwardKind:
    """Return the kind called ``name``; :class:`InputError` lists the known ones."""
    return look_up(FORWARD_MAPS, name, "forward map")


def known_options() -> dict[str, tuple[Option, tuple[str, ...]]]:
    """Return every option of every kind by name, with the names of the kinds that take it."""
    owners_by_option: dict[str, tuple[Option, tuple[str, ...]]] = {}
    for kind in FORWARD_MAPS.values():
        for option in kind.options:
            first, owners = owners_by_option.get(option.name, (option, ()))
            owners_by_option[option.name] = (first, (*owners, kind.name))
    return owners_by_option


def full_options(name: str, options: Mapping[str, Any]) -> dict[str, int]:
    """Return a value of every option of the kind called ``name``, from ``options`` or by default.

    An option that it does not take is refused, and a value out of range.
    """
    kind = forward_kind(name)
    if not isinstance(options, Mapping):
        raise InputError(f"options of a forward map are {options!r}; give a value by name")
    options_by_name = known_options()
    for word in options:
        if word not in options_by_name:
            raise InputError(f"forward map '{name}' has no option '{word}'")
        option, owners = options_by_name[word]
        if name not in owners:
            raise InputError(f"{option.flag} has no effect without --forward {' or '.join(owners)}")
    return {o.name: o.checked(options.get(o.name, o.default)) for o in kind.options}


def check_words(name: str, **words: str | None) -> None:
    """Refuse an ``emulator`` that has no effect on the kind called ``name``."""
    for word, value in words.items():
        owners = [kind.name for kind in FORWARD_MAPS.values() if word in kind.words]
        if value is not None and name not in owners:
            raise InputError(f"--{word} has no effect without --forward {' or '.join(owners)}")


def build_forward(
    name: str, ingredients: Ingredients, options: Mapping[str, Any] = {}
) -> ForwardMap:
    """Return the forward map called ``name`` over all nodes, with the ``options`` given."""
    return forward_kind(name).build(ingredients, full_options(name, options))


def keep_forward(forward: ForwardMap, path: str | Path) -> None:
    """Write the arrays of a map that was fitted while it was built; for other maps, nothing."""
    kind = FORWARD_MAPS.get(forward.kind)
    if kind is not None and kind.to_arrays is not None:
        save_arrays(path, kind.to_arrays(forward), {"kind": kind.name})


def restore_forward(
    name: str, ingredients: Ingredients, options: Mapping[str, Any], path: str | Path
) -> ForwardMap:
    """Return the map that :func:`keep_forward` wrote, or a new one of a kind that writes none.

    A file that is missing, damaged or of another kind is refused.
    """
    kind = forward_kind(name)
    if kind.from_arrays is None:
        return build_forward(name, ingredients, options)
    if not Path(path).is_file():
        raise InputError(f"{path}, the {name} map of the posterior beside it, is missing")
    arrays, metadata = read_arrays(path)
    if metadata.get("kind") != name:
        raise InputError(f"{path} holds no {name} map; infer again")
    try:
        return kind.from_arrays(ingredients.scene, arrays)
    except KeyError as error:
        raise InputError(f"{path}: array {error} is missing; infer again") from error
