"""Work on several threads: in its order, not far ahead, and what goes wrong is heard."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator

import cv2
import pytest

from overfly.threads import in_order


def test_results_come_in_the_order_of_the_jobs_from_several_threads() -> None:
    seen: set[str] = set()

    def slow_first(job: int) -> int:
        seen.add(threading.current_thread().name)
        time.sleep(0.02 if job % 2 == 0 else 0.0)
        return job * job

    assert list(in_order(slow_first, range(20))) == [job * job for job in range(20)]
    assert len(seen) == 2


def test_jobs_are_taken_a_few_ahead_only() -> None:
    taken = []

    def jobs() -> Iterator[int]:
        for job in range(100):
            taken.append(job)
            yield job

    results = in_order(lambda job: job, jobs(), threads=2)
    for done in range(10):
        assert next(results) == done
        assert len(taken) <= done + 6
    before = cv2.getNumThreads()
    results.close()
    assert before == 1
    assert len(taken) < 20


def test_what_work_raises_is_raised_here() -> None:
    def work(job: int) -> int:
        if job == 3:
            raise ValueError("job 3")
        return job

    results = in_order(work, range(10))
    assert [next(results) for _ in range(3)] == [0, 1, 2]
    with pytest.raises(ValueError, match="job 3"):
        next(results)
