"""overfly optimise: the back end alone, on pose graph files."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer


def command(
    graph: Annotated[Path, typer.Argument(help="g2o or TORO file, planar or spatial, .gz or not.")],
    output: Annotated[
        Path,
        typer.Option("--output", "-o", help="Where to write the result (.g2o, .graph, with .gz if wanted)."),
    ],
    method: Annotated[
        str, typer.Option(help="sparse (least squares) or tree (gradient descent along a spanning tree).")
    ] = "sparse",
    robust: Annotated[str, typer.Option(help="Kernel on the revisits: none, huber, cauchy or dcs.")] = "none",
    scale: Annotated[
        float | None, typer.Option(help="Width of the kernel in standard deviations (dcs: its phi).")
    ] = None,
    levelled: Annotated[
        bool, typer.Option("--levelled", help="Hold roll and pitch: x, y, z and yaw are optimised.")
    ] = False,
    iterations: Annotated[int, typer.Option(help="At most so many.", min=1)] = 100,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as one JSON object.")] = False,
) -> None:
    """Optimise a pose graph and write it with its corrected poses."""
    from overfly.errors import UsageError
    from overfly.graph.batch import Method, optimise_batch
    from overfly.graph.files import read_graph, write_graph
    from overfly.graph.linearise import Freedom
    from overfly.graph.robust import Kernel, Robust

    if method not in set(Method):
        raise UsageError(f"--method is {' or '.join(Method)}, not {method}")
    if robust not in set(Kernel):
        raise UsageError(f"--robust is one of {', '.join(Kernel)}, not {robust}")
    if scale is not None and not scale > 0:
        raise UsageError("--scale must be above zero")
    pose_graph = read_graph(graph)
    if levelled and pose_graph.planar:
        raise UsageError(f"{graph} is planar: --levelled is for graphs in space")
    report = optimise_batch(
        pose_graph,
        Method(method),
        Robust(Kernel(robust), scale),
        Freedom.LEVELLED if levelled else None,
        max_iterations=iterations,
    )
    endings = {suffix.lower() for suffix in output.suffixes}
    write_graph(output, pose_graph, "toro" if ".graph" in endings or ".toro" in endings else "g2o")
    if as_json:
        print(json.dumps({**asdict(report), "output": str(output)}))
    else:
        print(
            f"{report.nodes} nodes, {report.constraints} constraints: "
            f"chi2 {report.chi2_before:.6g} -> {report.chi2_after:.6g} "
            f"in {report.iterations} iterations, {report.cpu_s:.2f} s"
            + ("" if report.converged else " (stopped before it settled)")
        )
