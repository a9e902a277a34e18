"""The page: verdict first, then data, parameters, body, what is known, and how to repeat it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from datetime import datetime
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
import numpyro.distributions as dist

from calibrate.analysis.identifiability import identify, in_words
from calibrate.certificate.verdict import LARGEST_LOG_SD, LARGEST_MESH_SHIFT, LARGEST_SHIFT, shifts
from calibrate.posterior import Posterior
from calibrate.posterior.posterior import describe_distribution
from calibrate.project import Run, holds_population, read_posterior, simulator_of
from calibrate.project.cohort import read_cohort
from calibrate.project.workflow import CERTIFICATE, REPORT
from calibrate.report import charts, parts, population
from calibrate.report.body import body_figure
from emulator.core.store import read_json, replacing

_MOVED = {"FEM": "by FEM / sd", "mesh": "on a finer mesh / sd"}


def write_report(folder: str | Path, out: str | Path | None = None, *, fem: bool = True) -> Path:
    """Write one HTML file about a posterior, or a population, ``folder/report.html`` by default.

    Parameters
    ----------
    folder : of :func:`calibrate.project.infer`, or of a population
        (:func:`calibrate.project.cohort.infer_cohort`).
    fem : solve once at the posterior's mean, to show the map's error on the body; nothing is solved
        for a population.

    Raises
    ------
    InputError
        ``folder`` holds neither, or a posterior of another run or map.
    """
    folder = Path(folder)
    target = folder / REPORT if out is None else Path(out)
    if holds_population(folder):
        page = population.html_of(*read_cohort(folder), folder, target.parent)
    else:
        page = _page_of_posterior(folder, fem=fem)
    with replacing(target) as temporary:
        temporary.write_text(page, encoding="utf-8")
    return target


def _page_of_posterior(folder: Path, *, fem: bool) -> str:
    run, posterior = read_posterior(folder)
    path = folder / CERTIFICATE
    certificate = read_json(path) if path.is_file() else None
    return html_of(run, posterior, certificate, fem=fem, made=_day(path))


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
    title = f"{scene.name}: posterior of {', '.join(posterior.model.names)}"
    return parts.frame(title, scene.name, _verdict(run, posterior, certificate, made), sections)


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
    return parts.verdict_box(
        verdict, parts.colour_of(verdict), findings, judged, posterior.warnings()
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
    found = [parts.chart(figure) for _, figure in charts.against_data(posterior)]
    return "".join(found) or parts.note("The run kept no predictions.")


def _parameters(run: Run, posterior: Posterior, certificate: dict[str, Any] | None) -> str:
    labels, cut = charts.names_with_units(posterior), posterior.model.prior_cut
    head = ["", *parts.SUMMARY, "prior"]
    truth = run.truth if run.data == "synthetic" else {}
    priors = posterior.model.sampled_priors
    head += ["truth"] if truth else []
    moved = shifts(certificate or {})
    head += [_MOVED[what] for what in moved]
    rows = []
    for name, row in posterior.summary().items():
        numbers = parts.summary_cells(row)
        numbers.append(_in_words(priors[name]) if name in priors else "")
        numbers += [f"{truth[name]:.4g}" if name in truth else ""] if truth else []
        numbers += [f"{shift[name]:+.2f}" if name in shift else "" for shift in moved.values()]
        rows.append((labels[name], *numbers))
    lost = "".join(
        parts.note(
            f"{n}: {100 * share:.2g} % of the prior lies where the map has no answer and was left "
            "out."
        )
        for n, share in cut.items() if share
    )  # fmt: skip
    return parts.table(head, rows) + lost


def _body(posterior: Posterior, simulator: Any) -> str:
    note = parts.note(
        "Drag to turn. The slider goes through draws of the posterior; the menu changes the "
        "colour; fibres and the body at rest are in the legend."
    )
    return note + parts.chart(body_figure(posterior, simulator))


def _known(posterior: Posterior) -> str:
    words = escape(in_words(identify(posterior))).replace("\n", "<br>")
    found = f"<p>{words}</p>{parts.chart(charts.stress(posterior))}"
    curve = charts.volume_band(posterior)
    found += parts.chart(curve) if curve is not None else ""
    return found + _ejection(charts.state_volumes(posterior))


def _ejection(volumes: Mapping[str, np.ndarray]) -> str:
    """Volumes by load state, and what of the largest the smallest leaves out; nothing of none."""
    if not volumes:
        return ""
    rows = [(state, parts.median_and_range(values)) for state, values in volumes.items()]
    medians = {state: float(np.median(values)) for state, values in volumes.items()}
    full, empty = (pick(medians, key=medians.__getitem__) for pick in (max, min))
    ejected = 100.0 * (1.0 - volumes[empty] / volumes[full])
    return (
        f"{parts.table(('load state', 'cavity volume (mL), median and 90 %'), rows)}"
        f"<p>Ejection fraction from {escape(full)} to {escape(empty)}: "
        f"{parts.median_and_range(ejected)} %.</p>"
    )


def _draws(posterior: Posterior) -> str:
    found = parts.chart(charts.traces(posterior))
    return found + (parts.chart(charts.pairs(posterior)) if len(posterior.model.names) > 1 else "")


def _provenance(run: Run, posterior: Posterior) -> str:
    again = (
        "from calibrate.project import infer, read_posterior\n\n"
        'run, _ = read_posterior("THIS FOLDER")\n'
        'infer(run, "ANOTHER FOLDER")  # the same draws'
    )
    return parts.attributes(posterior.tree.attrs, ("run", "observe")) + parts.how_to_repeat(
        parts.not_as_usual(run), "The run", again
    )


def _in_words(prior: dist.Distribution) -> str:
    """A prior as its distribution's name and its range."""
    if not isinstance(prior, dist.LogUniform | dist.Uniform):
        return describe_distribution(prior)
    log = "log-" if isinstance(prior, dist.LogUniform) else ""
    return f"{log}uniform, {float(prior.low):g} to {float(prior.high):g}"
