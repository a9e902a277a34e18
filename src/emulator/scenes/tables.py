"""Tables of a TOML file, read key by key; a mistake names key, what was found and expected."""

from __future__ import annotations

import math
from collections.abc import Collection
from typing import Any

from emulator.errors import InputError


class Table:
    """One table; call :meth:`done` when all that is known has been taken.

    Parameters
    ----------
    entries : what the file has there.
    where : how to call it, e.g. ``[parameters.mu]``; empty for the file itself.
    """

    def __init__(self, entries: Any, where: str = "") -> None:
        if not isinstance(entries, dict):
            raise InputError(f"{where} is {entries!r}; expected a table")
        self.where = where
        self._left = dict(entries)
        self._known: list[str] = []

    def __contains__(self, key: str) -> bool:
        return key in self._left

    def text(self, key: str, default: str | None = None, choices: Collection[str] = ()) -> str:
        """A string, one of ``choices`` if there are any."""
        expected = " or ".join(f'"{choice}"' for choice in choices) or "a string"
        value = self._take(key, default, expected)
        if not isinstance(value, str) or (choices and value not in choices):
            raise self._wrong(key, value, expected)
        return value

    def number(self, key: str, default: float | None = None) -> float:
        """A finite number."""
        value = self._take(key, default, "a number")
        if not _is_number(value):
            raise self._wrong(key, value, "a number")
        return float(value)

    def integer(self, key: str, default: int, choices: Collection[int]) -> int:
        """One of ``choices``."""
        value = self._take(key, default, "")
        if isinstance(value, bool) or value not in choices:
            raise self._wrong(key, value, " or ".join(map(str, choices)))
        return int(value)

    def numbers(
        self, key: str, count: int, default: tuple[float, ...] | None = None
    ) -> tuple[float, ...]:
        """``count`` finite numbers."""
        expected = f"{count} numbers in brackets"
        value = self._take(key, default, expected)
        sound = isinstance(value, list | tuple) and len(value) == count
        if not sound or not all(map(_is_number, value)):
            raise self._wrong(key, value, expected)
        return tuple(map(float, value))

    def tables(self, key: str) -> dict[str, Table]:
        """The tables ``[key.name]`` by name; none when the key is absent."""
        found = self._take(key, {}, "")
        if not isinstance(found, dict):
            raise self._wrong(key, found, f"tables [{key}.<name>]")
        return {name: Table(entries, f"[{key}.{name}]") for name, entries in found.items()}

    def table(self, key: str) -> Table:
        """The table ``[key]``, empty when it is absent."""
        return Table(self._take(key, {}, ""), f"[{key}]")

    def list(self, key: str) -> list[Table]:
        """The tables ``[[key]]``; none when the key is absent."""
        found = self._take(key, [], "")
        if not isinstance(found, list):
            raise self._wrong(key, found, f"tables [[{key}]]")
        return [Table(entries, f"[[{key}]] number {k}") for k, entries in enumerate(found, start=1)]

    def entries(self) -> dict[str, float]:
        """All that is left, each a number."""
        return {key: self.number(key) for key in list(self._left)}

    def check(self, required: Collection[str], optional: Collection[str]) -> None:
        """Refuse the table unless it has the keys that are ``required`` and no unknown ones."""
        self._refuse_unknown([*required, *optional])
        for key in required:
            if key not in self._left:
                raise InputError(f"{self._prefix}key '{key}' is missing")

    def done(self) -> None:
        """Refuse keys nobody took."""
        self._refuse_unknown(self._known)

    def _refuse_unknown(self, known: Collection[str]) -> None:
        unknown = sorted(set(self._left) - set(known))
        if unknown:
            raise InputError(
                f"{self._prefix}unknown key '{unknown[0]}'; known: {', '.join(sorted(known))}"
            )

    @property
    def _prefix(self) -> str:
        return f"{self.where}: " if self.where else ""

    def _take(self, key: str, default: Any, expected: str) -> Any:
        self._known.append(key)
        if key in self._left:
            return self._left.pop(key)
        if default is None:
            raise InputError(f"{self._prefix}key '{key}' is missing; expected {expected}")
        return default

    def _wrong(self, key: str, value: Any, expected: str) -> InputError:
        return InputError(f"{self._prefix}{key} = {value!r}; expected {expected}")


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
