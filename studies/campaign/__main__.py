"""FEM campaigns on a Dask cluster: two workers against one, and a worker killed on the way.

    python -m studies.campaign
    python -m studies.campaign --quick --out DIR    # a dozen theta, a coarse ventricle

Writes results.json and campaign.png, and asserts what the README of the study says.
"""

import contextlib
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from studies.common.output import Results, parser, save
from studies.common.processes import environment

import calibrate as cal
import emulator as em
from calibrate.figures import pyplot
from emulator.scenes import Scene

HERE = Path(__file__).parent
SEED = 4
REPEATS = 3  # pairs of one worker and two, one after the other, so that a busy moment hits both
TARGET = 1.6
_PORT_LINE = "Scheduler at:"
# Runs a module on one core; JAX's threads make it unsafe to do so between fork and exec.
_PINNED = (
    "import os, runpy, sys; os.sched_setaffinity(0, {int(sys.argv[1])}); del sys.argv[:2]; "
    "runpy.run_module(sys.argv[0], run_name='__main__', alter_sys=True)"
)


def main() -> None:
    words = parser(__doc__, HERE)
    arguments = words.parse_args()
    quick = arguments.quick
    scene = em.scenes.left_ventricle(*((4, 8, 1) if quick else ()), order=1)
    samples, repeats = (12, 1) if quick else (200, REPEATS)
    settings = {"samples": samples, "nodes": len(scene.mesh.nodes)}
    results = Results(arguments.out, SEED, again=arguments.again, settings=settings)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        compiled = folder / "compiled"
        for repeat in range(repeats):
            for workers in (1, 2):
                title = f"{workers} worker{'s' if workers > 1 else ''}, run {repeat + 1}"
                path = folder / f"{workers}-{repeat}.zarr"
                results.case(title, lambda n=workers, p=path: timed(scene, samples, n, p, compiled))
        path = folder / "killed.zarr"
        results.case("a worker killed", lambda: killed(scene, samples, path, compiled))
    found = summary(results.cases)
    results.write(summary=found)
    draw(results.cases, arguments.out / "campaign.png")
    print(found)
    assert found["complete"], "a campaign lacks rows"
    assert found["largest_difference_mm"] < 1e-7
    if not quick:
        assert found["times_as_fast"] >= TARGET, found


def timed(scene: Scene, samples: int, workers: int, path: Path, compiled: Path) -> dict[str, Any]:
    """A campaign on so many workers, each held to a core of its own."""
    with cluster(workers, compiled) as (address, _):
        # Imports and compilation; the workers keep compiled programs in a folder.
        cal.campaign(scene, 2 * workers, seed=SEED + 1, scheduler=address)
        began = time.perf_counter()
        cal.campaign(scene, samples, seed=SEED, out=path, scheduler=address)
        return {"workers": workers, "wall_s": time.perf_counter() - began, **content(path)}


def killed(scene: Scene, samples: int, path: Path, compiled: Path) -> dict[str, Any]:
    """A campaign on two workers, of which one is killed after a third of the rows."""
    with cluster(2, compiled) as (address, processes):
        told: dict[str, int] = {}

        def kill() -> None:
            while solved(path) < samples // 3:
                time.sleep(0.05)
            told["rows_at_kill"] = solved(path)
            processes[0].send_signal(signal.SIGKILL)

        thread = threading.Thread(target=kill, daemon=True)
        thread.start()
        began = time.perf_counter()
        cal.campaign(scene, samples, seed=SEED, out=path, scheduler=address)
        seconds = time.perf_counter() - began
        thread.join()
    alone = cal.campaign(scene, samples, seed=SEED)
    found = xr.open_zarr(path)
    gap = np.abs(found["displacement"] - alone["displacement"]).max()
    return {**told, "wall_s": seconds, **content(path), "largest_difference_mm": float(gap)}


def solved(path: Path) -> int:
    """Rows in a store that may not be there yet."""
    try:
        return int((xr.open_zarr(path, chunks=None)["status"].values != -1).sum())
    except FileNotFoundError:
        return 0


def content(path: Path) -> dict[str, Any]:
    """What a store holds, and the seconds each row took."""
    found = xr.open_zarr(path, chunks=None)
    return {
        "rows": int((found["status"].values != -1).sum()),
        "different_theta": len(set(found["hash"].values.tolist())),
        "converged": int((found["status"].values == 0).sum()),
        "iterations": int(found["iterations"].values.sum()),
        "row_s": [round(float(s), 4) for s in found["seconds"].values],
    }


@contextlib.contextmanager
def cluster(workers: int, compiled: Path) -> Iterator[tuple[str, list[subprocess.Popen[str]]]]:
    """A scheduler and workers in processes of their own, and the scheduler's address.

    Each worker may use one core only. BLAS and XLA then have one thread each.
    """
    variables = environment() | {
        "JAX_COMPILATION_CACHE_DIR": str(compiled),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    }
    cores = sorted(os.sched_getaffinity(0))

    def start(module: str, *words: str, core: int | None = None) -> subprocess.Popen[str]:
        run = ["-m", module] if core is None else ["-c", _PINNED, str(core), module]
        return subprocess.Popen(
            [sys.executable, *run, *words],
            env=variables,
            stderr=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            text=True,
        )

    with contextlib.ExitStack() as stack:
        scheduler = start(
            "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard"
        )
        stack.callback(stop, scheduler)
        address = address_of(scheduler)
        found = []
        for k in range(workers):
            one = ["--nthreads", "1", "--no-nanny", "--no-dashboard", "--memory-limit", "0"]
            found.append(
                start("distributed.cli.dask_worker", address, *one, core=cores[k % len(cores)])
            )
            stack.callback(stop, found[-1])
            drain(found[-1])
        wait_for(address, workers)
        yield address, found


def address_of(scheduler: subprocess.Popen[str]) -> str:
    assert scheduler.stderr is not None
    for line in scheduler.stderr:
        if _PORT_LINE in line:
            drain(scheduler)
            return line.split(_PORT_LINE)[1].strip()
    raise RuntimeError("the scheduler did not start")


def drain(process: subprocess.Popen[str]) -> None:
    """Read what a process says, so that its pipe never fills."""
    assert process.stderr is not None
    threading.Thread(target=process.stderr.read, daemon=True).start()


def wait_for(address: str, workers: int) -> None:
    from distributed import Client

    with Client(address, set_as_default=False) as client:
        client.wait_for_workers(workers, timeout=120)


def stop(process: subprocess.Popen[str]) -> None:
    process.kill()
    process.wait()


def summary(cases: list[dict[str, Any]]) -> dict[str, Any]:
    """Median ratio of the wall times of the pairs, and whether nothing was lost."""
    alone, both = ([case["wall_s"] for case in cases if case.get("workers") == n] for n in (1, 2))
    ratios = [a / b for a, b in zip(alone, both, strict=True)]
    last = cases[-1]
    return {
        "times_as_fast": float(np.median(ratios)),
        "ratios": ratios,
        "wall_s": {"1 worker": float(np.median(alone)), "2 workers": float(np.median(both))},
        "complete": all(
            case["rows"] == case["different_theta"] == len(case["row_s"]) for case in cases
        ),
        "largest_difference_mm": last["largest_difference_mm"],
        "wall_s_with_a_worker_killed": last["wall_s"],
    }


def draw(cases: list[dict[str, Any]], path: Path) -> None:
    """Left, wall time of each campaign; right, seconds of each row."""
    plt = pyplot()
    figure, (walls, rows) = plt.subplots(1, 2, figsize=(10, 3.6), layout="constrained")
    names = [case["name"] for case in cases]
    walls.barh(names, [case["wall_s"] for case in cases], color="tab:blue")
    walls.invert_yaxis()
    walls.set_xlabel("wall time of the campaign (s)")
    for case in cases:
        rows.plot(sorted(case["row_s"]), label=case["name"])
    rows.set(xlabel="rows, sorted", ylabel="seconds of a solve", yscale="log")
    rows.legend(fontsize=7)
    save(figure, path)


if __name__ == "__main__":
    main()
