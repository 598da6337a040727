"""Streams of our own, read back by zlib."""

import zlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from overfly.products.deflate import LONGEST_CODE, LONGEST_RUN_PX, deflated


@given(
    seed=st.integers(0, 2**32 - 1),
    n_values=st.integers(1, 256),
    runs=st.lists(st.integers(1, 3 * LONGEST_RUN_PX), max_size=12),
)
def test_pixels_come_back(seed: int, n_values: int, runs: list[int]) -> None:
    generator = np.random.default_rng(seed)
    values = generator.permutation(256)[:n_values]
    parts = [np.zeros((0, 4), np.uint8)]
    for number, length in enumerate(runs):
        if number % 2:
            parts.append(np.full((length, 4), generator.choice(values), np.uint8))
        else:
            parts.append(generator.choice(values, (length, 4)).astype(np.uint8))
    pixels = np.concatenate(parts)
    assert zlib.decompress(deflated(pixels)) == pixels.tobytes()


def test_no_code_is_longer_than_the_format_allows() -> None:
    counts = [1, 1]
    while sum(counts) < 300_000:  # Huffman's code of Fibonacci's numbers is as deep as there are symbols
        counts.append(counts[-1] + counts[-2])
    assert len(counts) > LONGEST_CODE + 5
    data = np.repeat(np.arange(len(counts), dtype=np.uint8), counts)
    pixels = np.random.default_rng(1).permutation(data)[: len(data) // 4 * 4].reshape(-1, 4)
    assert zlib.decompress(deflated(pixels)) == pixels.tobytes()


@pytest.mark.parametrize("spread", [3.0, 10.0, 30.0])
def test_it_comes_near_to_what_is_told(spread: float) -> None:
    values = np.random.default_rng(2).normal(0.0, spread, (100_000, 4))
    pixels = np.round(values).astype(np.int64).astype(np.uint8)
    share = np.bincount(pixels.ravel(), minlength=256) / pixels.size
    entropy_bytes = -float(np.sum(share[share > 0] * np.log2(share[share > 0]))) * pixels.size / 8
    assert entropy_bytes < len(deflated(pixels)) < 1.04 * entropy_bytes + 400


def test_what_repeats_takes_hardly_anything() -> None:
    pixels = np.zeros((512 * 512, 4), np.uint8)
    assert 100 < len(deflated(pixels)) < len(zlib.compress(pixels.tobytes(), 1)) + 400
