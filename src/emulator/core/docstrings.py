"""What numpydoc docstrings say of a class and its parameters, for schemas and help."""

from __future__ import annotations

import inspect
import re

# ``names : text``, with its further lines indented; under a heading of its section or without one.
_ENTRY = re.compile(r"^(\w[\w, ]*?) : (.*?)(?=^\S|^\s*$|\Z)", re.MULTILINE | re.DOTALL)


def summary(kind: type) -> str:
    """First sentence of a docstring, on one line and without markup."""
    return _plain((kind.__doc__ or "").split("\n\n")[0])


def documented(kind: type) -> dict[str, str]:
    """What the docstrings of a class and its bases say of each parameter, by name."""
    found: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        for names, text in _ENTRY.findall(inspect.cleandoc(base.__doc__ or "")):
            found |= dict.fromkeys(names.split(", "), _plain(text))
    return found


def _plain(text: str) -> str:
    text = re.sub(r":\w+:`~?([^`]*)`", r"\1", " ".join(text.split()))
    return text.replace("``", "").strip()
