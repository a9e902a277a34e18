"""The page of a population: FEM's verdict on each member, medians and spreads, and the members.

A certificate belongs to a member, so the page repeats the members' verdicts and solves nothing.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from urllib.parse import quote

import numpy as np
import xarray as xr
from markupsafe import Markup

from calibrate.figures.shrinkage import figure_of, label_of
from calibrate.population import Hierarchy
from calibrate.population.model import MEDIAN, SD
from calibrate.population.posterior import CORRELATION
from calibrate.posterior import read_tree
from calibrate.posterior.diagnosis import misfits
from calibrate.project.calibration import NOT_CERTIFIED
from calibrate.project.members import Members, Shared, failures_in, verdicts_in
from calibrate.project.results import MEMBERS, POPULATION, POSTERIOR, REPORT
from calibrate.report import charts, parts
from calibrate.report.parts import Verdict

_FORM = ".4g"
_OMITTED = ("members", "alone")  # attributes that the page leaves out


def html_of(plan: Members, population: Hierarchy, folder: Path, page_folder: Path) -> str:
    """Return the page of a population as HTML.

    Parameters
    ----------
    plan : the runs of the members.
    population : the posterior of the population.
    folder : the population's folder, where its members' certificates, posteriors and pages are.
    page_folder : the folder that the page is written to, from which links start.
    """
    verdicts = dict.fromkeys(population.members, NOT_CERTIFIED) | verdicts_in(plan, folder)
    table, warnings, member = population.summary(), population.warnings(), population.new_member()
    labels = {name: label_of(population, name) for name in member}
    rows = [
        (label, *parts.summary_cells(table[name])) for name, label in _labels(population).items()
    ]
    before_the_cut = parts.note(
        "Of the population before it is cut to the parameters' ranges. A spread is an sd; of a "
        "logarithm it is about a relative sd. Few members tell little of it: it is then what its "
        "prior says."
    )
    of_member = [(labels[name], parts.median_and_range(v, _FORM)) for name, v in member.items()]
    new_member = [
        parts.table(("", "median and 90 %"), of_member),
        parts.note(
            "What is not known of the population widens it. In Python, the hierarchy's "
            "predict(model) gives the data of such a member, and as_prior() the prior of the next."
        ),
        *([parts.chart(charts.pairs(labels, member))] if len(member) > 1 else []),
    ]
    sections = [
        ("The population", [parts.table(("", *parts.SUMMARY), rows), before_the_cut]),
        ("Members beside the population", _members(population, folder, page_folder, verdicts)),
        *([("Groups", _groups(plan, population))] if plan.groups else []),
        ("A member not seen", new_member),
        ("How sampling went", _sampling(population, table, warnings)),
        ("Where this comes from, and how to repeat it", _provenance(plan, population)),
    ]
    heading = f"Population of {len(population.members)} members"
    title = f"{heading}: {', '.join(population.shared)}"
    verdict = _verdict(verdicts, warnings)
    failed = [f"left out: {name}, {why}" for name, why in failures_in(folder).items()]
    verdict = verdict._replace(findings=[*verdict.findings, *failed])
    return parts.render(title, heading, verdict, sections)


def _verdict(verdicts: Mapping[str, str], warnings: Sequence[str]) -> Verdict:
    """Return how many members FEM agrees with, the other members, and the run's warnings."""
    colours = [parts.colour_of(verdict) for verdict in verdicts.values()]
    worst = max(colours, key=(parts.GOOD, parts.UNSURE, parts.BAD).index)
    distinct = list(dict.fromkeys(verdicts.values()))
    text = f"{colours.count(parts.GOOD)} of {len(verdicts)} members accepted"
    if len(distinct) == 1:
        text = f"all members: {distinct[0]}"
    findings = [
        f"{verdict}: {', '.join(name for name, answer in verdicts.items() if answer == verdict)}"
        for verdict in distinct
        if parts.colour_of(verdict) != parts.GOOD
    ]
    if NOT_CERTIFIED in verdicts.values():
        findings.append(f"for a certificate: calibrate certify on {MEMBERS}/NAME in this folder")
    basis = "A certificate is of a member by itself, not of the population."
    return Verdict(text, worst, findings, basis, warnings)


def _groups(plan: Members, population: Hierarchy) -> list[Markup]:
    """Return the median over each group's members of every parameter, with its 90 %."""
    draws, rows = population.draws(), []
    for group in dict.fromkeys(plan.groups.values()):
        members = [name for name in population.members if plan.groups.get(name) == group]
        if members:
            values = [
                np.median([draws[f"{name}[{member}]"] for member in members], axis=0)
                for name in population.shared
            ]
            row = (parts.median_and_range(v, _FORM) for v in values)
            rows.append((group, str(len(members)), *row))
    labels = [label_of(population, name) for name in population.shared]
    note = "The median of a group's members, as the whole population has them; 90 % of its draws."
    return [parts.note(note), parts.table(("", "members", *labels), rows)]


def _labels(population: Hierarchy) -> dict[str, str]:
    """Return the labels of the population's numbers, by name in :meth:`Hierarchy.draws`."""
    medians, spreads, correlations = {}, {}, {}
    for k, name in enumerate(population.shared):
        label = label_of(population, name)
        log = population.tree["posterior"][name].attrs.get("scale") == "log"
        medians[f"{MEDIAN}[{name}]"] = f"median of {label}"
        spreads[f"{SD}[{name}]"] = f"spread of {f'ln {name}' if log else label}"
        for earlier in population.shared[:k]:
            correlations[f"{CORRELATION}[{earlier}, {name}]"] = f"correlation of {earlier}, {name}"
    return medians | spreads | correlations


def _members(
    population: Hierarchy, folder: Path, page_folder: Path, verdicts: Mapping[str, str]
) -> list[Markup]:
    """Return the chart of the members, its numbers, each member's checks and its misfits."""
    draws = population.draws()
    numbers, checks, misfit_sentences = [], [], []
    for member in population.members:
        member_folder = folder / MEMBERS / member
        tree = (
            read_tree(member_folder / POSTERIOR)
            if (member_folder / POSTERIOR).exists()
            else xr.DataTree()
        )
        values = [draws[f"{name}[{member}]"] for name in population.shared]
        numbers.append((member, *(parts.median_and_range(v, _FORM) for v in values)))
        checks.append(
            (member, verdicts[member], _share(tree), _page(member_folder / REPORT, page_folder))
        )
        misfit_sentences += [f"{member}: {sentence}" for sentence in misfits(tree)]
    labels = [label_of(population, name) for name in population.shared]
    return [
        parts.picture(figure_of(population)),
        parts.note("Medians and 90 % of each member with the others, the picture's blue:"),
        parts.table(("", *labels), numbers),
        parts.note(
            "Each member by itself, the picture's grey: FEM's verdict, and how much of its data "
            "lies within 90 % of what its posterior predicts, noise included. For a page: "
            f"calibrate report on {MEMBERS}/NAME in this folder, then on the folder again."
        ),
        parts.table(("", "FEM says", "data within 90 %", "page"), checks),
        *(parts.paragraph(sentence, "warning") for sentence in misfit_sentences),
    ]


def _share(tree: xr.DataTree) -> str:
    """Return the share of a member's data within 90 % of its posterior's predictions."""
    if "posterior_predictive" not in tree.children:
        return "not kept"
    observed = tree["observed_data"].to_dataset()
    replicates = tree["posterior_predictive"].to_dataset()
    inside = np.concatenate(
        [
            charts.inside(
                replicates[name].values.reshape(-1, measured.size), measured.values.ravel()
            )
            for name, measured in observed.data_vars.items()
        ]
    )
    return f"{100.0 * inside.mean():.0f} % of {len(inside)}"


def _page(path: Path, page_folder: Path) -> str:
    """Return a link to a member's page from ``page_folder``, or an empty text."""
    if not path.is_file():
        return ""
    relative = Path(os.path.relpath(path.resolve(), page_folder.resolve())).as_posix()
    return Markup('<a href="{}">open</a>').format(quote(relative))


def _sampling(
    population: Hierarchy, table: Mapping[str, Mapping[str, float]], warnings: Sequence[str]
) -> list[Markup]:
    """Return draws, the worst R-hat and the fewest effective draws in words, and traces."""
    labels = _labels(population)
    sizes, statistics = population.tree["posterior"].sizes, population.tree["sample_stats"]
    worst = max(table, key=lambda name: np.nan_to_num(table[name]["r_hat"], nan=np.inf))
    fewest = {key: min(row[key] for row in table.values()) for key in ("ess_bulk", "ess_tail")}
    diverging = int(statistics["diverging"].sum()) if "diverging" in statistics else 0
    text = (
        f"{sizes['chain']} chains of {sizes['draw']} draws, {diverging or 'no'} divergent "
        f"transitions. R-hat is at most {table[worst]['r_hat']:.4f}, of "
        f"{labels.get(worst, worst)}; effective draws are {fewest['ess_bulk']:.0f} or more in the "
        f"bulk, {fewest['ess_tail']:.0f} or more in the tails, of population and members alike. "
    )
    text += "Warnings are at the top." if warnings else "Nothing is wrong with the run."
    return [parts.paragraph(text), parts.chart(charts.traces(labels, population.draws(), {}))]


def _provenance(plan: Members, population: Hierarchy) -> list[Markup]:
    """Return attributes, each member's scene and data, and settings as in an experiment file."""
    runs = {name: parts.changed_settings(run) for name, run in plan.members.items()}
    first = next(iter(runs.values()))
    common = {k: v for k, v in first.items() if all(run.get(k) == v for run in runs.values())}
    member_settings = {
        name: {k: v for k, v in run.items() if k not in common} for name, run in runs.items()
    }
    defaults, population_settings = asdict(Shared()), asdict(plan.population)
    shared = {k: v for k, v in population_settings.items() if v != defaults[k]}
    program = (
        "from calibrate.project.members import infer_members, read_members\n\n"
        'members, _ = read_members("THIS FOLDER")\n'
        'infer_members(members, "ANOTHER FOLDER")  # the same draws'
    )
    settings = common | {MEMBERS: member_settings, POPULATION: shared}
    return [
        parts.attributes(population.tree.attrs, _OMITTED),
        *parts.how_to_repeat(settings, "The runs of the members and what these share", program),
    ]
