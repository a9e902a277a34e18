"""The blocks of pages, and the template that renders them (``page.html.j2``)."""

from __future__ import annotations

import io
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import plotly.graph_objects as go
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup
from plotly.io import to_html
from plotly.offline import get_plotlyjs

from calibrate.figures import pyplot
from calibrate.project import Run

GOOD, UNSURE, BAD = "#00684a", "#8a5a00", "#9c2a00"
"""Colours of verdicts, from the best to the worst."""

SUMMARY = ("mean", "sd", "5 %", "95 %", "R-hat", "ESS bulk", "ESS tail")
"""Titles of :func:`summary_cells`."""

_COLOURS = {"accepted": GOOD, "reweight": UNSURE, "undecided": UNSURE}


class Verdict(NamedTuple):
    """The box at the top of a page.

    text : the verdict in one or two words, on :data:`GOOD`, :data:`UNSURE` or :data:`BAD`.
    findings : the sentences below the verdict. basis : what the verdict rests on.
    warnings : the sentences about the run, shown below the box.
    """

    text: str
    colour: str
    findings: Sequence[str]
    basis: str
    warnings: Sequence[str]


def render(
    title: str, heading: str, verdict: Verdict, sections: Sequence[tuple[str, Sequence[Markup]]]
) -> str:
    """Return the whole page as HTML; ``sections`` are titles with their blocks."""
    templates = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return templates.get_template("page.html.j2").render(
        title=title,
        heading=heading,
        verdict=verdict,
        sections=sections,
        warning_colour=BAD,
        drawing_library=get_plotlyjs(),
    )


def colour_of(verdict: str) -> str:
    """Return the colour of a verdict; an unknown verdict has the worst."""
    return _COLOURS.get(verdict, BAD)


def paragraph(text: str, style: str = "") -> Markup:
    """Return a paragraph; ``style`` is ``note``, ``warning``, ``lines`` or empty."""
    attribute = Markup(' class="{}"').format(style) if style else ""
    return Markup("<p{}>{}</p>").format(attribute, text)


def note(text: str) -> Markup:
    """Return a paragraph that explains."""
    return paragraph(text, "note")


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> Markup:
    """Return a table; a cell is plain text or markup."""

    def row(tag: str, cells: Sequence[str]) -> Markup:
        cell = Markup(f"<{tag}>{{}}</{tag}>")
        return Markup("<tr>{}</tr>\n").format(Markup("").join(map(cell.format, cells)))

    body = Markup("").join(row("td", cells) for cells in rows)
    return Markup("<table>{}{}</table>").format(row("th", head), body)


def chart(figure: go.Figure) -> Markup:
    """Return a figure in the page's style, drawn by the page's own library."""
    figure.update_layout(template="simple_white", margin={"t": 50, "b": 40}, font={"size": 13})
    if figure.layout.height is None:
        figure.update_layout(height=420)
    # Not played: a body is shown at its mean, not in motion through the draws.
    options = {"full_html": False, "include_plotlyjs": False, "auto_play": False}
    return Markup(to_html(figure, config={"displaylogo": False}, **options))


def picture(figure: Any) -> Markup:
    """Return a figure of :mod:`calibrate.figures` as it is, drawn by no library."""
    text = io.StringIO()
    with pyplot().rc_context({"svg.hashsalt": "page", "svg.fonttype": "none"}):
        figure.savefig(text, format="svg", metadata={"Date": None})
    pyplot().close(figure)
    return Markup(text.getvalue()[text.getvalue().index("<svg") :])


def summary_cells(row: Mapping[str, float]) -> list[str]:
    """Return a row of :func:`calibrate.posterior.diagnosis.summary_of` as text, titled SUMMARY."""
    numbers = [f"{row[key]:.4g}" for key in ("mean", "sd", "low", "high")]
    return [*numbers, f"{row['r_hat']:.4f}", f"{row['ess_bulk']:.0f}", f"{row['ess_tail']:.0f}"]


def median_and_range(values: np.ndarray, form: str = ".1f") -> str:
    """Return median and central 90 % of draws (s,), each number in the format ``form``."""
    low, middle, high = (format(number, form) for number in np.quantile(values, [0.05, 0.5, 0.95]))
    return f"{middle} ({low} to {high})"


def attributes(values: Mapping[Any, Any], omitted: Iterable[str]) -> Markup:
    """Return a table of a posterior's attributes that are not empty and not ``omitted``."""
    texts = {str(key): in_text(value) for key, value in values.items() if key not in omitted}
    return table(("", ""), [(key, text) for key, text in texts.items() if text])


def in_text(value: Any) -> str:
    """Return an attribute in words; an empty text where the attribute has no content."""
    if isinstance(value, str) and value[:1] in ("{", "[", "n"):
        with suppress(ValueError):
            value = json.loads(value)
    if isinstance(value, float) and not math.isfinite(value):
        return ""
    if isinstance(value, Mapping):
        texts = {str(key): text for key, v in value.items() if (text := in_text(v))}
        return "; ".join(f"{key}: {text}" if key else text for key, text in texts.items())
    if isinstance(value, list):
        return ", ".join(map(in_text, value))
    return "" if value is None else str(value)


def changed_settings(run: Run) -> dict[str, Any]:
    """Return the entries of a run that differ from its defaults, and its scene."""
    defaults = asdict(Run(run.scene))
    return {k: v for k, v in asdict(run).items() if k == "scene" or v != defaults[k]}


def how_to_repeat(settings: Mapping[str, Any], subject: str, program: str) -> list[Markup]:
    """Return the settings of ``subject`` as JSON, and the program that repeats it."""
    code = Markup("<pre>{}</pre>")
    return [
        paragraph(f"{subject}, where it is not as usual (all of it is in run.json):"),
        code.format(json.dumps(settings, indent=2)),
        paragraph("To repeat it:"),
        code.format(program),
    ]
