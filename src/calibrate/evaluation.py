"""How far a forward map made from an emulator is from reference solutions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from emulator.error.comparison import Errors, case_errors
from emulator.errors import InputError, SolverError
from emulator.fem import Simulator, run_campaign, sobol
from emulator.fem.reference import Reference, fem_reference, outside_reference
from emulator.released.reference import published_reference
from emulator.surrogates import load
from emulator.surrogates.additive import Emulator
from emulator.surrogates.corrected import corrected
from emulator.surrogates.pod_gp import fit_reduced
from emulator.surrogates.protocol import Extrapolated, ForwardMap

FORWARDS = ("emulator", "corrected", "reduced")


@dataclass(frozen=True)
class Evaluation:
    """What to evaluate against what.

    emulator : shipped name or folder; its scene is the one evaluated.
    against : ``fem``, or a published model's folder.
    cases : FEM runs against ``fem``, inside the box and again outside.
    outside : how far beyond the box to look too, as a fraction of each side; ``None``: not at all.
    forward : one of :data:`FORWARDS`. steps : Newton steps of the corrected map.
    fem_runs : those the reduced model is fitted to.
    """

    emulator: str
    against: str = "fem"
    cases: int = 50
    outside: float | None = None
    forward: str = "emulator"
    steps: int = 1
    fem_runs: int = 30

    def __post_init__(self) -> None:
        if self.forward not in FORWARDS:
            raise InputError(f"forward map '{self.forward}': use {', '.join(FORWARDS)}")
        if self.outside is not None and self.against != "fem":
            raise InputError("outside: nothing was released outside the box; use --against fem")
        if self.outside is not None and not 0.0 < self.outside < float("inf"):
            raise InputError(f"outside is {self.outside}; give a fraction above 0, e.g. 0.25")
        for name in ("steps", "fem_runs"):
            if getattr(self, name) < 1:
                raise InputError(f"{name} is {getattr(self, name)}; it must be 1 or more")


@dataclass(frozen=True, eq=False)
class Evaluated:
    """The map, its errors inside the box and, if asked for, outside, and the report as JSON."""

    forward: ForwardMap
    inside: Errors
    outside: Errors | None
    report: Mapping[str, Any]


def build(
    plan: Evaluation, emulator: Emulator, simulator: Simulator, *, progress: bool = False
) -> ForwardMap:
    """The forward map to evaluate, over all nodes and also outside the box."""
    scene = emulator.scene
    if plan.forward == "reduced":
        runs = run_campaign(simulator, sobol(scene, plan.fem_runs, 0), progress=progress)
        return Extrapolated(fit_reduced(scene, runs))
    base = Extrapolated(emulator.cache())
    return base if plan.forward == "emulator" else corrected(base, simulator, plan.steps)


def run_evaluation(plan: Evaluation, *, progress: bool = False) -> Evaluated:
    """Solve or read the references, and measure.

    Raises
    ------
    InputError
        No such emulator, or references for another scene.
    SolverError
        FEM fails inside the box.
    """
    emulator = load(plan.emulator)
    scene = emulator.scene
    simulator = Simulator(scene)  # one for all: it compiles once
    if plan.against == "fem":
        reference = fem_reference(simulator, plan.cases, progress=progress)
    else:
        reference = published_reference(scene, plan.against, progress=progress)
    forward = build(plan, emulator, simulator, progress=progress)
    inside = case_errors(forward, reference.thetas, reference.displacement)
    report = {
        **inside.report(),
        "reference": reference.source,
        "scene": scene.name,
        "emulator": plan.emulator,
        "forward": plan.forward,
        "training": dict(emulator.record),
    }
    if plan.forward == "corrected":
        report["steps"] = plan.steps
    if plan.forward == "reduced":
        report["fem_runs"] = plan.fem_runs
    outside = None
    if plan.outside is not None:
        beyond = outside_reference(
            simulator, plan.cases, plan.outside, reference, progress=progress
        )
        outside, report["outside"] = _outside(forward, beyond, plan.outside)
    return Evaluated(forward, inside, outside, report)


def _outside(
    forward: ForwardMap, beyond: Reference, fraction: float
) -> tuple[Errors | None, dict[str, Any]]:
    """Errors outside the box and their report; without errors where nothing is to compare."""
    found: dict[str, Any] = {"fraction": fraction, "failed": beyond.failed}
    solved = len(beyond.thetas)
    try:
        errors = case_errors(forward, beyond.thetas, beyond.displacement) if solved else None
    except SolverError:  # the map answers nowhere out there
        errors = None
    if errors is None:
        return None, {"cases": 0, "invalid": solved, **found}
    return errors, {**errors.report(), **found}


def save(evaluated: Evaluated, folder: str | Path) -> list[Path]:
    """Write evaluation.json and the figures to ``folder``; the files written."""
    from calibrate.figures.evaluation import draw
    from emulator.store import write_json

    path = Path(folder) / "evaluation.json"
    write_json(path, evaluated.report)
    return [path, *draw(evaluated, folder)]
