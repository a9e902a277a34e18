"""Several solves at once."""

import threading
import time

import numpy as np
import pytest

from emulator.fem import Simulator
from emulator.fem.campaign import at_once, in_order, run_campaign, workers
from emulator.fem.campaign.designs import sobol


def test_results_come_in_the_order_of_the_tasks_whichever_thread_is_quicker():
    def slow_first(number: int) -> int:
        time.sleep(0.02 if number % 2 else 0.001)
        return number * number

    assert list(in_order(slow_first, iter(range(12)), 3)) == [n * n for n in range(12)]


def test_the_first_task_is_done_alone_and_the_others_at_once():
    together = threading.Barrier(2, timeout=10.0)
    where = []

    def meet(number: int) -> None:
        where.append(threading.current_thread() is threading.main_thread())
        if number:
            together.wait()  # two threads must be here, or it breaks

    list(in_order(meet, iter(range(5)), 2))
    assert where == [True, False, False, False, False]


def test_a_task_is_taken_when_those_long_before_it_are_given_back():
    given: list[int] = []
    known = []

    def tasks():
        for number in range(10):
            known.append(len(given))
            yield number

    for number in in_order(lambda n: n, tasks(), 2):
        given.append(number)
    # Of numbers alone: no clock, no thread.
    assert known == [0, 1, 1, 1, 2, 3, 4, 5, 6, 7]


def test_an_error_of_a_task_reaches_the_caller_and_later_tasks_are_not_begun():
    begun = []

    def fails(number: int) -> int:
        begun.append(number)
        if number == 2:
            raise ValueError("two")
        return number

    with pytest.raises(ValueError, match="two"):
        list(in_order(fails, iter(range(100)), 2))
    assert max(begun) <= 5


def test_whoever_stops_asking_stops_the_work():
    begun = []
    rows = in_order(lambda n: begun.append(n), iter(range(100)), 2)
    next(rows)
    next(rows)
    rows.close()
    assert max(begun) <= 4


def test_no_more_at_once_than_cores_and_memory(simulator, monkeypatch):
    nodes = len(simulator.scene.mesh.nodes)
    monkeypatch.setattr(workers, "cores", lambda: 8)
    assert at_once(simulator) == 8
    monkeypatch.setattr(workers, "memory", lambda: 6.5e5 * nodes)
    assert at_once(simulator) == 3
    assert at_once(simulator, nodes=3 * nodes) == 1
    for memory, solves in ((0.0, 1), (float("inf"), 8)):
        monkeypatch.setattr(workers, "memory", lambda memory=memory: memory)
        assert at_once(simulator) == solves


def test_what_keeps_a_factor_or_is_not_fem_is_not_shared(simulator, monkeypatch):
    monkeypatch.setattr(workers, "cores", lambda: 8)
    monkeypatch.setattr(type(simulator), "stepwise", True)
    assert at_once(simulator) == 1
    assert at_once(object()) == 1


def test_a_campaign_on_threads_has_the_solutions_of_one_after_the_other(beam, monkeypatch):
    simulator = Simulator(beam)
    thetas = sobol(beam, 9, 3)

    def solved(cores: int) -> np.ndarray:
        monkeypatch.setattr(workers, "cores", lambda: cores)
        return np.asarray(run_campaign(simulator, thetas).displacement)

    alone, three = solved(1), solved(3)
    np.testing.assert_allclose(three, alone, rtol=0.0, atol=1e-8 * np.abs(alone).max())
    np.testing.assert_array_equal(solved(3), three)
