"""Hard cases for the simulator: each must converge or name its failure, never answer wrongly.

Run from anywhere: ``python -m studies.stability``. Writes results.json and stability.png beside
itself and asserts what the README of the study says.
"""

import argparse
import multiprocessing
import queue
import threading
import time
from collections import Counter
from collections.abc import Iterable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
from studies.common.output import save
from studies.stability.cases import CASES, SEED, Case, solve
from studies.stability.judge import TOLERANCE, is_stable, judge

from calibrate.figures.drawing import pyplot
from calibrate.provenance import study_header
from emulator import Status
from emulator.errors import InputError
from emulator.store import write_json

HERE = Path(__file__).parent
LIMIT = 120.0  # seconds for one case, compilation and judgement included


def outcome(name: str) -> dict[str, Any]:
    """Solve one case and judge its answer."""
    family, make = CASES[name]
    row: dict[str, Any] = {
        "name": name,
        "family": family,
        "status": "",
        "silent_wrong": False,
        "residual": None,
        "time_s": 0.0,
        "iterations": None,
        "load_reached": None,
        "stable": None,
        "note": "",
    }
    case = make()
    begin = time.perf_counter()
    try:
        simulator, solution = solve(case)
    except Exception as error:  # whatever it is, it is the outcome
        named = isinstance(error, InputError)
        status = type(error).__name__
        text = str(error).splitlines()[0][:160]
        return row | {
            "status": status if named else f"exception {status}",
            "time_s": time.perf_counter() - begin,
            "note": text,
        }
    row["time_s"] = time.perf_counter() - begin
    row |= {
        "status": Status(int(solution.status)).name,
        "iterations": int(solution.iterations),
        "load_reached": float(solution.load_reached),
    }
    return row | verdict(case, simulator, solution)


def verdict(case: Case, simulator: Any, solution: Any) -> dict[str, Any]:
    """Judge an answer by what its status claims."""
    u = np.asarray(solution.displacement)
    if not np.isfinite(u).all():
        return {"silent_wrong": True, "note": "displacement not finite"}
    if solution.status != Status.CONVERGED:
        return {}
    claim = case.claim(u)
    try:
        found = judge(case.scene, u, np.asarray(case.theta), claim)
        stable = is_stable(simulator, solution.displacement, np.asarray(case.theta))
    except Exception as error:  # an answer to a question that makes no sense
        return {"silent_wrong": True, "note": claim or f"cannot be judged: {error}"}
    return {
        "silent_wrong": bool(found.wrong),
        "residual": found.residual,
        "independent": found.independent,
        "smallest_J": found.smallest_J,
        "stable": stable,
        "note": found.wrong,
    }


# ---- workers -----------------------------------------------------------------------------------
def work(pipe: Connection) -> None:
    """Receive names of cases and send their outcomes, until ``None`` is received."""
    while (name := pipe.recv()) is not None:
        pipe.send(outcome(name))


class Worker:
    """A process that is killed when a case hangs; the next case gets a new one."""

    def __init__(self) -> None:
        self.process: Any = None

    def start(self) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, other = context.Pipe()
        self.process = context.Process(target=work, args=(other,), daemon=True)
        self.process.start()
        other.close()

    def stop(self) -> None:
        if self.process is not None:
            self.process.kill()
            self.process.join()
            self.process = None

    def run(self, name: str, limit: float) -> dict[str, Any]:
        """The outcome of ``name``; its status is ``hang`` or ``crash`` where there is none."""
        if self.process is None:
            self.start()
        begin = time.perf_counter()
        self.pipe.send(name)
        try:
            if self.pipe.poll(limit):
                return self.pipe.recv()
            status = "hang"
        except EOFError:
            status = "crash"
        self.stop()
        lost = dict.fromkeys(("residual", "iterations", "load_reached", "stable"))
        return lost | {
            "name": name,
            "family": CASES[name][0],
            "status": status,
            "silent_wrong": False,
            "time_s": time.perf_counter() - begin,
            "note": "",
        }


def study(names: Iterable[str], workers: int, limit: float) -> list[dict[str, Any]]:
    """Every case, in the order of ``names``."""
    names = list(names)
    waiting: queue.SimpleQueue[str] = queue.SimpleQueue()
    for name in names:
        waiting.put(name)
    rows: dict[str, dict[str, Any]] = {}

    def drain() -> None:
        worker = Worker()
        while True:
            try:
                name = waiting.get_nowait()
            except queue.Empty:
                return worker.stop()
            row = rows[name] = worker.run(name, limit)
            print(
                f"{len(rows):3d}/{len(names)} {name:44s} {row['status']:18s} "
                f"{row['time_s']:6.1f} s  {row['iterations'] or '':>4} {row['note'][:70]}",
                flush=True,
            )

    threads = [threading.Thread(target=drain) for _ in range(workers)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return [rows[name] for name in names]


# ---- figure and claims ---------------------------------------------------------------------------
COLOURS = {
    "CONVERGED": "tab:green",
    "ITERATION_LIMIT": "tab:orange",
    "LOAD_LIMIT": "tab:blue",
    "INVERTED_ELEMENT": "tab:purple",
    "SINGULAR_TANGENT": "tab:brown",
    "INVALID_INPUT": "0.5",
    "InputError": "0.2",
}


def draw(rows: list[dict[str, Any]], path: Path) -> None:
    """How the cases of each family ended, and the residual of those that converged."""
    plt = pyplot()
    families = list(dict.fromkeys(row["family"] for row in rows))[::-1]
    figure, (left, right) = plt.subplots(
        1, 2, figsize=(12, 0.5 * len(families) + 2.2), sharey=True, layout="constrained"
    )
    lengths = np.zeros(len(families))
    for status in [*COLOURS, *sorted({row["status"] for row in rows} - set(COLOURS))]:
        counts = np.array(
            [sum((r["family"], r["status"]) == (f, status) for r in rows) for f in families]
        )
        if counts.any():
            colour = COLOURS.get(status, "tab:red")
            left.barh(families, counts, left=lengths, color=colour, label=status)
            lengths += counts
    left.set(xlabel="cases")
    figure.legend(frameon=False, fontsize=9, loc="outside upper center", ncols=7)
    for height, family in enumerate(families):
        found = [r for r in rows if r["family"] == family and r["residual"] is not None]
        spread = np.linspace(-0.3, 0.3, max(len(found), 2))
        for row, shift in zip(found, spread, strict=False):
            colour = "tab:red" if row["silent_wrong"] else "tab:green"
            mark = "x" if row["stable"] is False else "o"
            # A residual of exactly zero is drawn at round-off.
            right.plot(max(row["residual"], 1e-17), height + shift, mark, color=colour, ms=4)
    right.axvline(TOLERANCE, color="tab:red", lw=1)
    right.set(xscale="log", xlabel="residual, judged independently (x: a saddle, not a minimum)")
    right.grid(alpha=0.25)
    save(figure, path)


NAMED = {status.name for status in Status} | {InputError.__name__}


def check(rows: list[dict[str, Any]]) -> None:
    """The claims of the study's README."""
    by_name = {row["name"]: row for row in rows}
    wrong = [row["name"] for row in rows if row["silent_wrong"]]
    assert not wrong, f"silent wrong answers: {wrong}"
    unnamed = {row["name"]: row["status"] for row in rows if row["status"] not in NAMED}
    assert not unnamed, f"hangs or exceptions: {unnamed}"
    for row in rows:
        if row["family"] == "corners of the boxes":
            assert row["status"] == "CONVERGED", row["name"]
    if (flattened := by_name.get("pushed_through_itself")) is not None:
        assert flattened["status"] == "INVERTED_ELEMENT"


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Counts of the table in the README."""
    converged = [row for row in rows if row["status"] == "CONVERGED"]
    return {
        "cases": len(rows),
        "statuses": dict(Counter(row["status"] for row in rows)),
        "silent_wrong": sum(row["silent_wrong"] for row in rows),
        "saddles": [row["name"] for row in converged if row["stable"] is False],
        "largest_residual": max((row["residual"] or 0.0 for row in converged), default=0.0),
        "longest_s": max(row["time_s"] for row in rows),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", nargs="*", help="names, or beginnings of names; all by default")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--limit", type=float, default=LIMIT, help="seconds a case")
    parser.add_argument("--out", type=Path, default=HERE)
    arguments = parser.parse_args()
    chosen = tuple(arguments.cases or [""])
    names = [name for name in CASES if name.startswith(chosen)]
    rows = study(names, arguments.workers, arguments.limit)
    header = study_header(HERE, SEED)
    found = summary(rows)
    write_json(arguments.out / "results.json", {**header, "summary": found, "cases": rows})
    draw(rows, arguments.out / "stability.png")
    print(found)
    check(rows)


if __name__ == "__main__":
    main()
