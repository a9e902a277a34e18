"""Progress bars of long computations, and tables for the ``repr`` of results.

A bar is drawn over itself on a terminal. Elsewhere a line is written now and then: a log file would
keep every one of a bar's states.
"""

from __future__ import annotations

import sys
import time
from abc import abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from html import escape
from typing import Any

from tqdm import tqdm

EVERY = 10.0  # seconds between two lines; shorter work says nothing


class Lines(tqdm):
    """A tqdm bar that prints lines, such as ``FEM check: 120 of 200 runs, 65 s, 43 s left``."""

    disable: bool

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, mininterval=EVERY, miniters=1, delay=EVERY, **options)
        self._last_line = 0.0

    def display(self, msg: str | None = None, pos: int | None = None) -> None:  # noqa: ARG002
        """Print the progress, if the last line is older than ``EVERY`` seconds."""
        seconds = self._time() - self.start_t
        if seconds - self._last_line < EVERY:
            return
        self._last_line = seconds
        of = f" of {self.total:g}" if self.total else ""
        postfix = f", {self.postfix}" if self.postfix else ""
        unit = "" if self.unit == "it" else f" {self.unit}s"
        done, left = self.n - self.initial, ""
        if self.total and done > 0 and self.n < self.total:
            left = f", {seconds * (self.total - self.n) / done:.0f} s left"
        print(f"{self.desc or 'done'}: {self.n:g}{of}{unit}, {seconds:.0f} s{left}{postfix}",
              file=self.fp, flush=True)  # fmt: skip

    def close(self) -> None:
        """Print the last line, if earlier ones were printed."""
        if self.disable:
            return
        if self._last_line:
            self._last_line = -EVERY
            self.display()
        self.disable = True
        self._decr_instances(self)


def counting(*arguments: Any, **options: Any) -> tqdm:
    """Return tqdm's bar where standard error is a terminal, else :class:`Lines`."""
    return (tqdm if sys.stderr.isatty() else Lines)(*arguments, **options)


class Stages:
    """The stages of a piece of work: each one's seconds, printed as it ends.

    seconds : the seconds of each finished stage, by its name.
    """

    def __init__(self, *, show: bool) -> None:
        self.seconds: dict[str, float] = {}
        self._show = show

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        """Time the stage ``name``; one that took less than ``EVERY`` seconds is not printed."""
        begin = time.perf_counter()
        yield
        self.seconds[name] = seconds = round(time.perf_counter() - begin, 2)
        if self._show and seconds >= EVERY:
            print(f"{name}: {seconds:.1f} s", file=sys.stderr, flush=True)


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
