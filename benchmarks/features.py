"""How good and how fast the feature types are, on real aerial pictures with exactly known homographies.

python benchmarks/features.py --data DATA/real --json features.json
python benchmarks/features.py --data DATA/real --curves docs/features_curves.svg
"""

from __future__ import annotations

import argparse
import json
import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from features_curves import draw_curves, measure_curves
from features_pairs import KINDS, Outcome, evaluate, load_pictures, make_pairs

from overfly.vision.features import EXTRACTOR_NAMES, create_extractor


def summarise(name: str, outcomes: list[Outcome], max_distance: float) -> dict[str, object]:
    """One row of the table: medians of time and localisation, means of the rest."""
    right = np.concatenate([outcome.right_distances for outcome in outcomes])
    wrong = np.concatenate([outcome.wrong_distances for outcome in outcomes])

    def part(chosen: list[Outcome]) -> dict[str, float]:
        return {
            "correct": float(np.mean([outcome.correct for outcome in chosen])),
            "success": float(np.mean([outcome.success for outcome in chosen])),
        }

    groups = sorted({outcome.group for outcome in outcomes})
    return {
        "name": name,
        "milliseconds": float(np.median([outcome.milliseconds for outcome in outcomes])),
        "features": float(np.mean([outcome.features for outcome in outcomes])),
        "matches": float(np.mean([outcome.matches for outcome in outcomes])),
        "localisation_px": float(np.nanmedian([outcome.localisation_px for outcome in outcomes])),
        **part(outcomes),
        "kinds": {kind: part([o for o in outcomes if o.kind == kind]) for kind in KINDS},
        "sets": {group: part([o for o in outcomes if o.group == group]) for group in groups},
        "max_distance": max_distance,
        "distance_of_right": dict(
            zip(("p50", "p90", "p95", "p98"), np.percentile(right, (50, 90, 95, 98)), strict=True)
        ),
        "distance_of_wrong": dict(zip(("p05", "p25", "p50"), np.percentile(wrong, (5, 25, 50)), strict=True)),
        "right_kept": float(np.mean(right <= max_distance)),
        "wrong_kept": float(np.mean(wrong <= max_distance)),
    }


def print_table(rows: list[dict[str, Any]]) -> None:
    """Markdown, as in docs/features.md."""
    print("\n| type | ms | features | correct | localisation px | success |")
    print("|---|---|---|---|---|---|")
    for row in rows:
        print(
            f"| {row['name']} | {row['milliseconds']:.1f} | {row['features']:.0f} | {row['correct']:.0f} "
            f"| {row['localisation_px']:.2f} | {row['success']:.2f} |"
        )
    for what, keys in (("kinds", KINDS), ("sets", tuple(rows[0]["sets"]))):
        print("\n| correct / success | " + " | ".join(keys) + " |")
        print("|---" * (len(keys) + 1) + "|")
        for row in rows:
            cells = [f"{row[what][key]['correct']:.0f} / {row[what][key]['success']:.2f}" for key in keys]
            print(f"| {row['name']} | " + " | ".join(cells) + " |")
    print("\n| type | right p50 | p95 | p98 | wrong p05 | p50 | limit | right kept | wrong kept |")
    print("|---" * 9 + "|")
    for row in rows:
        right, wrong = row["distance_of_right"], row["distance_of_wrong"]
        numbers = (right["p50"], right["p95"], right["p98"], wrong["p05"], wrong["p50"], row["max_distance"])
        cells = [f"{number:.3g}" for number in numbers] + [
            f"{row['right_kept']:.2f}",
            f"{row['wrong_kept']:.2f}",
        ]
        print(f"| {row['name']} | " + " | ".join(cells) + " |")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, required=True, help="folder of the real flights")
    parser.add_argument(
        "--types", nargs="+", default=[name for name in EXTRACTOR_NAMES if not name.endswith("-upright")]
    )
    parser.add_argument("--size", default="320x240", help="of the views, WIDTHxHEIGHT")
    parser.add_argument("--count", type=int, default=500, help="features per view")
    parser.add_argument("--pictures", type=int, default=8, help="per set")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", type=Path, help="where to write the figures")
    parser.add_argument("--curves", type=Path, help="where to draw robustness curves (SVG) instead")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    width, height = (int(number) for number in options.size.split("x"))
    pictures = load_pictures(options.data, options.pictures)
    extractors = [create_extractor(name, options.count) for name in options.types]
    if options.curves:
        curves = measure_curves(extractors, pictures, (width, height), options.seed)
        draw_curves(curves, options.curves)
        return
    pairs = make_pairs(pictures, (width, height), KINDS, options.seed)
    rows = []
    for extractor in extractors:
        extractor.extract(pairs[0].a)  # compiles
        outcomes = [evaluate(extractor, pair) for pair in pairs]
        rows.append(summarise(extractor.name, outcomes, extractor.max_distance))
        print(f"{extractor.name} done: {len(pairs)} pairs", flush=True)
    print_table(rows)
    if options.json:
        options.json.write_text(
            json.dumps({"size": options.size, "count": options.count, "rows": rows}, indent=1)
        )


if __name__ == "__main__":
    main()
