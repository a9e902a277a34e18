"""The page of a posterior: verdict, data, parameters, body, known combinations, settings."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from time import perf_counter
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
from markupsafe import Markup

from calibrate.analysis.identifiability import identify, in_words
from calibrate.analysis.terms import HeldOut, find_terms
from calibrate.certificate.evidence import LARGEST_LOG_SD, LARGEST_MESH_SHIFT, LARGEST_SHIFT
from calibrate.certificate.mesh import WHERE, finer_of
from calibrate.certificate.verdict import NO_TAIL, shifts
from calibrate.posterior import Posterior
from calibrate.priors.population import in_words as priors_in_words
from calibrate.priors.priors import Truncated
from calibrate.project import Run, holds_population, read_posterior, simulator_of
from calibrate.project.calibration import SECONDS
from calibrate.project.members import read_members
from calibrate.project.results import CERTIFICATE, REPORT
from calibrate.project.stated_priors import stated_priors
from calibrate.provenance import describe_distribution
from calibrate.report import charts, parts, population
from calibrate.report.body import body_figure
from calibrate.report.parts import Verdict
from emulator.core.errors import InputError
from emulator.core.store import read_json, replacing
from emulator.scenes.scene import Scene
from emulator.specimens.specimen import Specimen
from emulator.surrogates import CachedEmulator

_CALLS = 50  # of a likelihood, timed together
_SHEET = 0.1  # thickness of a sheet, as a share of its width
_SHIFTS = {"FEM": "by FEM / sd"} | {of: f"{where} / sd" for of, where in WHERE.items()}


def write_page(folder: str | Path, out: str | Path | None, *, fem: bool) -> Path:
    """Write the page; see :func:`calibrate.report.write_report`."""
    folder = Path(folder)
    target = folder / REPORT if out is None else Path(out)
    if holds_population(folder):
        page = population.html_of(*read_members(folder), folder, target.parent)
    else:
        run, posterior = read_posterior(folder)
        path = folder / CERTIFICATE
        certificate, day = None, ""
        if path.is_file():
            certificate = read_json(path)
            day = f"{datetime.fromtimestamp(path.stat().st_mtime).date()}."
        page = html_of(run, posterior, certificate, fem=fem, certificate_day=day)
    with replacing(target) as temporary:
        temporary.write_text(page, encoding="utf-8")
    return target


def html_of(
    run: Run,
    posterior: Posterior,
    certificate: dict[str, Any] | None,
    *,
    fem: bool = True,
    certificate_day: str = "",
) -> str:
    """Return the page of a posterior as HTML; ``certificate_day`` is the day of the certificate."""
    scene = posterior.model.forward.scene
    simulator = simulator_of(scene, run.load_steps) if fem else None
    data: list[Markup] = [parts.chart(figure) for _, figure in charts.against_data(posterior)]
    labels = charts.names_with_units(posterior)
    in_chains = {name: np.asarray(posterior.tree["posterior"][name]) for name in labels}
    draws = [charts.traces(labels, in_chains, _priors(posterior))]
    draws += [charts.pairs(labels, posterior.draws())] if len(labels) > 1 else []
    body: list[tuple[str, list[Markup]]] = []
    if isinstance(scene, Scene):
        of_body = parts.note(
            "Drag to turn. The slider goes through draws of the posterior, and the mean shape of "
            "each load state; the menu changes the colour; fibres and the mesh are in the legend."
        )
        body = [("The body", [of_body, parts.chart(body_figure(posterior, simulator))])]
    sections = [
        ("Data against prediction", data or [parts.note("The run kept no predictions.")]),
        ("Parameters", _parameters(run, posterior, certificate, labels)),
        *body,
        ("What the data determine", [*_known(posterior), *_sheet(posterior), *_terms(posterior)]),
        ("Draws", [parts.chart(figure) for figure in draws]),
        ("The map from parameters to data", [parts.paragraph(text) for text in _costs(posterior)]),
        ("Where this comes from, and how to repeat it", _provenance(run, posterior)),
    ]
    title = f"{scene.name}: posterior of {', '.join(posterior.model.names)}"
    return parts.render(
        title, scene.name, _verdict(run, posterior, certificate, certificate_day), sections
    )


def _verdict(
    run: Run, posterior: Posterior, certificate: dict[str, Any] | None, day: str
) -> Verdict:
    """Return the certificate's verdict, findings and basis, with the run's warnings."""
    basis = f"Data: {run.data}."
    findings: Sequence[str] = ()
    if certificate is not None:
        text, findings = certificate["verdict"], certificate["findings"]
        basis = " ".join([*_basis(certificate), basis, day])
    else:
        text = "not certified"
        findings = ["no certificate yet: run calibrate certify on this folder"]
    return Verdict(text, parts.colour_of(text), findings, basis, posterior.warnings())


def _basis(certificate: dict[str, Any]) -> Iterator[str]:
    """Yield sentences on the evidence behind a verdict, and on its limits."""
    mesh = certificate.get("mesh") or {}
    where = WHERE[finer_of(mesh)]
    runs = f"Judged by {certificate['draws']} FEM runs, {certificate['failed']} failed"
    yield f"{runs}, and {mesh['runs']} {where}." if mesh.get("runs") else f"{runs}."
    k, most = certificate["k_hat"], certificate["k_threshold"]
    has_tail = certificate.get("tail", {}).get("largest", math.inf) >= NO_TAIL
    if has_tail and k is not None and most is not None:
        yield f"Pareto k {k:.2f}, at most {most:.2f}."
    yield (
        f"Limits: {LARGEST_SHIFT:g} sd for a mean, {LARGEST_MESH_SHIFT:g} {where}, "
        f"{100.0 * math.expm1(LARGEST_LOG_SD):.0f} % for an sd."
    )


def _priors(posterior: Posterior) -> dict[str, dist.Distribution]:
    """Return the prior of all that is inferred, in nobody's coordinates."""
    return {**posterior.model.prior, **posterior.model.noise_priors}


def _parameters(
    run: Run, posterior: Posterior, certificate: dict[str, Any] | None, labels: Mapping[str, str]
) -> list[Markup]:
    truth = run.truth if run.data == "synthetic" else {}
    priors = _priors(posterior)
    shifts_by_judge = shifts(certificate or {})
    head = ["", *parts.SUMMARY, "prior", *(["truth"] if truth else [])]
    head += [_SHIFTS[judge] for judge in shifts_by_judge]
    rows = []
    for name, row in posterior.summary().items():
        cells = parts.summary_cells(row)
        cells.append(_in_words(priors[name]) if name in priors else "")
        cells += [f"{truth[name]:.4g}" if name in truth else ""] if truth else []
        cells += [f"{s[name]:+.2f}" if name in s else "" for s in shifts_by_judge.values()]
        rows.append((labels[name], *cells))
    notes = [
        parts.note(
            f"{name}: {100 * share:.2g} % of the prior lies where the map has no answer and was "
            "left out."
        )
        for name, share in posterior.model.prior_cut.items()
        if share
    ]
    notes += map(parts.note, priors_in_words(stated_priors(run, posterior.model)))
    return [parts.table(head, rows), *notes]


def _known(posterior: Posterior) -> list[Markup]:
    blocks: list[Markup] = [parts.paragraph(in_words(identify(posterior)), "lines")]
    if posterior.model.forward.scene.outside:  # whose law is not known
        return blocks
    blocks.append(parts.chart(charts.stress(posterior)))
    if (curve := charts.volume_band(posterior)) is not None:
        blocks.append(parts.chart(curve))
    if volumes := charts.state_volumes(posterior):
        rows = [(state, parts.median_and_range(values)) for state, values in volumes.items()]
        medians = {state: float(np.median(values)) for state, values in volumes.items()}
        full, empty = (pick(medians, key=medians.__getitem__) for pick in (max, min))
        ejected = parts.median_and_range(100.0 * (1.0 - volumes[empty] / volumes[full]))
        text = (
            f"The cavity is smaller in {empty} than in {full} by {ejected} %: the ejection "
            "fraction, if the heart beats in between."
        )
        head = ("load state", "cavity volume (mL), median and 90 %")
        blocks += [parts.table(head, rows), parts.paragraph(text)]
    return blocks


def _sheet(posterior: Posterior) -> list[Markup]:
    """Return the product of moduli and assumed thickness that forces on a sheet determine."""
    model, scene = posterior.model, posterior.model.forward.scene
    forces = any(part.unit == "N" for part in model.observe.parts.values())
    if not forces or not isinstance(scene, Scene):
        return []
    thickness, width, _ = np.sort(np.ptp(scene.mesh.nodes, axis=0))
    if thickness > _SHEET * width:
        return []
    draws, moduli = posterior.draws(), (*scene.law.shape_moduli, "prestress")
    names = [name for name in moduli if name in draws]
    rows = [
        (name, parts.median_and_range(thickness * np.ravel(draws[name]), ".3g")) for name in names
    ]
    text = (
        f"The body is a sheet, {thickness:.3g} mm thick. Forces on a sheet are in proportion to "
        "moduli times thickness, so moduli err as the thickness does. Of the product they tell:"
    )
    head = ("modulus", "times the thickness (N/m), median and 90 %")
    return [parts.paragraph(text), parts.table(head, rows)] if names else []


def _terms(posterior: Posterior) -> list[Markup]:
    """Return the terms that a specimen's law needs, where its data are linear in the moduli."""
    if not isinstance(posterior.model.forward.scene, Specimen):
        return []
    try:
        terms = find_terms(posterior.model, posterior.data)
    except InputError:
        return []
    head = ("term", "probability", "modulus where it is there (kPa)")
    rows = [
        (name, f"{probability:.3f}", "{:.3g} +- {:.2g}".format(*terms.moduli[name]))
        if name in terms.moduli
        else (name, f"{probability:.3f}", "not seen")
        for name, probability in sorted(terms.probabilities.items(), key=lambda item: -item[1])
    ]
    text = "Which terms of the law do the data show? All sets of up to five, by their evidence."
    if terms.undecided:
        text += f" The data do not tell of {', '.join(terms.undecided)}."
    blocks = [parts.paragraph(text), parts.table(head, rows)]
    if terms.held_out:
        text = f"Each test left out in turn: {terms.held_out_in_words()}."
        tests = parts.table(HeldOut.head, (test.cells for test in terms.held_out))
        blocks += [parts.paragraph(text), tests]
    return blocks


def _costs(posterior: Posterior) -> Iterator[str]:
    """Yield sentences on what the forward map is, and what it cost once and costs for each theta.

    Times are measured where the page is written, after compilation.
    """
    model = posterior.model
    seconds = json.loads(posterior.tree.attrs.get(SECONDS, "{}"))
    stages = "".join(f"; {stage}: {spent:.1f} s" for stage, spent in seconds.items())
    yield f"Forward map: {model.full.label}{stages}."
    if not isinstance(model.full, CachedEmulator):
        return
    begin = perf_counter()
    model.full.emulator.cache()
    once = perf_counter() - begin
    density = jax.value_and_grad(model.map_log_likelihood)
    draw = {name: jnp.asarray(values[0]) for name, values in posterior.draws().items()}
    program = jax.jit(density).lower(draw, posterior.data).compile()
    jax.block_until_ready(program(draw, posterior.data))
    begin = perf_counter()
    for _ in range(_CALLS):
        jax.block_until_ready(program(draw, posterior.data))
    each_call = (perf_counter() - begin) / _CALLS
    what = "a graph network's processor" if model.full.label == "graph network" else "all modes"
    yield (
        f"What depends on the geometry alone, {what}, is computed once, in {once:.2g} s. A log "
        f"likelihood with its gradient then takes {1e3 * each_call:.2g} ms."
    )


def _provenance(run: Run, posterior: Posterior) -> list[Markup]:
    program = (
        "from calibrate.project import infer, read_posterior\n\n"
        'run, _ = read_posterior("THIS FOLDER")\n'
        'infer(run, "ANOTHER FOLDER")  # the same draws'
    )
    return [
        parts.attributes(posterior.tree.attrs, ("run", "observe")),
        *parts.how_to_repeat(parts.changed_settings(run), "The run", program),
    ]


def _in_words(prior: dist.Distribution) -> str:
    """Return a prior as its distribution's name and its range."""
    whole = prior.base_dist if isinstance(prior, Truncated) else prior
    if isinstance(whole, dist.LogNormal):
        return f"log-normal, median {np.exp(whole.loc):.4g}, log sd {float(whole.scale):.2g}"
    if not isinstance(prior, dist.LogUniform | dist.Uniform):
        return describe_distribution(prior)
    log = "log-" if isinstance(prior, dist.LogUniform) else ""
    return f"{log}uniform, {float(prior.low):g} to {float(prior.high):g}"
