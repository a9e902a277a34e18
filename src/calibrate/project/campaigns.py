"""FEM at every theta of a design, as a dataset with named dimensions."""

from __future__ import annotations

from concurrent.futures import Executor
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
import zarr

from calibrate.provenance import versions
from emulator.core.display import counting
from emulator.core.errors import InputError, look_up
from emulator.fem import NewtonOptions, Simulator
from emulator.fem.campaign import Neighbours, Solver, solve_rows
from emulator.fem.campaign.designs import DESIGNS
from emulator.fem.campaign.store import Campaign, ZarrRows, make_store, writing
from emulator.scenes.scene import Scene


def campaign(
    scene: Scene,
    samples: int | None = None,
    *,
    thetas: jax.Array | None = None,
    design: str = "sobol",
    seed: int = 0,
    slopes: bool = False,
    out: str | Path | None = None,
    options: NewtonOptions | None = None,
    executor: Executor | str | None = None,
    progress: bool = False,
) -> xr.Dataset:
    """Solve FEM at every theta of a design.

    A solve that fails is a row with that status and NaN. A campaign that was interrupted continues
    when it is called again in the same way.

    Parameters
    ----------
    scene : the scene that is solved.
    samples : the number of theta of the design.
    design : how theta are placed: ``sobol``, ``latin_hypercube``, or ``sobol_corners``, which adds
        the box's corners, as emulators are trained on.
    seed : the seed of the design.
    thetas : the theta (c, p), in place of a design.
    slopes : solve for du/dtheta, too.
    executor : what does the solves, as a :class:`~emulator.fem.simulator.Simulator`'s.
    out : the Zarr store to write; without it the dataset is in memory.

    Returns
    -------
    Dataset over ``theta_id``, ``parameter``, ``node`` and ``xyz``, as described in
    :mod:`emulator.fem.campaign.store`.

    Raises
    ------
    InputError
        No samples and no theta; a store of another campaign.
    """
    plan = question(
        scene,
        samples,
        thetas=thetas,
        design=design,
        seed=seed,
        slopes=slopes,
        options=options,
        executor=executor,
    )
    store = zarr.storage.MemoryStore() if out is None else out
    fill(plan, store, progress=progress)
    return xr.open_zarr(store, chunks=None)


def question(
    scene: Scene,
    samples: int | None = None,
    *,
    thetas: jax.Array | None = None,
    design: str = "sobol",
    seed: int = 0,
    slopes: bool = False,
    options: NewtonOptions | None = None,
    executor: Executor | str | None = None,
) -> Campaign:
    """Return the solves that :func:`campaign` makes."""
    if (samples is None) == (thetas is None):
        raise InputError("campaign: give a number of samples or thetas, one of them")
    design_record: dict[str, Any] = {"design": "given"}
    if thetas is None:
        assert samples is not None
        thetas = look_up(DESIGNS, design, "campaign: design")(scene, samples, seed)
        design_record = {"design": design, "seed": seed}
    points = np.asarray(thetas, dtype=float)
    if points.ndim != 2 or points.shape[1] != len(scene.parameters) or not len(points):
        raise InputError(
            f"campaign: thetas have shape {points.shape}; expected (count, "
            f"{len(scene.parameters)}) for {', '.join(scene.parameter_names)}"
        )
    has_energy = all(load.has_potential for load in scene.loads) and not scene.loaded_by
    simulator = Simulator(scene, NewtonOptions() if options is None else options, executor)
    solver = Solver(simulator, sensitivities=slopes, energy=has_energy)
    design_record = {**design_record, "samples": len(points)}
    return Campaign(solver, points, {"design": design_record, "versions": versions()})


def fill(plan: Campaign, store: Any, *, progress: bool = False) -> int:
    """Solve the missing rows of a store, at a path or in memory, and return their number."""
    in_memory = isinstance(store, zarr.storage.MemoryStore)
    opened = nullcontext(ZarrRows(make_store(store, plan))) if in_memory else writing(store, plan)
    with opened as rows:
        missing, total = rows.missing(), len(rows.thetas)
        solved = solve_rows(
            plan.solver,
            jnp.asarray(rows.thetas),
            numbers=missing,
            starts=Neighbours(plan.scene, rows.thetas, rows),
        )
        with counting(
            total=total, initial=total - len(missing), desc="FEM", disable=not progress, unit="run"
        ) as bar:
            for row in solved:
                rows.write(row)
                bar.update()
    return len(missing)
