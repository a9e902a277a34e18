"""The summary and the parameters of a numpydoc docstring, for schemas and help.

Schemas and API pages then share one text of each field.
"""

from __future__ import annotations

import inspect
import re

# ``names : text``, with its further lines indented; under a heading of its section or without one.
_ENTRY = re.compile(r"^(\w[\w, ]*?) : (.*?)(?=^\S|^\s*$|\Z)", re.MULTILINE | re.DOTALL)


def summary(kind: type) -> str:
    """Return the first sentence of a docstring, on one line and without markup."""
    return _plain((kind.__doc__ or "").split("\n\n")[0])


def documented(kind: type) -> dict[str, str]:
    """Return the text of each parameter in the docstrings of a class and its bases, by name."""
    texts: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        for names, text in _ENTRY.findall(inspect.cleandoc(base.__doc__ or "")):
            texts |= dict.fromkeys(names.split(", "), _plain(text))
    return texts


def _plain(text: str) -> str:
    text = re.sub(r":\w+:`~?([^`]*)`", r"\1", " ".join(text.split()))
    return text.replace("``", "").strip()
