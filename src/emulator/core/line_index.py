"""Line numbers of the keys of a TOML or JSON text, which their standard readers do not give.

A path names an entry from the outside in: ``("loads", 1, "kind")`` is ``kind`` of the second
``[[loads]]``. The texts have been read without an error before, so their syntax is not checked.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterator, Mapping

Path = tuple[str | int, ...]

_TOML_BLANK = re.compile(r"(?:[ \t\r\n]|#[^\n]*)*")
_TOML_KEY = re.compile(r'[ \t]*(?:([\w-]+)|("(?:\\.|[^"\\\n])*"|\'[^\'\n]*\'))[ \t]*(\.?)')
_TOML_TOKEN = re.compile(
    r'"""(?:\\.|[^\\])*?"{3,5}|\'\'\'.*?\'{3,5}'  # strings of several lines, then of one
    r'|"(?:\\.|[^"\\\n])*"|\'[^\'\n]*\'|#[^\n]*|[\[{]|[\]}]|\n|[^"\'#\[\]{}\n]+',
    re.DOTALL,
)
_JSON_TOKEN = re.compile(r'"(?:\\.|[^"\\])*"|[\[\]{},:]')


def toml_lines(text: str) -> dict[Path, int]:
    """Line of each table header and key; keys of inline tables have the line of their table."""
    lines: dict[Path, int] = {}
    counts: dict[Path, int] = {}
    table: Path = ()
    at = _blank(text, 0)
    while at < len(text):
        line = text.count("\n", 0, at) + 1
        if text[at] == "[":
            array = text.startswith("[[", at)
            names, at = _key(text, at + 1 + array)
            around = _resolve(names[:-1], counts)
            table = _next((*around, names[-1]), counts) if array else _resolve(names, counts)
            path = table
        else:
            names, at = _key(text, at)
            path = table + names
        for depth in range(1, len(path) + 1):
            lines.setdefault(path[:depth], line)
        at = _blank(text, _end_of_statement(text, at))
    return lines


def json_lines(text: str) -> dict[Path, int]:
    """Line of each key and list element."""
    lines: dict[Path, int] = {}
    stack: list[str | int] = []  # key or index in each container that is open
    expects_key = False
    for match in _JSON_TOKEN.finditer(text):
        token, line = match.group(), text.count("\n", 0, match.start()) + 1
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
            stack[-1] = _unquoted(token)
            lines.setdefault(tuple(stack), line)
    return lines


def line_of(lines: Mapping[Path, int], path: Path) -> int | None:
    """Line of an entry, or of the innermost table around it that has one."""
    return next((lines[path[:k]] for k in range(len(path), 0, -1) if path[:k] in lines), None)


def _blank(text: str, at: int) -> int:
    match = _TOML_BLANK.match(text, at)
    return match.end() if match else at


def _key(text: str, at: int) -> tuple[Path, int]:
    """Names of a dotted key, and the position after it."""
    names: list[str] = []
    for bare, quoted, dot, end in _key_parts(text, at):
        names.append(bare or _unquoted(quoted))
        at = end
        if not dot:
            break
    return tuple(names), at


def _key_parts(text: str, at: int) -> Iterator[tuple[str, str, str, int]]:
    while match := _TOML_KEY.match(text, at):
        at = match.end()
        yield match[1], match[2], match[3], at


def _unquoted(text: str) -> str:
    return tomllib.loads(f"key = {text}")["key"]


def _end_of_statement(text: str, at: int) -> int:
    """Position of the line break that ends a header or a value."""
    depth = 0
    for match in _TOML_TOKEN.finditer(text, at):
        token = match.group()
        if token == "\n" and depth == 0:
            return match.start()
        depth = max(0, depth + (token in ("[", "{")) - (token in ("]", "}")))  # a header's "]"
    return len(text)


def _resolve(names: Path, counts: Mapping[Path, int]) -> Path:
    """The path of a header, with the latest element of each array of tables on the way."""
    path: Path = ()
    for name in names:
        path += (name,)
        if path in counts:
            path += (counts[path] - 1,)
    return path


def _next(path: Path, counts: dict[Path, int]) -> Path:
    """The path of a new element of the array of tables at ``path``."""
    counts[path] = counts.get(path, 0) + 1
    return (*path, counts[path] - 1)
