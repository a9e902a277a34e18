"""A run's posterior as material cards of another program, with its body.

===================  ============================================================================
``mean``             the card of the mean of each parameter, with the program's suffix
``median``           of the median of each parameter
``draw_001``, ...    of draws at even distances in the posterior
``parameters.csv``   the parameters of every card, in our units
``README.md``        what differs between the program's law and ours, and how cards are used
``body``             mesh and fibres, where they are asked for
===================  ============================================================================
"""

from __future__ import annotations

import csv
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import jax
import jax.numpy as jnp
import numpy as np

from calibrate.posterior import Posterior
from calibrate.project.results import read_posterior
from emulator.core.errors import InputError, look_up
from emulator.core.store import check_folder
from emulator.mechanics.laws import Law
from emulator.neighbours.cards import PROGRAMS, ExportedBody, Program, form_of, write_card
from emulator.scenes.forward_problem import ForwardProblem
from emulator.scenes.scene import Scene, with_mesh

MEAN, MEDIAN, README, PARAMETERS = "mean", "median", "README.md", "parameters.csv"


@dataclass(frozen=True)
class Export:
    """A record of the files that were exported.

    program, law : the program's name and the law's.
    folder : the folder that was written.
    files : the names of its files.
    differs : sentences on what differs between the program's law and ours.
    """

    program: str
    law: str
    folder: str
    files: tuple[str, ...]
    differs: tuple[str, ...]


def export_posterior(
    run: str | Path, program: str, out: str | Path, *, draws: int = 20, mesh: bool = False
) -> Export:
    """Write the posterior in the folder ``run`` as cards of ``program`` into a new folder.

    Parameters
    ----------
    run : a folder that calibrate infer wrote, of one body.
    program : a name of :data:`emulator.neighbours.cards.PROGRAMS`.
    out : the folder to write, which must not exist.
    draws : the number of draws that get a card.
    mesh : whether the body and its fibres are written, too.

    Raises
    ------
    InputError
        An unknown program or one without the law, a run that does not exist or has no law, more
        draws than the posterior has, a folder that exists, regions of different stiffness,
        viscosity, or a mesh asked of a specimen.
    """
    target, out = look_up(PROGRAMS, program, "program"), Path(out)
    if out.exists():
        raise InputError(f"{out} exists; name a folder that does not")
    check_folder(out.parent)
    if draws < 0:
        raise InputError(f"{draws} draws; give 0 or more")
    posterior = read_posterior(run)[1]
    problem = posterior.model.forward.scene
    law = problem.law
    form_of(target, law)  # refuses before the longer work
    _refuse_regions(problem)
    if len(problem.tissue_parameters) > len(law.parameters):
        raise InputError(f"scene '{problem.name}' has viscosity; cards are of elastic laws")
    body = body_of(with_mesh(problem), _mean_theta(posterior)) if mesh else None
    table = _parameters(posterior, law)
    count = len(next(iter(table.values())))
    if draws > count:
        raise InputError(f"{draws} draws, but the posterior has {count}; give {count} or fewer")
    cards = dict(_cards(table, draws))
    notes = tuple(_notes(target, law, posterior, body))
    out.parent.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(dir=out.parent, prefix=f".{out.name}.") as name:
        new = Path(name) / out.name
        new.mkdir()
        for card, values in cards.items():
            text = write_card(target, law, values)
            (new / f"{card}{target.suffix}").write_text(text, encoding="utf-8")
        files = [f"{card}{target.suffix}" for card in cards]
        files += [] if body is None else target.write_body(new, body)
        _write_parameters(new / PARAMETERS, cards)
        text = _readme(target, law, str(run), files, notes)
        (new / README).write_text(text, encoding="utf-8")
        new.rename(out)
    written = (*files, PARAMETERS, README)
    return Export(target.name, law.name, str(out), written, notes)


def body_of(scene: Scene, theta: jax.Array) -> ExportedBody:
    """Return the body of a scene, with one direction for each element, at ``theta`` (p,)."""
    directions = scene.tissue_at(theta).directions
    if directions is None:
        return ExportedBody(scene.mesh)
    axes = np.asarray(directions)
    axes = axes if scene.law.sheets else axes[:, :, None]  # (m, q, 1 or 2, 3)
    # Directions are axes: opposite vectors at the points of one element do not cancel.
    signs = np.where(np.sum(axes * axes[:, :1], axis=-1, keepdims=True) < 0.0, -1.0, 1.0)
    means = np.mean(signs * axes, axis=1)
    fibres = means[:, 0] / np.linalg.norm(means[:, 0], axis=1, keepdims=True)
    if not scene.law.sheets:
        return ExportedBody(scene.mesh, fibres)
    sheets = means[:, 1] - np.sum(means[:, 1] * fibres, axis=1, keepdims=True) * fibres
    return ExportedBody(scene.mesh, fibres, sheets / np.linalg.norm(sheets, axis=1, keepdims=True))


def _refuse_regions(problem: ForwardProblem) -> None:
    """Raise :class:`InputError` for stiffness that differs from element to element."""
    for kind in ("regions", "stiffness_modes"):
        if getattr(problem, kind, None) is not None:
            raise InputError(
                f"scene '{problem.name}' has {kind.replace('_', ' ')}; cards are of one material"
            )


def _mean_theta(posterior: Posterior) -> jax.Array:
    """Return theta (p,) of the first load state at the mean of the draws."""
    means = {name: values.mean() for name, values in posterior.draws().items()}
    return posterior.model.states.thetas(means)[0]


def _parameters(posterior: Posterior, law: Law) -> dict[str, np.ndarray]:
    """Return each parameter (s,) of the law at all draws; refuse one that load states differ in."""
    problem = posterior.model.forward.scene
    thetas = jnp.moveaxis(posterior.model.states.thetas(posterior.draws()), -1, 0)  # (p, s, S)
    values, table = problem.resolve(thetas), {}
    for quantity in law.quantities:
        column = np.broadcast_to(np.asarray(values[quantity.name]), thetas.shape[1:])
        if (column != column[:, :1]).any():
            raise InputError(f"'{quantity.name}' differs between load states; cards have one value")
        table[quantity.name] = column[:, 0]
    return table


def _cards(table: Mapping[str, np.ndarray], draws: int) -> Iterator[tuple[str, dict[str, float]]]:
    """Yield the name and the parameters of every card."""
    for name, statistic in ((MEAN, np.mean), (MEDIAN, np.median)):
        yield name, {key: float(statistic(column)) for key, column in table.items()}
    count = len(next(iter(table.values())))
    for k, index in enumerate(np.linspace(0, count - 1, draws).round().astype(int), start=1):
        yield f"draw_{k:03d}", {key: float(column[index]) for key, column in table.items()}


def _notes(
    program: Program, law: Law, posterior: Posterior, body: ExportedBody | None
) -> Iterator[str]:
    """Yield a sentence on each thing in which the exported model differs from the calibrated."""
    form, problem = form_of(program, law), posterior.model.forward.scene
    if form.penalty:
        yield (
            f"Volume: {program.title} has {form.penalty}, with our bulk modulus at rest; stresses "
            "differ by a pressure of second order in J - 1."
        )
    yield from form.differs
    if getattr(posterior.model.full, "incompressible", False):
        yield "The data were taken as incompressible: the bulk modulus was not calibrated."
    if body is None:
        return
    dilatation = getattr(problem, "dilatation", "pointwise")
    if dilatation != "pointwise":
        yield (
            f"Elements: ours use the {dilatation} volume change; choose elements that do not lock."
        )
    if body.fibres is not None and body.mesh.order > 1:
        yield "Fibres: the mean direction of each element, ours vary within elements."
    if getattr(problem, "angles", ()):
        yield "Fibres: at the mean of the posterior; draws turn them."
    if getattr(problem, "loaded_by", None):
        yield "The mesh is a loaded shape; calibrate unload gives the one at rest."


def _write_parameters(path: Path, cards: Mapping[str, Mapping[str, float]]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["card", *next(iter(cards.values()))])
        writer.writerows([name, *values.values()] for name, values in cards.items())


def _readme(
    program: Program,
    law: Law,
    run: str,
    files: list[str],
    notes: tuple[str, ...],
) -> str:
    units = ", ".join(f"{q.name} {q.unit}".strip() for q in law.quantities)
    differs = "\n".join(f"- {note}" for note in notes) or "- Nothing: the energies are equal."
    return (
        f"# {program.title}: law '{law.name}'\n\n"
        f"Material cards of the posterior in `{run}`, in {program.units}.\n"
        f"`{PARAMETERS}` has the parameters of each card as calibrated ({units}).\n\n"
        f"## What differs\n\n{differs}\n\n"
        "The mean of the parameters does not give the mean of forces: run the draws for that.\n\n"
        f"## How to use them\n\n{program.usage}\n\n"
        f"Files: {', '.join(f'`{name}`' for name in files)}.\n"
    )
