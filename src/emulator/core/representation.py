"""How objects show themselves: one line as text, a small table in a notebook."""

from __future__ import annotations

from abc import abstractmethod
from html import escape


class TableRepr:
    """An object that is represented by a title and a few named rows."""

    @abstractmethod
    def summary_rows(self) -> tuple[str, list[tuple[str, str]]]:
        """Return the title, and the rows as pairs of a name and its text."""

    def __repr__(self) -> str:
        """Return the title and all rows on one line."""
        title, rows = self.summary_rows()
        return f"<{title}: {'; '.join(f'{name} {value}' for name, value in rows)}>"

    def _repr_html_(self) -> str:
        """Return the title and all rows as an HTML table, which notebooks show."""
        title, rows = self.summary_rows()
        body = "".join(
            f'<tr><td style="text-align:left"><b>{escape(name)}</b></td>'
            f'<td style="text-align:left">{escape(value)}</td></tr>'
            for name, value in rows
        )
        return f"<table><caption>{escape(title)}</caption>{body}</table>"
