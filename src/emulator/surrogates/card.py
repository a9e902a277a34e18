"""The model card of a shipped emulator: what it is, how it was trained, how wrong it is.

A card repeats what the emulator's file has. What a training did not record is ``None``, or empty.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib.metadata import metadata
from typing import Any, NamedTuple

from emulator.catalogue import scene_from_origin
from emulator.core.store import read_json
from emulator.surrogates.folders import SHIPPED, folder_of

PACKAGE = "soft-tissue-calibrate"


class ModelCard(NamedTuple):
    """A shipped emulator, as its file describes it.

    name, scene : the names of the emulator and of the built-in scene it was trained for.
    parts : the parts whose sum it is.
    recipe, seed, steps, sweeps : the plan of its training.
    fem_runs : the number of FEM runs that the training made.
    bodies : the number of bodies that a network of a family has seen.
    command, seconds, hardware, versions : how it is made again; how long that took, and where.
    theta : name, unit, range and scale of each parameter.
    errors : the recorded errors, each with its quantity, where it was taken, its statistic and its
        value: against FEM runs that were held out, or by Newton's step at theta that no training
        has seen. Errors of a polynomial that a network learned from are not the network's.
    licence : the licence of the package that ships it.
    weights_sha256 : the digest of the file of weights, which :func:`emulator.load` checks.
    """

    name: str
    scene: str
    parts: list[str]
    recipe: str | None
    seed: int | None
    steps: int | None
    sweeps: int | None
    fem_runs: int | None
    bodies: int | None
    command: str | None
    seconds: float | None
    hardware: dict[str, Any] | None
    versions: dict[str, str] | None
    theta: list[dict[str, Any]]
    errors: list[dict[str, Any]]
    licence: str | None
    weights_sha256: str


def model_card(name: str) -> ModelCard:
    """Return the card of the shipped emulator called ``name``.

    Raises
    ------
    InputError
        No emulator of that name is shipped, or the installed package lacks its weights.
    """
    folder_of(name)  # refuses other names
    description = read_json(SHIPPED / name / "emulator.json")
    record = description.get("record", {})
    plan = record.get("plan", {})
    return ModelCard(
        name=name,
        scene=description["scene"]["scene"],
        parts=list(description["parts"]),
        **{key: plan.get(key) for key in ("recipe", "seed", "steps", "sweeps")},
        fem_runs=_fem_runs(record),
        **{key: record.get(key) for key in ("bodies", "command", "seconds", "hardware")},
        versions=record.get("versions"),
        theta=_theta(description),
        errors=_errors(record),
        licence=metadata(PACKAGE)["License-Expression"],
        weights_sha256=description["weights_sha256"],
    )


def _fem_runs(record: Mapping[str, Any]) -> int | None:
    """Return the number of FEM runs; sweeps solve none unless their record names some."""
    if "sweeps" in record:
        return record["sweeps"].get("fem_solutions", 0)
    return record.get("fem_runs", record.get("discrepancy", {}).get("runs"))


def _theta(description: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the parameters and their ranges: a family's own, else those of the scene."""
    family = description["parts"].get("family")
    if family is not None:
        return family["parameters"]
    return [
        {"name": p.name, "unit": p.unit, "low": p.low, "high": p.high, "scale": p.scale}
        for p in scene_from_origin(description["scene"]).parameters
    ]


def _errors(record: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the recorded errors of the emulator itself."""
    errors = []
    fit = record.get("discrepancy") or {}
    if fit.get("on") in fit.get("held_out_err_u_mm", {}):
        usual = {"geometric mean": fit["held_out_err_u_mm"][fit["on"]]}
        errors += _entries("displacement, mm", "held-out FEM runs", usual)
    for quantity, values in fit.get("held_out", {}).items():
        errors += _entries(quantity, "held-out FEM runs", values)
    if "sweeps" in record and not record.get("plan", {}).get("steps"):  # no network follows
        sweeps = record["sweeps"]
        steps = {"median": sweeps["error_mm"], "max": sweeps["largest_error_mm"]}
        errors += _entries("Newton's step, mm", "unseen theta", steps)
    steps = record.get("equilibrium", {}).get("error_mm", {})
    return errors + _entries("Newton's step, mm", "unseen theta", steps)


def _entries(quantity: str, where: str, values: Mapping[str, float]) -> list[dict[str, Any]]:
    """Return an entry for each statistic among ``values``."""
    return [
        {"quantity": quantity, "where": where, "statistic": name, "value": values[name]}
        for name in ("geometric mean", "median", "max")
        if name in values
    ]
