"""The page: verdict first, then data, parameters, body, what is known, and how to repeat it."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict
from datetime import datetime
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
import numpyro.distributions as dist
import plotly.graph_objects as go
from plotly.io import to_html
from plotly.offline import get_plotlyjs

from calibrate.certificate.evidence import LARGEST_LOG_SD, LARGEST_MESH_SHIFT, LARGEST_SHIFT
from calibrate.certificate.verdict import shifts
from calibrate.identifiability.combinations import identify, in_words
from calibrate.posterior import Posterior
from calibrate.posterior.posterior import describe_distribution
from calibrate.report import charts
from calibrate.report.body import body_figure
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
    page = html_of(run, posterior, certificate, fem=fem, made=_day(path))
    target = folder / REPORT if out is None else Path(out)
    with replacing(target) as temporary:
        temporary.write_text(page, encoding="utf-8")
    return target


def html_of(
    run: Run,
    posterior: Posterior,
    certificate: dict[str, Any] | None,
    *,
    fem: bool = True,
    made: str = "",
) -> str:
    """The page as text; ``made``: the day of the certificate."""
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
        f"<h1>{escape(scene.name)}</h1>{_verdict(run, posterior, certificate, made)}{body}"
        "</body></html>"
    )


def _verdict(run: Run, posterior: Posterior, certificate: dict[str, Any] | None, made: str) -> str:
    """The certificate's verdict and findings, by what it judged, and what is wrong with the run."""
    judged = f"Data: {run.data}."
    if certificate is None:
        decided = "fem_solves" in posterior.tree.attrs
        verdict = "decided by FEM" if decided else "not certified"
        findings = [] if decided else ["no certificate yet: run calibrate certify on this folder"]
    else:
        verdict, findings = certificate["verdict"], certificate["findings"]
        judged = " ".join([*_judged(certificate), judged, made])
    items = "".join(f"<li>{escape(each)}</li>" for each in findings)
    warnings = "".join(f'<p class="warning">{escape(each)}</p>' for each in posterior.warnings())
    colour = _COLOURS.get(verdict, _NOT)
    return (
        f'<div class="verdict" style="background:{colour}"><b>{escape(verdict)}</b>'
        f"<ul>{items}</ul><small>{escape(judged)}</small></div>{warnings}"
    )


def _judged(certificate: dict[str, Any]) -> Iterator[str]:
    """What a verdict rests on, and what it was held against."""
    finer = (certificate.get("mesh") or {}).get("runs", 0)
    runs = f"Judged by {certificate['draws']} FEM runs, {certificate['failed']} failed"
    yield f"{runs}, and {finer} on a finer mesh." if finer else f"{runs}."
    k, most = certificate["k_hat"], certificate["k_threshold"]
    if k is not None and most is not None:
        yield f"Pareto k {k:.2f}, at most {most:.2f}."
    yield (
        f"Limits: {LARGEST_SHIFT:g} sd for a mean, {LARGEST_MESH_SHIFT:g} on a finer mesh, "
        f"{100.0 * math.expm1(LARGEST_LOG_SD):.0f} % for an sd."
    )


def _day(path: Path) -> str:
    """When a file was written; nothing where there is none."""
    if not path.is_file():
        return ""
    return f"{datetime.fromtimestamp(path.stat().st_mtime).date()}."


def _data(posterior: Posterior) -> str:
    found = [_chart(figure) for _, figure in charts.against_data(posterior)]
    return "".join(found) or '<p class="note">The run kept no predictions.</p>'


def _parameters(run: Run, posterior: Posterior, certificate: dict[str, Any] | None) -> str:
    labels, cut = charts.names_with_units(posterior), posterior.model.prior_cut
    head = ["", "mean", "sd", "5 %", "95 %", "R-hat", "ESS bulk", "ESS tail", "prior"]
    truth = run.truth if run.data == "synthetic" else {}
    priors = posterior.model.sampled_priors
    head += ["truth"] if truth else []
    moved = shifts(certificate or {})
    head += [_MOVED[what] for what in moved]
    rows = []
    for name, row in posterior.summary().items():
        numbers = [f"{row[key]:.4g}" for key in ("mean", "sd", "low", "high")]
        numbers += [f"{row['r_hat']:.4f}", f"{row['ess_bulk']:.0f}", f"{row['ess_tail']:.0f}"]
        numbers.append(_in_words(priors[name]) if name in priors else "")
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
    found += _chart(curve) if curve is not None else ""
    return found + _ejection(charts.state_volumes(posterior))


def _ejection(volumes: Mapping[str, np.ndarray]) -> str:
    """Volumes by load state, and what of the largest the smallest leaves out; nothing of none."""
    if not volumes:
        return ""
    rows = [(state, _median(values)) for state, values in volumes.items()]
    medians = {state: float(np.median(values)) for state, values in volumes.items()}
    full, empty = (pick(medians, key=medians.__getitem__) for pick in (max, min))
    ejected = 100.0 * (1.0 - volumes[empty] / volumes[full])
    return (
        f"{_table(('load state', 'cavity volume (mL), median and 90 %'), rows)}"
        f"<p>Ejection fraction from {escape(full)} to {escape(empty)}: {_median(ejected)} %.</p>"
    )


def _median(values: np.ndarray) -> str:
    low, middle, high = np.quantile(values, [0.05, 0.5, 0.95])
    return f"{middle:.1f} ({low:.1f} to {high:.1f})"


def _draws(posterior: Posterior) -> str:
    found = _chart(charts.traces(posterior))
    return found + (_chart(charts.pairs(posterior)) if len(posterior.model.names) > 1 else "")


def _provenance(run: Run, posterior: Posterior) -> str:
    attributes = {str(k): v for k, v in posterior.tree.attrs.items() if k not in ("run", "observe")}
    rows = [(key, told) for key, value in attributes.items() if (told := _told(value))]
    again = (
        "from calibrate.workflow import infer, read_posterior\n\n"
        'run, _ = read_posterior("THIS FOLDER")\n'
        'infer(run, "ANOTHER FOLDER")  # the same draws'
    )
    usual = asdict(Run(run.scene))
    chosen = {k: v for k, v in asdict(run).items() if k == "scene" or v != usual[k]}
    settings = escape(json.dumps(chosen, indent=2))
    return (
        f"{_table(('', ''), rows)}<p>The run, where it is not as usual (all of it is in "
        f"<code>run.json</code>):</p><pre>{settings}</pre>"
        f"<p>To repeat it:</p><pre>{escape(again)}</pre>"
    )


def _in_words(prior: dist.Distribution) -> str:
    """A prior as its distribution's name and its range."""
    if not isinstance(prior, dist.LogUniform | dist.Uniform):
        return describe_distribution(prior)
    log = "log-" if isinstance(prior, dist.LogUniform) else ""
    return f"{log}uniform, {float(prior.low):g} to {float(prior.high):g}"


def _told(value: Any) -> str:
    """An attribute in words; nothing where it says nothing."""
    if isinstance(value, str) and value[:1] in ("{", "[", "n"):
        with suppress(ValueError):
            value = json.loads(value)
    if isinstance(value, float) and not math.isfinite(value):
        return ""
    if isinstance(value, Mapping):
        parts = {str(k): told for k, v in value.items() if (told := _told(v))}
        return "; ".join(f"{name}: {told}" if name else told for name, told in parts.items())
    if isinstance(value, list):
        return ", ".join(map(_told, value))
    return "" if value is None else str(value)


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
