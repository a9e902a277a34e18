"""A prediction as plain JSON, as files, and as a picture of its bands."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import jax
import numpy as np
import xarray as xr

from calibrate.figures import BLUE, panels, save, with_unit
from calibrate.measurements.labels import datum_names
from calibrate.prediction.beyond import Beyond
from calibrate.prediction.predict import Predicted
from calibrate.state_names import in_state, split
from emulator.core.store import write_json, write_netcdf
from emulator.fem.fields import element_means
from emulator.geometry.io import write_vtu
from emulator.scenes.scene import Scene

_FIELD_DRAWS = 100  # draws of which a field's mean, sd and quantiles are taken
_STRESS_AND_STRAIN = ("cauchy_stress", "green_lagrange")
PREDICTION = "prediction.nc"


def numbers(predicted: Predicted) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the name of each predicted number, and its unit, mean, sd and quantiles."""
    for name, row in predicted.summary().items():
        shape = row["mean"].shape
        labels = datum_names(predicted.observe, name)
        for label, place in zip(labels, np.ndindex(shape), strict=True):
            yield label, {k: v if k == "unit" else float(v[place]) for k, v in row.items()}


def as_json(predicted: Predicted, beyond: Beyond, outer: Predicted) -> dict[str, Any]:
    """Return all but the draws as plain JSON.

    outer : the prediction with what laws miss beyond the data.
    """
    return {
        "scene": predicted.scene.name,
        "draws": len(predicted.thetas),
        "sources": dict(predicted.sources),
        "numbers": {
            name: row | {f"outer_{key}": further[key] for key in ("low", "high")}
            for (name, row), (_, further) in zip(numbers(predicted), numbers(outer), strict=True)
        },
        "fem_runs": predicted.runs,
        "failed": predicted.failed,
        "missed_sd": predicted.missed,
        "beyond": [asdict(one) for one in beyond.reaches],
        "distances": {state: np.asarray(d).tolist() for state, d in beyond.distances.items()},
        "warnings": predicted.warnings,
    }


def write(
    predicted: Predicted,
    beyond: Beyond,
    outer: Predicted,
    result: dict[str, Any],
    folder: Path,
) -> list[str]:
    """Write draws, numbers, bands and fields into ``folder``; return the files' names.

    outer : the prediction with what laws miss beyond the data.
    """
    folder.mkdir(parents=True, exist_ok=True)
    arrays = {
        name: xr.DataArray(
            values,
            dims=["draw", *(f"{name}_{k}" for k in range(values.ndim - 1))],
            attrs={"units": predicted.observe.parts[name].unit},
        )
        for name, values in predicted.values.items()
    }
    unknowns = {f"draw of {name}": ("draw", values) for name, values in predicted.draws.items()}
    write_netcdf(folder / PREDICTION, xr.Dataset(arrays | unknowns))
    write_json(folder / "prediction.json", result)
    bands(predicted, beyond, outer, folder / "bands.png")
    files = [PREDICTION, "prediction.json", "bands.png"]
    if isinstance(predicted.scene, Scene):
        files += [write_fields(predicted, k, folder) for k in range(predicted.thetas.shape[1])]
    return files


def write_fields(predicted: Predicted, state: int, folder: Path) -> str:
    """Write displacement, stress and strain of the body in a load state; return the file's name.

    Each as its mean over draws, and by component sd and quantiles of 5 and 95 %: displacement in mm
    at the nodes, Cauchy stress in kPa and Green-Lagrange strain as means over elements, nine
    components, row by row. Where the mesh is the loaded shape, stress and strain are left out.
    """
    scene = predicted.scene
    assert isinstance(scene, Scene), "a specimen has no mesh"
    name, thetas = predicted.observe.states[state], predicted.thetas[:_FIELD_DRAWS, state]
    u = jax.lax.map(predicted.forward, thetas)
    cells: dict[str, list[np.ndarray]] = {}
    if not scene.loaded_by:
        means = element_means(scene)
        rows = [means(*pair) for pair in zip(u, thetas, strict=True)]
        for kind in _STRESS_AND_STRAIN:
            values = np.stack([np.asarray(row[kind]) for row in rows])
            flat = values.reshape(len(values), len(scene.mesh.elements), -1)
            cells |= {key: [field] for key, field in _over_draws(kind, flat).items()}
    file = f"body_{name}.vtu" if name else "body.vtu"
    points = _over_draws("displacement", np.asarray(u))
    write_vtu(folder / file, scene.mesh, point_data=points, cell_data=cells)
    return file


def _over_draws(name: str, values: np.ndarray) -> dict[str, np.ndarray]:
    """Return mean, sd and quantiles of a field's draws (s, ...), by the names of arrays."""
    low, high = np.quantile(values, (0.05, 0.95), axis=0)
    sd = values.std(axis=0)
    return {name: values.mean(axis=0), f"{name}_sd": sd, f"{name}_low": low, f"{name}_high": high}


def bands(predicted: Predicted, beyond: Beyond, outer: Predicted, path: Path) -> None:
    """Draw band and median of each observation, over its load states or its numbers.

    The band with what laws miss beyond the data is hatched.
    """
    by_kind: dict[str, list[str]] = {}
    for name in predicted.values:
        by_kind.setdefault(split(name)[0], []).append(name)
    figure, grid = panels(len(by_kind), 2, (4.2, 3.0))
    inner, further = predicted.summary(), outer.summary()
    for axes, (kind, names) in zip(np.ravel(grid), by_kind.items(), strict=False):
        low, median, high, least, most = (
            np.concatenate([np.ravel(of[name][key]) for name in names])
            for of, key in (
                (inner, "low"), (inner, "median"), (inner, "high"),
                (further, "low"), (further, "high"),
            )
        )  # fmt: skip
        x = np.arange(len(median))
        if not np.array_equal(most, high):
            axes.fill_between(x, least, most, fc="none", hatch="///", ec=BLUE, lw=0.5, alpha=0.5)
        axes.fill_between(x, low, high, color=BLUE, alpha=0.25, lw=0)
        axes.plot(x, median, "o-", color=BLUE, ms=3, lw=1.2)
        if len(names) == len(median):
            ticks = [in_state("", split(name)[1]).lstrip("@") or kind for name in names]
            axes.set_xticks(x, ticks)
        else:
            axes.set_xlabel("number")
        axes.set_ylabel(with_unit(kind, predicted.observe.parts[names[0]].unit))
    title = f"{predicted.scene.name}: 90 % band of {len(predicted.thetas)} draws"
    if any(np.any(distance) for distance in beyond.distances.values()):
        title += "\nhatched: with what laws miss beyond the data"
    figure.suptitle(title)
    save(figure, path)
