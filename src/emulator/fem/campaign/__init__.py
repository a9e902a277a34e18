"""FEM at many theta: the one loop over solves, in this process or on a Dask cluster.

A design of theta (:mod:`.designs`) becomes tasks, each with displacements to start from
(:mod:`.campaign`). An executor solves them, several at once (:mod:`.workers`, :mod:`.cluster`), and
returns rows as they are finished, which are kept in memory or in a Zarr store (:mod:`.store`). Zarr
and Dask are imported only with the modules that need them.
"""

from emulator.fem.campaign.campaign import (
    Field,
    Neighbours,
    Predictor,
    Runs,
    StoredRuns,
    executor,
    run_campaign,
    solve_rows,
    solve_together,
)
from emulator.fem.campaign.workers import Executor, Row, Solver, Task, at_once, in_order, in_process

__all__ = [
    "Executor",
    "Field",
    "Neighbours",
    "Predictor",
    "Row",
    "Runs",
    "Solver",
    "StoredRuns",
    "Task",
    "at_once",
    "executor",
    "in_order",
    "in_process",
    "run_campaign",
    "solve_rows",
    "solve_together",
]
