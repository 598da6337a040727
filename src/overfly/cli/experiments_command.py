"""overfly experiments: the paper's experiments, our figures beside the paper's."""

from __future__ import annotations

import json
import shlex
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from overfly.cli.options import Assignments


def command(
    name: Annotated[str, typer.Argument(help="outdoor, corridor, blimp, hold, helicopter, or all.")] = "all",
    out: Annotated[
        Path, typer.Option("--out", "-o", help="Folder for experiments.html and experiments.json.")
    ] = Path("overfly-experiments"),
    seeds: Annotated[int, typer.Option(min=1, help="Flights of each experiment.")] = 10,
    first_seed: Annotated[int, typer.Option("--first-seed", min=0, help="Seed of the first flight.")] = 1,
    frames: Annotated[
        int | None, typer.Option(min=20, help="Only the first N frames of each flight.")
    ] = None,
    assignments: Assignments = None,
    json_output: Annotated[
        bool, typer.Option("--json", help="Print the figures as one JSON object.")
    ] = False,
) -> None:
    """Repeat the paper's experiments on the simulator: our figures beside the paper's, in a report."""
    from overfly.cli.console import say
    from overfly.config import load_config
    from overfly.pipeline.experiments import ExperimentsRequest, names_of, run_experiments

    request = ExperimentsRequest(
        names_of(name),
        seeds,
        out,
        frames,
        first_seed,
        load_config(None, assignments),
        shlex.join(["overfly", *sys.argv[1:]]),
    )
    report = run_experiments(request, say)
    if json_output:
        print(json.dumps(report))
    else:
        print(as_text(report))
        print(f"results in {out}: open {out / 'experiments.html'}")


def as_text(report: dict[str, Any]) -> str:
    """A table for a terminal."""
    lines = []
    for name, experiment in report["experiments"].items():
        lines.append(f"{name}: {experiment['title']}, {len(report['seeds'])} seeds")
        for row in experiment["rows"]:
            ours = "none" if row["ours"] is None else f"{row['ours']:.3g}"
            if row["sigma"] is not None:
                ours += f" +- {row['sigma']:.2g}"
            target = "" if row["limit"] is None else f"at most {row['limit']:g}"
            verdict = {None: "", True: "reached", False: "MISSED"}[row["reached"]]
            label = f"{row['label']} ({row['unit']})" if row["unit"] else row["label"]
            paper = f"paper {row['paper']}" if row["paper"] else ""
            lines.append(f"  {label:<52}{ours:>22}  {paper:<18}{target:<14}{verdict}".rstrip())
    return "\n".join(lines)
