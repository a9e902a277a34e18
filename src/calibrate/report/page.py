"""The page: verdict first, then data, parameters, body, what is known, and how to repeat it."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from html import escape
from pathlib import Path
from typing import Any

import plotly.graph_objects as go
from plotly.io import to_html
from plotly.offline import get_plotlyjs

from calibrate.certificate.verdict import shifts
from calibrate.identifiability.combinations import identify, in_words
from calibrate.posterior import Posterior
from calibrate.report import charts
from calibrate.report.body import body_figure
from calibrate.state_names import split
from calibrate.workflow import Run, read_posterior, simulator_of
from calibrate.workflow.workflow import CERTIFICATE, REPORT
from emulator.store import read_json, replacing

_COLOURS = {"accepted": "#00684a", "reweight": "#8a5a00", "undecided": "#8a5a00"}
_NOT = "#9c2a00"
_MOVED = {"FEM": "by FEM / sd", "mesh": "on a finer mesh / sd"}
_STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; color: #1c1c1c; margin: 0 auto; max-width: 1060px;
  padding: 0 20px 60px; }
h1 { margin: 28px 0 4px; } h2 { margin: 40px 0 8px; border-bottom: 1px solid #ccc; }
.verdict { color: white; padding: 14px 18px; border-radius: 6px; margin: 18px 0; }
.verdict b { font-size: 1.25em; } .note { color: #555; } .warning { color: #9c2a00; }
table { border-collapse: collapse; } td, th { padding: 4px 14px 4px 0; text-align: right; }
td:first-child, th:first-child { text-align: left; } tr + tr { border-top: 1px solid #e4e4e4; }
pre { background: #f5f5f5; padding: 12px; overflow-x: auto; font-size: 13px; }
"""


def write_report(folder: str | Path, out: str | Path | None = None, *, fem: bool = True) -> Path:
    """Write one HTML file about the posterior in ``folder``, ``report.html`` there by default.

    fem : solve once at the posterior's mean, to show the map's error on the body.

    Raises
    ------
    InputError
        ``folder`` holds no posterior, or one of another run or map.
    """
    folder = Path(folder)
    run, posterior = read_posterior(folder)
    path = folder / CERTIFICATE
    certificate = read_json(path) if path.is_file() else None
    page = html_of(run, posterior, certificate, fem=fem)
    target = folder / REPORT if out is None else Path(out)
    with replacing(target) as temporary:
        temporary.write_text(page, encoding="utf-8")
    return target


def html_of(
    run: Run, posterior: Posterior, certificate: dict[str, Any] | None, *, fem: bool = True
) -> str:
    """The page as text."""
    scene = posterior.model.forward.scene
    simulator = simulator_of(scene) if fem else None
    sections = [
        ("Data against prediction", _data(posterior)),
        ("Parameters", _parameters(run, posterior, certificate)),
        ("The body", _body(posterior, simulator)),
        ("What the data determine", _known(posterior)),
        ("Draws", _draws(posterior)),
        ("Where this comes from, and how to repeat it", _provenance(run, posterior)),
    ]
    body = "".join(f"<h2>{escape(title)}</h2>{content}" for title, content in sections)
    title = f"{scene.name}: posterior of {', '.join(posterior.model.names)}"
    return (
        f'<!DOCTYPE html><html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title>'
        f"<style>{_STYLE}</style><script>{get_plotlyjs()}</script></head><body>"
        f"<h1>{escape(scene.name)}</h1>{_verdict(posterior, certificate)}{body}</body></html>"
    )


def _verdict(posterior: Posterior, certificate: dict[str, Any] | None) -> str:
    """The certificate's verdict and findings, and what is wrong with the run."""
    if certificate is None:
        decided = "fem_solves" in posterior.tree.attrs
        verdict = "decided by FEM" if decided else "not certified"
        findings = [] if decided else ["no certificate yet: run calibrate certify on this folder"]
    else:
        verdict, findings = certificate["verdict"], certificate["findings"]
    items = "".join(f"<li>{escape(each)}</li>" for each in findings)
    warnings = "".join(f'<p class="warning">{escape(each)}</p>' for each in posterior.warnings())
    colour = _COLOURS.get(verdict, _NOT)
    return (
        f'<div class="verdict" style="background:{colour}"><b>{escape(verdict)}</b>'
        f"<ul>{items}</ul></div>{warnings}"
    )


def _data(posterior: Posterior) -> str:
    found = [_chart(figure) for _, figure in charts.against_data(posterior)]
    return "".join(found) or '<p class="note">The run kept no predictions.</p>'


def _parameters(run: Run, posterior: Posterior, certificate: dict[str, Any] | None) -> str:
    labels, cut = charts.names_with_units(posterior), posterior.model.prior_cut
    head = ["", "mean", "sd", "5 %", "95 %", "R-hat", "ESS bulk", "ESS tail", "prior"]
    truth = run.truth if run.data == "synthetic" else {}
    priors = json.loads(posterior.tree.attrs.get("prior", "{}"))
    head += ["truth"] if truth else []
    moved = shifts(certificate or {})
    head += [_MOVED[what] for what in moved]
    rows = []
    for name, row in posterior.summary().items():
        numbers = [f"{row[key]:.4g}" for key in ("mean", "sd", "low", "high")]
        numbers += [f"{row['r_hat']:.4f}", f"{row['ess_bulk']:.0f}", f"{row['ess_tail']:.0f}"]
        numbers.append(priors.get(name, priors.get(split(name)[0], "")))
        numbers += [f"{truth[name]:.4g}" if name in truth else ""] if truth else []
        numbers += [f"{shift[name]:+.2f}" if name in shift else "" for shift in moved.values()]
        rows.append((labels[name], *numbers))
    lost = "".join(
        f'<p class="note">{escape(n)}: {100 * share:.2g} % of the prior lies where the map has no '
        "answer and was left out.</p>"
        for n, share in cut.items() if share
    )  # fmt: skip
    return _table(head, rows) + lost


def _body(posterior: Posterior, simulator: Any) -> str:
    note = (
        '<p class="note">Drag to turn. The slider goes through draws of the posterior; the menu '
        "changes the colour; fibres and the body at rest are in the legend.</p>"
    )
    return note + _chart(body_figure(posterior, simulator))


def _known(posterior: Posterior) -> str:
    words = escape(in_words(identify(posterior))).replace("\n", "<br>")
    found = f"<p>{words}</p>{_chart(charts.stress(posterior))}"
    curve = charts.volume_band(posterior)
    return found + (_chart(curve) if curve is not None else "")


def _draws(posterior: Posterior) -> str:
    found = _chart(charts.traces(posterior))
    return found + (_chart(charts.pairs(posterior)) if len(posterior.model.names) > 1 else "")


def _provenance(run: Run, posterior: Posterior) -> str:
    attributes = {str(k): v for k, v in posterior.tree.attrs.items() if k not in ("run", "observe")}
    rows = [(key, _short(value)) for key, value in attributes.items()]
    again = (
        "from calibrate.workflow import infer, read_posterior\n\n"
        'run, _ = read_posterior("THIS FOLDER")\n'
        'infer(run, "ANOTHER FOLDER")  # the same draws'
    )
    settings = escape(json.dumps(asdict(run), indent=2))
    return (
        f"{_table(('', ''), rows)}<p>The run (<code>run.json</code>):</p><pre>{settings}</pre>"
        f"<p>To repeat it:</p><pre>{escape(again)}</pre>"
    )


def _short(value: Any) -> str:
    text = str(value)
    return text if len(text) <= 160 else f"{text[:157]}..."


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    cells = ["".join(f"<th>{escape(each)}</th>" for each in head)]
    cells += ["".join(f"<td>{escape(str(each))}</td>" for each in row) for row in rows]
    return f"<table>{''.join(f'<tr>{line}</tr>' for line in cells)}</table>"


def _chart(figure: go.Figure) -> str:
    """A chart as HTML that draws with the page's own library."""
    figure.update_layout(template="simple_white", margin={"t": 50, "b": 40}, font={"size": 13})
    if figure.layout.height is None:
        figure.update_layout(height=420)
    return to_html(figure, full_html=False, include_plotlyjs=False, config={"displaylogo": False})
