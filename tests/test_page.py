"""What the page of a run gathers."""

from __future__ import annotations

from overfly.pipeline.page import _in_groups
from overfly.types import Problem


def test_files_with_the_same_problem_are_one_line() -> None:
    problems = [Problem(f"{number}.jpg", "empty file; passed over") for number in range(40)]
    problems.insert(7, Problem("attitude0/data.csv, row 3", "not a number; passed over"))
    assert _in_groups(problems) == [
        "0.jpg and 39 more: empty file; passed over",
        "attitude0/data.csv, row 3: not a number; passed over",
    ]
    assert _in_groups([]) == []
