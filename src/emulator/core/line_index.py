"""Line numbers of the keys of a TOML or JSON text, which their standard readers do not give.

A path names an entry from the outside in: ``("loads", 1, "kind")`` is ``kind`` of the second
``[[loads]]``. The texts have been read without an error before, so their syntax is not checked.
"""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Iterator, Mapping
from typing import Any

Path = tuple[str | int, ...]

# Strings of several lines, whose last quotes may be their own; strings of one; comments; the rest.
_TOML_TOKEN = re.compile(
    r'''"""(?:\\.|[^\\])*?"{3,5}|'{3}.*?'{3,5}|"(?:\\.|[^"\\])*"|'[^']*'|#[^\n]*|[\[\]{}\n]''',
    re.DOTALL,
)
_JSON_TOKEN = re.compile(r'"(?:\\.|[^"\\])*"|[\[\]{},:]')


def toml_lines(text: str) -> dict[Path, int]:
    """Return the line of each table header and key.

    The text is split into statements: a header or a key with its value, which end where a line
    ends outside of strings and brackets.
    """
    lines: dict[Path, int] = {}
    tables: dict[Path, int] = {}  # number of tables so far in each array of tables
    table: Path = ()
    line = 1
    for statement in _statements(text.replace("\r\n", "\n")):
        entries = tomllib.loads(statement)
        if statement.lstrip().startswith("["):
            table = _table(entries, tables)
            paths = [table]
        else:
            paths = [table + path for path in _paths(entries)]
        for path in paths:
            for depth in range(1, len(path) + 1):
                lines.setdefault(path[:depth], line)
        line += statement.count("\n")
    return lines


def _statements(text: str) -> Iterator[str]:
    """Split a TOML text after each end of a line that is in no string and in no bracket."""
    begin = depth = 0
    for match in _TOML_TOKEN.finditer(text):
        token = match.group()
        if token in ("[", "{"):
            depth += 1
        elif token in ("]", "}"):
            depth -= 1
        elif token == "\n" and depth == 0:
            yield text[begin : match.end()]
            begin = match.end()
    yield text[begin:]


def _table(header: Any, tables: dict[Path, int]) -> Path:
    """Return the path of a header, with the latest table of each array of tables on the way."""
    path: Path = ()
    while header:
        ((name, header),) = header.items()
        path += (name,)
        if isinstance(header, list):  # [[name]], the innermost one, is a new table
            tables[path], header = tables.get(path, 0) + 1, {}
        if path in tables:
            path += (tables[path] - 1,)
    return path


def _paths(entries: Mapping[str, Any]) -> Iterator[Path]:
    for key, value in entries.items():
        yield (key,)
        if isinstance(value, dict):
            yield from ((key, *path) for path in _paths(value))


def json_lines(text: str) -> dict[Path, int]:
    """Return the line of each key."""
    lines: dict[Path, int] = {}
    stack: list[str | int] = []  # key or index in each container that is open
    expects_key = False
    line, position = 1, 0
    for match in _JSON_TOKEN.finditer(text):
        token = match.group()
        line += text.count("\n", position, match.start())
        position = match.start()
        if token in "[{":
            stack.append(0 if token == "[" else "")
            expects_key = token == "{"
        elif token in "]}":
            stack.pop()
        elif token == ",":
            last = stack[-1]
            expects_key = isinstance(last, str)
            stack[-1] = last if isinstance(last, str) else last + 1
        elif token == ":":
            expects_key = False
        elif expects_key:
            stack[-1] = json.loads(token)
            lines.setdefault(tuple(stack), line)
    return lines


def line_of(lines: Mapping[Path, int], path: Path) -> int | None:
    """Return the line of an entry, or of the innermost table around it that has one."""
    return next((lines[path[:k]] for k in range(len(path), 0, -1) if path[:k] in lines), None)
