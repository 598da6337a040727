"""The one place where threads of libraries are limited, and what the first start has to say.

OpenCV and BLAS split work that is too small to be split: a 300 x 300 product on two BLAS threads costs five
times what it costs on one. Overfly keeps one core for the frame at hand and reads the next frames on another
(pipeline/prefetch.py), so both libraries get one thread; an environment variable set by the user wins for
BLAS. Sums are then always taken in the same order, too: the same input gives the same bytes.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

WORKERS = min(4, max(2, os.cpu_count() or 2))  # more would want more memory than they save time
Job = TypeVar("Job")
Result = TypeVar("Result")
BLAS_VARIABLES = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")


def limit_blas_threads() -> None:
    """One BLAS thread; works only before numpy is imported, so the command line calls it first."""
    for variable in BLAS_VARIABLES:
        os.environ.setdefault(variable, "1")


@contextmanager
def one_opencv_thread() -> Iterator[None]:
    """OpenCV on one thread; afterwards on as many as before."""
    import cv2

    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


def in_order(work: Callable[[Job], Result], jobs: Iterable[Job], threads: int = WORKERS) -> Iterator[Result]:
    """What work makes of the jobs, in their order, on so many threads and a few jobs ahead; OpenCV keeps to
    one thread for each meanwhile. work must not depend on what became of other jobs; what it raises is raised
    here.
    """
    with one_opencv_thread(), ThreadPoolExecutor(threads, "overfly-worker") as pool:
        waiting: deque[Future[Result]] = deque()
        for job in jobs:
            waiting.append(pool.submit(work, job))
            if len(waiting) > 2 * threads:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()


def is_compiled() -> bool:
    """Whether the kernels were compiled by an earlier start, so that this one begins at once."""
    from overfly.vision import alignment

    made_ns = Path(alignment.__file__).stat().st_mtime_ns
    found = Path(alignment.kernel_cache_folder()).glob("alignment._align-*.nbi")
    return any(index.stat().st_mtime_ns >= made_ns for index in found)
