"""How objects show themselves: one line as text, a small table in a notebook."""

from __future__ import annotations

from abc import abstractmethod
from html import escape


class Shown:
    """An object that says what it is in a title and a few rows."""

    @abstractmethod
    def shown(self) -> tuple[str, list[tuple[str, str]]]:
        """A title, and what there is to know, by name."""

    def __repr__(self) -> str:
        """The title and all rows in a line."""
        title, rows = self.shown()
        return f"<{title}: {'; '.join(f'{name} {value}' for name, value in rows)}>"

    def _repr_html_(self) -> str:
        """The same as a table, for notebooks."""
        title, rows = self.shown()
        body = "".join(
            f'<tr><td style="text-align:left"><b>{escape(name)}</b></td>'
            f'<td style="text-align:left">{escape(value)}</td></tr>'
            for name, value in rows
        )
        return f"<table><caption>{escape(title)}</caption>{body}</table>"
