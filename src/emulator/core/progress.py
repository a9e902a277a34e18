"""Progress of long work: a bar on a terminal, elsewhere a line now and then.

A bar is drawn over itself, and a log file would keep every one of its states.
"""

from __future__ import annotations

import sys
from typing import Any

from tqdm import tqdm

EVERY = 10.0  # seconds between two lines; shorter work says nothing


class Lines(tqdm):
    """A tqdm bar that prints lines, such as ``FEM check: 120 of 200 runs, 65 s``."""

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
        print(f"{self.desc or 'done'}: {self.n:g}{of}{unit}, {seconds:.0f} s{postfix}",
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
