"""FEM at many theta: the one loop over solves, in this process or on a Dask cluster.

A design of theta becomes tasks (:mod:`.row`), each with displacements to start from
(:mod:`.starts`). An executor solves them, several at once (:mod:`.threads`, :mod:`.engine`,
:mod:`.cluster`), and hands back rows as they are finished, which are kept in memory
(:mod:`.memory`) or in a Zarr store (:mod:`.zarr_rows`). Zarr and Dask are imported only by who asks
for them.
"""

from emulator.fem.campaign.engine import (
    Executor,
    Solver,
    in_process,
    solve_rows,
    solve_together,
)
from emulator.fem.campaign.place import executor
from emulator.fem.campaign.row import Row, Task
from emulator.fem.campaign.runs import Runs, StoredRuns, run_campaign
from emulator.fem.campaign.starts import Neighbours, Predictor
from emulator.fem.campaign.threads import at_once, in_order

__all__ = [
    "Executor",
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
