"""overfly evaluate: an estimated trajectory against the truth."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from overfly.errors import GraphFileError, UsageError

if TYPE_CHECKING:
    from overfly.evaluation import Evaluation, Statistics

WHICH = ("trajectory", "online", "odometry", "fixes")
ALIGNMENTS = ("none", "yaw", "se3", "sim3")


def command(
    estimate: Annotated[Path, typer.Argument(help="A TUM file, or the folder that map or locate left.")],
    truth: Annotated[Path, typer.Argument(help="A TUM file of the same camera and clock.")],
    align: Annotated[str, typer.Option(help="Taken out before comparing: none, yaw, se3 or sim3.")] = "se3",
    which: Annotated[
        str, typer.Option(help="In a folder: trajectory, online, odometry or fixes.")
    ] = "trajectory",
    tolerance_s: Annotated[
        float, typer.Option("--tolerance-s", help="Largest difference in time of one frame.")
    ] = 0.01,
    plot: Annotated[Path | None, typer.Option(help="Draw both paths and the error, .svg or .png.")] = None,
    json_output: Annotated[bool, typer.Option("--json", help="Print the result as one JSON object.")] = False,
) -> None:
    """Compare a trajectory with the truth: ATE, RPE, scale, coverage."""
    if align not in ALIGNMENTS:
        raise UsageError(f"--align {align}: choose one of {', '.join(ALIGNMENTS)}")
    if which not in WHICH:
        raise UsageError(f"--which {which}: choose one of {', '.join(WHICH)}")
    if plot is not None and plot.suffix.lower() not in (".svg", ".png"):
        raise UsageError(f"--plot {plot}: the name must end in .svg or .png")
    if not 0 <= tolerance_s < 1e9:
        raise UsageError(f"--tolerance-s {tolerance_s:g}: give seconds, not negative")
    from overfly.evaluation import Align, evaluate
    from overfly.trajectory import read_tum

    path = estimate / f"{which}.tum" if estimate.is_dir() else estimate
    estimated, true = read_tum(path), read_tum(truth)
    try:
        result = evaluate(estimated, true, Align(align), tolerance_s)
    except GraphFileError as error:
        raise GraphFileError(f"{path} against {truth}: {error}") from error
    if plot is not None:
        from overfly.products.figures import draw_evaluation

        draw_evaluation(plot, result)
    if json_output:
        import json

        print(json.dumps(as_dictionary(result)))
    else:
        print(as_text(result))


def as_dictionary(result: Evaluation) -> dict[str, Any]:
    """The figures of an evaluation in JSON's own types."""
    from dataclasses import asdict

    return {
        "align": str(result.align),
        "n_frames": result.n_frames,
        "n_truth": result.n_truth,
        "coverage": result.coverage,
        "path_m": result.path_m,
        "scale_error": result.scale_error,
        "final_error_m": result.final_error_m,
        "final_error_percent": result.final_error_percent,
        "ate_m": asdict(result.ate_m),
        "ate_horizontal_m": asdict(result.ate_horizontal_m),
        "ate_vertical_m": asdict(result.ate_vertical_m),
        "rotation_rad": asdict(result.rotation_rad),
        "relative": [asdict(relative) for relative in result.relative],
        "truth_from_estimate": {
            "scale": result.truth_from_estimate.scale,
            "rotation": result.truth_from_estimate.rotation.tolist(),
            "translation": result.truth_from_estimate.translation.tolist(),
        },
    }


def as_text(result: Evaluation) -> str:
    """The figures of an evaluation as a table for a terminal."""
    from math import degrees

    scale = "unknown" if result.scale_error is None else f"{100 * result.scale_error:+.3f} %"
    percent = (
        "" if result.final_error_percent is None else f", {result.final_error_percent:.3f} % of the path"
    )
    lines = [
        f"{result.n_frames} of {result.n_truth} true frames ({100 * result.coverage:.1f} %), "
        f"path {result.path_m:.2f} m, alignment {result.align}",
        f"scale error {scale}; final error {result.final_error_m:.4f} m{percent}",
        "",
        f"{'absolute error':<22}{'rmse':>10}{'mean':>10}{'median':>10}{'p95':>10}{'max':>10}",
        _row("position (m)", result.ate_m),
        _row("  horizontal (m)", result.ate_horizontal_m),
        _row("  vertical (m)", result.ate_vertical_m),
        _row("rotation (deg)", result.rotation_rad, degrees(1)),
        "",
        f"{'relative error over':<22}{'pairs':>10}{'rmse (m)':>10}{'% of path':>10}"
        f"{'rmse (deg)':>12}{'deg/m':>10}",
    ]
    for relative in result.relative:
        over = "1 frame" if relative.length_m is None else f"{relative.length_m:g} m"
        path = "-" if relative.translation_percent is None else f"{relative.translation_percent:.3f}"
        turn = "-" if relative.rotation_deg_per_m is None else f"{relative.rotation_deg_per_m:.4f}"
        lines.append(
            f"{'  ' + over:<22}{relative.n_pairs:>10}{relative.translation_m.rmse:>10.4f}{path:>10}"
            f"{degrees(relative.rotation_rad.rmse):>12.4f}{turn:>10}"
        )
    return "\n".join(lines)


def _row(label: str, statistics: Statistics, factor: float = 1.0) -> str:
    values = (statistics.rmse, statistics.mean, statistics.median, statistics.p95, statistics.max)
    return f"{label:<22}" + "".join(f"{factor * value:>10.4f}" for value in values)
