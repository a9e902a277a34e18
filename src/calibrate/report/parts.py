"""What pages are made of: the frame, the verdict's box, tables, charts, and values in words."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict
from html import escape
from typing import Any

import numpy as np
import plotly.graph_objects as go
from plotly.io import to_html
from plotly.offline import get_plotlyjs

from calibrate.project import Run

GOOD, UNSURE, BAD = "#00684a", "#8a5a00", "#9c2a00"
"""Colours of verdicts, from the best to the worst."""

SUMMARY = ("mean", "sd", "5 %", "95 %", "R-hat", "ESS bulk", "ESS tail")
"""Titles of :func:`summary_cells`."""

_COLOURS = {
    "accepted": GOOD, "decided by FEM": GOOD, "reweight": UNSURE, "undecided": UNSURE,
}  # fmt: skip
_STYLE = f"""
body {{ font: 16px/1.5 system-ui, sans-serif; color: #1c1c1c; margin: 0 auto; max-width: 1060px;
  padding: 0 20px 60px; }}
h1 {{ margin: 28px 0 4px; }} h2 {{ margin: 40px 0 8px; border-bottom: 1px solid #ccc; }}
.verdict {{ color: white; padding: 14px 18px; border-radius: 6px; margin: 18px 0; }}
.verdict b {{ font-size: 1.25em; }} .note {{ color: #555; }} .warning {{ color: {BAD}; }}
table {{ border-collapse: collapse; }} td, th {{ padding: 4px 14px 4px 0; text-align: right; }}
td:first-child, th:first-child {{ text-align: left; }}
tr + tr {{ border-top: 1px solid #e4e4e4; }}
pre {{ background: #f5f5f5; padding: 12px; overflow-x: auto; font-size: 13px; }}
"""


class Markup(str):
    """A cell of a table that is HTML already."""

    __slots__ = ()


def frame(title: str, heading: str, first: str, sections: Iterable[tuple[str, str]]) -> str:
    """The whole page: ``heading``, ``first`` (HTML), then sections, each a title and HTML."""
    body = "".join(f"<h2>{escape(name)}</h2>{content}" for name, content in sections)
    return (
        f'<!DOCTYPE html><html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title>'
        f"<style>{_STYLE}</style><script>{get_plotlyjs()}</script></head><body>"
        f"<h1>{escape(heading)}</h1>{first}{body}</body></html>"
    )


def colour_of(verdict: str) -> str:
    """The colour of a verdict; of one that is not known, the worst."""
    return _COLOURS.get(verdict, BAD)


def verdict_box(
    verdict: str, colour: str, findings: Iterable[str], judged: str, warnings: Iterable[str]
) -> str:
    """A verdict with its findings and what it rests on, and below it what is wrong with the run."""
    items = "".join(f"<li>{escape(each)}</li>" for each in findings)
    return (
        f'<div class="verdict" style="background:{colour}"><b>{escape(verdict)}</b>'
        f"<ul>{items}</ul><small>{escape(judged)}</small></div>{as_warnings(warnings)}"
    )


def as_warnings(sentences: Iterable[str]) -> str:
    """A paragraph for each sentence, in the colour of what is wrong."""
    return "".join(f'<p class="warning">{escape(each)}</p>' for each in sentences)


def note(text: str) -> str:
    """A paragraph that explains."""
    return f'<p class="note">{escape(text)}</p>'


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table; cells are text, or :class:`Markup`."""
    cells = ["".join(f"<th>{escape(each)}</th>" for each in head)]
    cells += ["".join(f"<td>{_cell(each)}</td>" for each in row) for row in rows]
    return f"<table>{''.join(f'<tr>{line}</tr>' for line in cells)}</table>"


def _cell(value: str) -> str:
    return value if isinstance(value, Markup) else escape(str(value))


def summary_cells(row: Mapping[str, float]) -> list[str]:
    """A row of :func:`calibrate.posterior.diagnosis.summary_of` as text, titled by SUMMARY."""
    numbers = [f"{row[key]:.4g}" for key in ("mean", "sd", "low", "high")]
    return [*numbers, f"{row['r_hat']:.4f}", f"{row['ess_bulk']:.0f}", f"{row['ess_tail']:.0f}"]


def median_and_range(values: np.ndarray, form: str = ".1f") -> str:
    """Median and central 90 % of draws (s,), each number in the format ``form``."""
    low, middle, high = (format(each, form) for each in np.quantile(values, [0.05, 0.5, 0.95]))
    return f"{middle} ({low} to {high})"


def chart(figure: go.Figure) -> str:
    """A chart as HTML that draws with the page's own library."""
    figure.update_layout(template="simple_white", margin={"t": 50, "b": 40}, font={"size": 13})
    if figure.layout.height is None:
        figure.update_layout(height=420)
    return to_html(figure, full_html=False, include_plotlyjs=False, config={"displaylogo": False})


def attributes(found: Mapping[Any, Any], leave_out: Iterable[str]) -> str:
    """A table of a posterior's attributes that say something."""
    named = {str(key): value for key, value in found.items() if key not in leave_out}
    return table(
        ("", ""), [(key, told) for key, value in named.items() if (told := in_text(value))]
    )


def in_text(value: Any) -> str:
    """An attribute in words; nothing where it says nothing."""
    if isinstance(value, str) and value[:1] in ("{", "[", "n"):
        with suppress(ValueError):
            value = json.loads(value)
    if isinstance(value, float) and not math.isfinite(value):
        return ""
    if isinstance(value, Mapping):
        parts = {str(k): told for k, v in value.items() if (told := in_text(v))}
        return "; ".join(f"{name}: {told}" if name else told for name, told in parts.items())
    if isinstance(value, list):
        return ", ".join(map(in_text, value))
    return "" if value is None else str(value)


def not_as_usual(run: Run) -> dict[str, Any]:
    """Entries of a run that are not its defaults, and its scene."""
    usual = asdict(Run(run.scene))
    return {k: v for k, v in asdict(run).items() if k == "scene" or v != usual[k]}


def how_to_repeat(settings: Mapping[str, Any], kept: str, program: str) -> str:
    """Settings as JSON, after the words ``kept``, and the program that repeats them."""
    return (
        f"<p>{kept}, where it is not as usual (all of it is in <code>run.json</code>):</p>"
        f"<pre>{escape(json.dumps(settings, indent=2))}</pre>"
        f"<p>To repeat it:</p><pre>{escape(program)}</pre>"
    )
