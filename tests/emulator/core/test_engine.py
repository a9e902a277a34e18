"""Many solves by any executor: the same results, in order, and what becomes of a worker's death."""

import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from multiprocessing import get_context
from operator import neg
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

import emulator as em
from emulator.core.engine import Engine, engine_of
from emulator.core.errors import InputError, SolverError
from emulator.core.store import write_netcdf
from emulator.fem.campaign import run_campaign
from emulator.fem.campaign.designs import sobol

SPAWN = get_context("spawn")
PROCESSES = "processes:2"


class Bare:
    """An executor with nothing but ``submit``, of futures with nothing but ``result``."""

    def __init__(self):
        self._pool = ThreadPoolExecutor(2)

    def submit(self, function, *arguments):
        """Return the future of one call."""
        future = self._pool.submit(function, *arguments)
        return type("BareFuture", (), {"result": lambda _: future.result()})()


def die_once(path):
    """Kill this process, if the file is there: once."""
    if os.path.exists(path):  # noqa: PTH110
        os.remove(path)  # noqa: PTH107
        os.kill(os.getpid(), signal.SIGKILL)
    return 1


@pytest.fixture(scope="module")
def beam():
    """A beam of 16 elements, and theta."""
    scene = em.scenes.once_clamped_beam(cells=(4, 1, 1), order=1)
    return scene, sobol(scene, 6, 0)


@pytest.mark.parametrize("executor", [Bare(), ThreadPoolExecutor(2), PROCESSES])
def test_a_campaign_is_the_same_by_every_engine(beam, executor):
    scene, thetas = beam
    runs = {
        where: run_campaign(em.Simulator(scene, executor=where), thetas, sensitivities=True)
        for where in (Bare(), executor)
    }
    by_threads, by_engine = runs.values()
    assert np.array_equal(by_threads.displacement, by_engine.displacement)
    assert np.array_equal(by_threads.sensitivities, by_engine.sensitivities)


def test_results_come_in_the_order_of_the_tasks_and_few_are_begun_early():
    taken = []

    def tasks():
        for k in range(9):
            taken.append(k)
            yield k

    results = Engine(ThreadPoolExecutor(2), 2).in_order(neg, tasks())
    assert [next(results), len(taken)] == [0, 1]  # the first one is alone
    assert [next(results), len(taken)] == [-1, 4]
    assert list(results) == [-2, -3, -4, -5, -6, -7, -8]


def slow(seconds):
    """When it began and ended, on the clock that all processes share."""
    began = time.time()
    time.sleep(seconds)
    return began, time.time()


def test_tasks_that_are_all_begun_at_once_keep_all_workers_busy():
    """Even where no worker has the function yet, and the first task is a long one."""
    with ProcessPoolExecutor(2, mp_context=SPAWN) as pool:
        tasks = iter([15.0, *[0.1] * 5])
        (_, first_ended), *others = Engine(pool, 2).in_order(slow, tasks, alone=0, ahead=6)
    assert min(began for began, _ in others) < first_ended


def test_objects_no_longer_go_with_tasks_once_enough_of_them_were_answered():
    """An executor may claim more workers than answer: threads are one worker."""

    carried = list[bool]()

    class Counting(Bare):
        def submit(self, function, *arguments):
            carried.append(bool(arguments[2]))
            return super().submit(function, *arguments)

    assert list(Engine(Counting(), 2).in_order(neg, iter(range(60)))) == [-k for k in range(60)]
    assert all(carried[:8])
    assert not any(carried[30:])


def test_what_is_pending_may_be_left_by_futures_without_cancel():
    results = Engine(Bare(), 2).in_order(neg, iter(range(9)))
    assert [next(results), next(results)] == [0, -1]
    results.close()


def test_an_object_that_a_worker_cannot_build_is_an_error_and_no_endless_question():
    with pytest.raises(KeyError, match="no such thing"):
        list(Engine(ThreadPoolExecutor(1), 1).in_order(Unbuilt(), iter([0])))


class Unbuilt:
    """A function that is refused where it is unpickled."""

    def __reduce__(self):
        return _refuse_key, ()


def _refuse_key():
    raise KeyError("no such thing")


def test_tasks_of_a_worker_that_is_killed_are_done_again_and_named(tmp_path, capsys):
    mark = tmp_path / "mark"
    mark.touch()
    engine = engine_of(PROCESSES)
    assert list(engine.in_order(die_once, iter([str(mark)] * 4))) == [1, 1, 1, 1]
    assert "a worker died; done again: run 1" in capsys.readouterr().err


PROGRAM = """
import os
from emulator.core.engine import engine_of

def place(_):
    return os.getpid()

if __name__ == "__main__":
    for number in engine_of("processes:2").in_order(place, iter([0, 1])):
        print(number, flush=True)
    input()
"""


def _lives(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    status = Path(f"/proc/{pid}/stat")
    return not status.exists() or status.read_text().split(")")[-1].split()[0] != "Z"


@pytest.mark.parametrize("end", [signal.SIGTERM, signal.SIGKILL])
def test_workers_end_with_the_process_that_began_them(tmp_path, end):
    (tmp_path / "program.py").write_text(PROGRAM)
    words = [sys.executable, str(tmp_path / "program.py")]
    with subprocess.Popen(
        words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as program:
        workers = [int(program.stdout.readline()) for _ in range(2)]
        assert all(map(_lives, workers))
        program.send_signal(end)
        program.wait(timeout=10)
        limit = time.monotonic() + 10.0
        while any(map(_lives, workers)) and time.monotonic() < limit:
            time.sleep(0.05)
        assert not any(map(_lives, workers))


def test_a_task_that_kills_every_worker_is_named():
    with pytest.raises(SolverError, match="3 workers died with run 2: out of memory"):
        list(engine_of(PROCESSES).in_order(_fatal, iter([0, 1])))


def _fatal(number):
    if number:
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def test_a_dead_worker_of_an_executor_that_cannot_be_replaced_is_named(tmp_path):
    mark = tmp_path / "mark"
    mark.touch()
    pool = ProcessPoolExecutor(1, mp_context=SPAWN)
    with pytest.raises(SolverError, match="died with run 1, and its executor cannot be replaced"):
        list(engine_of(pool).in_order(die_once, iter([str(mark)])))


def test_an_error_of_a_task_is_raised_as_it_is():
    with pytest.raises(InputError, match="not a number"):
        list(Engine(ThreadPoolExecutor(1), 1).in_order(_refuse, iter([0])))


def _refuse(number):
    raise InputError(f"{number} is not a number")


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        ("process:2", "engine 'process:2': give threads, processes:N or dask:ADDRESS"),
        ("processes:0", "engine 'processes:0'"),
        ("dask:", "engine 'dask:'"),
        (3, "executor is a int; it has no submit"),
    ],
)
def test_what_is_no_engine_is_refused(words, complaint):
    with pytest.raises(InputError, match=complaint):
        engine_of(words)


def test_a_cluster_of_dask_gives_the_same(beam, tmp_path):
    distributed = pytest.importorskip("distributed")
    scene, thetas = beam
    with (
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as made,
        distributed.Client(made) as client,
    ):
        by_dask = run_campaign(em.Simulator(scene, executor=client.get_executor()), thetas)
        # xarray would ask for a lock that this cluster does not know.
        made = xr.Dataset({"x": ("n", np.arange(3.0))})
        client.submit(write_netcdf, tmp_path / "x.nc", made).result()
    assert xr.load_dataset(tmp_path / "x.nc", engine="h5netcdf").identical(made)
    by_threads = run_campaign(em.Simulator(scene, executor=Bare()), thetas)
    assert np.array_equal(by_dask.displacement, by_threads.displacement)


@pytest.mark.slow
def test_workers_of_executorlib_give_the_same(beam):
    executorlib = pytest.importorskip("executorlib")
    scene, thetas = beam
    with executorlib.SingleNodeExecutor(max_workers=2, block_allocation=True) as pool:
        by_workers = run_campaign(em.Simulator(scene, executor=pool), thetas)
    by_threads = run_campaign(em.Simulator(scene, executor=Bare()), thetas)
    assert np.array_equal(by_workers.displacement, by_threads.displacement)


def test_functions_inside_functions_go_to_a_worker():
    shift = 3

    def shifted(number):
        return number + shift

    engine = engine_of(PROCESSES)
    assert engine is not None
    assert list(engine.in_order(shifted, iter(range(4)))) == [3, 4, 5, 6]
