"""Errors of a forward map against reference solutions inside its box."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from emulator.accuracy.comparison import Errors, case_errors
from emulator.core.errors import InputError
from emulator.fem import Simulator
from emulator.fem.campaign.designs import fem_reference
from emulator.surrogates import load
from emulator.surrogates.protocol import ForwardMap, Ingredients
from emulator.surrogates.registry import build_forward, full_options
from emulator.verify.released import published_reference

OUR_FEM = "fem"
"""What to evaluate against, unless it is the folder of a released model."""
_CASES = 50


@dataclass(frozen=True, eq=False)
class Evaluated:
    """The map, its errors inside the box, and the report as JSON."""

    forward: ForwardMap
    errors: Errors
    report: Mapping[str, Any]


def run_evaluation(
    emulator: str,
    *,
    against: str = OUR_FEM,
    cases: int | None = None,
    forward: str = "emulator",
    forward_options: Mapping[str, int] = {},
    progress: bool = False,
) -> Evaluated:
    """Solve or read the reference solutions, and compare the forward map with them.

    Parameters
    ----------
    emulator : shipped name or folder; its scene is the one evaluated.
    against : ``fem``, or the folder of a published model's data.
    cases : FEM runs against ``fem``; 50 by default.
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
    trained = load(emulator)
    scene, count = trained.scene, _CASES if cases is None else cases
    simulator = Simulator(scene)  # shared by references and forward map: it compiles once
    if against == OUR_FEM:
        reference = fem_reference(simulator, count, progress=progress)
    else:
        reference = published_reference(scene, against, progress=progress)
    made_of = Ingredients(scene, simulator, emulator, seed=0, progress=progress)
    map_ = build_forward(forward, made_of, forward_options)
    errors = case_errors(map_, reference.thetas, reference.displacement)
    report = {
        **errors.report(),
        "reference": reference.source,
        "scene": scene.name,
        "emulator": emulator,
        "forward": forward,
        "forward_options": options,
        "label": map_.label,
        "training": dict(trained.record),
    }
    return Evaluated(map_, errors, report)
