"""The public names with their arguments: ``python -m tests.public_names`` writes them to a file.

Public are the names of ``emulator`` and ``calibrate`` and those of their public sub-modules'
``__all__``, as ``tests/ceilings.py`` counts them. ``tests/public_names.txt`` has a line for each.
"""

from __future__ import annotations

import inspect
from collections.abc import Iterator, Mapping
from enum import Enum
from pathlib import Path
from types import ModuleType

FILE = Path(__file__).with_suffix(".txt")
COMMAND = "python -m tests.public_names"
KEEP = (
    "keep it for one release with a DeprecationWarning that names the version "
    '(CONTRIBUTING.md, "Deprecation")'
)


def public_names() -> dict[str, str]:
    """Return the arguments of every public name, as text, by its name with its module."""
    import calibrate
    import emulator

    names = {}
    for package in (emulator, calibrate):
        modules = {name: getattr(package, name) for name in package.__all__}
        sub_modules = {n: m for n, m in modules.items() if isinstance(m, ModuleType)}
        for door, module in {"": package, **sub_modules}.items():
            path = ".".join(filter(None, (package.__name__, door)))
            names |= {f"{path}.{n}": arguments_of(getattr(module, n)) for n in module.__all__}
    return dict(sorted(names.items()))


def arguments_of(thing: object) -> str:
    """Return names of arguments in parentheses, ``*`` before keyword-only ones; "" for data.

    An argument with a default ends in ``=``, since its absence is then no error. Enumerations,
    errors and protocols are not made by calls of users.
    """
    is_class = isinstance(thing, type)
    if is_class and (
        issubclass(thing, Enum | BaseException) or getattr(thing, "_is_protocol", False)
    ):
        return ""
    if isinstance(thing, ModuleType) or not callable(thing):
        return ""
    words, before = [], ""
    for p in inspect.signature(thing).parameters.values():
        if p.name.startswith("_"):
            continue
        if p.kind is p.KEYWORD_ONLY and before not in ("VAR_POSITIONAL", "KEYWORD_ONLY"):
            words.append("*")
        before = p.kind.name
        stars = {"VAR_POSITIONAL": "*", "VAR_KEYWORD": "**"}.get(before, "")
        words.append(f"{stars}{p.name}" + ("=" if p.default is not p.empty else ""))
    return f"({', '.join(words)})"


def as_text(names: Mapping[str, str]) -> str:
    """Return the file of these names."""
    return "".join(f"{name}{arguments}\n" for name, arguments in names.items())


def read(text: str) -> dict[str, str]:
    """Return names and arguments of the file's text."""
    pairs = (line.partition("(") for line in text.splitlines())
    return {name: bracket + rest for name, bracket, rest in pairs}


def problems(before: Mapping[str, str], now: Mapping[str, str]) -> Iterator[str]:
    """Yield one sentence per name that is gone, new or has other arguments, with its remedy.

    before : names and arguments that the file has.
    now : names and arguments of the packages.
    """
    for name in before.keys() - now.keys():
        yield f"{name} is gone or renamed: {KEEP}"
    for name in now.keys() - before.keys():
        yield f"{name} is new: {COMMAND}"
    for name in before.keys() & now.keys():
        old, new = before[name], now[name]
        if old != new and breaks(old, new):
            yield f"{name}{old} is now {name}{new}, which breaks calls: {KEEP}"
        elif old != new:
            yield f"{name}{old} is now {name}{new}: {COMMAND}"


def breaks(old: str, new: str) -> bool:
    """Return whether a call that the arguments ``old`` take may fail, or mean another, with ``new``."""
    (by_place, by_name), (new_by_place, new_by_name) = _split(old), _split(new)
    names = {word.rstrip("=") for word in (*by_place, *by_name)}
    new_names = {word.rstrip("=") for word in (*new_by_place, *new_by_name)}
    order = [word.rstrip("=") for word in by_place]
    required = [
        word for word in (*new_by_place, *new_by_name) if word[-1] != "=" and "*" not in word
    ]
    return (
        not names <= new_names
        or [word.rstrip("=") for word in new_by_place][: len(order)] != order
        or any(word not in (*by_place, *by_name) for word in required)
    )


def _split(arguments: str) -> tuple[list[str], list[str]]:
    """Return the arguments that a call may give by position, and the others."""
    words = [word for word in arguments.strip("()").split(", ") if word]
    stars = [k for k, word in enumerate(words) if word.startswith("*")]
    end = stars[0] if stars else len(words)
    return words[:end], [word for word in words[end:] if word != "*"]


def main() -> None:
    """Rewrite the file."""
    FILE.write_text(as_text(public_names()), encoding="utf-8")
    print(f"{len(public_names())} names in tests/{FILE.name}")


if __name__ == "__main__":
    main()
