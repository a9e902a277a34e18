"""Errors of a forward map against reference solutions, inside its box and outside."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from emulator.accuracy.comparison import Errors, case_errors
from emulator.core.errors import InputError, SolverError
from emulator.fem import Simulator
from emulator.fem.campaign.designs import Reference, fem_reference, outside_reference
from emulator.surrogates import load
from emulator.surrogates.protocol import ForwardMap, Ingredients
from emulator.surrogates.registry import build_forward, full_options
from emulator.verify.released import published_reference

OUR_FEM = "fem"
"""What to evaluate against, unless it is the folder of a released model."""
_CASES = 50


@dataclass(frozen=True, eq=False)
class Evaluated:
    """The map, its errors inside the box and, if asked for, outside, and the report as JSON."""

    forward: ForwardMap
    inside: Errors
    outside: Errors | None
    report: Mapping[str, Any]


def run_evaluation(
    emulator: str,
    *,
    against: str = OUR_FEM,
    cases: int | None = None,
    outside: float | None = None,
    forward: str = "emulator",
    forward_options: Mapping[str, int] = {},
    progress: bool = False,
) -> Evaluated:
    """Solve or read the reference solutions, and compare the forward map with them.

    Parameters
    ----------
    emulator : shipped name or folder; its scene is the one evaluated.
    against : ``fem``, or the folder of a published model's data.
    cases : FEM runs against ``fem``, inside the box and again outside; 50 by default.
    outside : fraction of each side by which the box is widened for the cases outside; ``None``
        for no such cases.
    forward, forward_options : a name of :data:`emulator.surrogates.registry.FORWARD_MAPS`, and its
        options by name, e.g. ``{"steps": 2}``.

    Raises
    ------
    InputError
        The emulator is missing or damaged, or the references are for another scene.
    SolverError
        FEM fails inside the box.
    """
    options = full_options(forward, forward_options)
    if cases is not None and against != OUR_FEM:
        raise InputError("cases: every released one is compared; use --against fem for others")
    if outside is not None and against != OUR_FEM:
        raise InputError("outside: nothing was released outside the box; use --against fem")
    if outside is not None and not 0.0 < outside < float("inf"):
        raise InputError(f"outside is {outside}; give a fraction above 0, e.g. 0.25")
    trained = load(emulator)
    scene, count = trained.scene, _CASES if cases is None else cases
    simulator = Simulator(scene)  # shared by references and forward map: it compiles once
    if against == OUR_FEM:
        reference = fem_reference(simulator, count, progress=progress)
    else:
        reference = published_reference(scene, against, progress=progress)
    made_of = Ingredients(scene, simulator, emulator, seed=0, extrapolate=True, progress=progress)
    map_ = build_forward(forward, made_of, forward_options)
    inside = case_errors(map_, reference.thetas, reference.displacement)
    report = {
        **inside.report(),
        "reference": reference.source,
        "scene": scene.name,
        "emulator": emulator,
        "forward": forward,
        "forward_options": options,
        "label": map_.label,
        "training": dict(trained.record),
    }
    if outside is None:
        return Evaluated(map_, inside, None, report)
    beyond = outside_reference(simulator, count, outside, reference, progress=progress)
    errors, report["outside"] = _outside(map_, beyond, outside)
    return Evaluated(map_, inside, errors, report)


def _outside(
    forward: ForwardMap, beyond: Reference, fraction: float
) -> tuple[Errors | None, dict[str, Any]]:
    """Return errors outside the box and their report; no errors without a valid prediction."""
    report: dict[str, Any] = {"fraction": fraction, "failed": beyond.failed}
    case_count = len(beyond.thetas)
    try:
        errors = case_errors(forward, beyond.thetas, beyond.displacement) if case_count else None
    except SolverError:  # the map has no valid prediction at any of them
        errors = None
    if errors is None:
        return None, {"cases": 0, "invalid": case_count, **report}
    return errors, {**errors.report(), **report}
