"""What a view may spend of a core, by a clock and a processor of our own."""

from __future__ import annotations

import threading
import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from overfly.viewer.allowance import Allowance, cpu_seconds


class Bench:
    """now_s goes on while waiting and drawing; spent_s while drawing only."""

    def __init__(self) -> None:
        self.now_s = self.spent_s = 100.0

    def draw(self, cost_s: float) -> None:
        self.now_s += cost_s
        self.spent_s += cost_s


@given(st.lists(st.floats(0.0, 0.5), min_size=1, max_size=40), st.floats(0.01, 0.5), st.floats(0.0, 0.2))
def test_no_more_is_spent_than_allowed(costs: list[float], share: float, saved_s: float) -> None:
    bench = Bench()
    allowance = Allowance(share, saved_s, lambda: bench.spent_s, lambda: bench.now_s)
    assert allowance.wait_s() == 0.0
    for cost in costs:
        bench.draw(cost)
        bench.now_s += allowance.wait_s()
    spent, passed = bench.spent_s - 100.0, bench.now_s - 100.0
    assert spent <= share * passed + saved_s + 1e-6


def test_who_spends_little_never_waits_and_cannot_save_up_for_ever() -> None:
    bench = Bench()
    allowance = Allowance(0.1, 0.05, lambda: bench.spent_s, lambda: bench.now_s)
    for _ in range(100):
        assert allowance.wait_s() == 0.0
        bench.draw(0.01)
        bench.now_s += 0.5
    bench.draw(0.25)
    assert allowance.wait_s() == pytest.approx(0.25 / 0.1 - 0.05 / 0.1 - 0.25, abs=0.02 / 0.1 + 0.3)
    assert allowance.wait_s() > 1.0


def test_time_of_other_threads_is_counted() -> None:
    stop, working = threading.Event(), threading.Event()

    def work() -> None:
        while not stop.is_set():
            sum(range(1000))
            if time.thread_time() > 0.02:
                working.set()

    thread = threading.Thread(target=work)
    before = cpu_seconds([])
    thread.start()
    assert working.wait(20.0)
    counted = cpu_seconds([thread]) - cpu_seconds([])
    stop.set()
    thread.join()
    assert counted > (0.015 if hasattr(time, "pthread_getcpuclockid") else -1.0)
    assert cpu_seconds([thread]) - before < 20.0  # one that has ended is not asked
