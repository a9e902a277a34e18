"""FEM at many theta: the one loop over solves.

A design of theta (:mod:`.designs`) becomes tasks, each with displacements to start from
(:mod:`.campaign`). Threads solve several at once (:mod:`.workers`); rows are kept in memory or in a
Zarr store (:mod:`.store`), which is imported only by those who need it.
"""

from emulator.fem.campaign.campaign import (
    Field,
    Neighbours,
    Predictor,
    Runs,
    StoredRuns,
    run_campaign,
    solve_rows,
    solve_together,
)
from emulator.fem.campaign.workers import Row, Solver, Task, at_once, in_order, many_solves

__all__ = [
    "Field",
    "Neighbours",
    "Predictor",
    "Row",
    "Runs",
    "Solver",
    "StoredRuns",
    "Task",
    "at_once",
    "in_order",
    "many_solves",
    "run_campaign",
    "solve_rows",
    "solve_together",
]
