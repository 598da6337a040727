"""Feature types on neighbouring pictures of real flights, with their parallax, blur and light; no truth is
needed.

    python benchmarks/features_sequences.py --data DATA/real

Inliers are matches that one robust homography explains to 3 px: a measure of agreement, not of accuracy.
"""

from __future__ import annotations

import argparse
import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np

from overfly.types import Features
from overfly.vision.features import EXTRACTOR_NAMES, Extractor, create_extractor
from overfly.vision.matching import match_mutual

# Pictures of each flight and how many of them lie between two that are compared.
FLIGHTS = {
    "brighton_beach": ("brighton_beach/images/*.JPG", 1),
    "caliterra": ("caliterra/images/*.jpg", 1),
    "cuav": ("cuav/mav0/cam0/data/*", 1),
    "opticflow": ("opticflow/mav0/cam0/data/*", 10),
    "eth_downfacing_vio": ("eth_downfacing_vio/mav0/cam0/data/*", 5),
}
LARGEST_WIDTH = 640


def load_flight(data: Path, pattern: str, step: int, most: int) -> list[np.ndarray]:
    """Gray pictures (H, W) uint8 of the middle of a flight, at most 640 pixels wide."""
    files = sorted(path for path in data.glob(pattern) if path.suffix.lower() in {".jpg", ".png"})[::step]
    middle = max(0, (len(files) - most) // 2)
    pictures = []
    for path in files[middle : middle + most]:
        picture = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        scale = min(1.0, LARGEST_WIDTH / picture.shape[1])
        size = (round(picture.shape[1] * scale), round(picture.shape[0] * scale))
        pictures.append(cv2.resize(picture, size, interpolation=cv2.INTER_AREA))
    return pictures


def count_inliers(extractor: Extractor, a: Features, b: Features) -> int:
    index_a, index_b, _ = match_mutual(a.descriptors, b.descriptors, extractor.metric, extractor.max_distance)
    if len(index_a) < 6:
        return 0
    cv2.setRNGSeed(1)
    _, mask = cv2.findHomography(
        a.px[index_a], b.px[index_b], cv2.RANSAC, 3.0, maxIters=3000, confidence=0.999
    )
    return 0 if mask is None else int(mask.sum())


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, required=True, help="folder of the real flights")
    parser.add_argument("--count", type=int, default=500, help="features per picture")
    parser.add_argument("--pictures", type=int, default=20, help="per flight")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    flights = {
        name: load_flight(options.data, pattern, step, options.pictures)
        for name, (pattern, step) in FLIGHTS.items()
    }
    print("| median (smallest) inliers | " + " | ".join(flights) + " |")
    print("|---" * (len(flights) + 1) + "|")
    for name in EXTRACTOR_NAMES:
        extractor = create_extractor(name, options.count)
        cells = []
        for pictures in flights.values():
            features = [extractor.extract(picture) for picture in pictures]
            inliers = [count_inliers(extractor, a, b) for a, b in pairwise(features)]
            cells.append(f"{np.median(inliers):.0f} ({min(inliers)})" if inliers else "none")
        print(f"| {name} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
