"""Zlib streams of what a predictor leaves of a picture (RFC 1950 and 1951): one code for all bytes, and runs.

In such bytes there is next to nothing to be found again, and zlib's search for it takes three times as long
as their code.
"""

from __future__ import annotations

import zlib

import numpy as np
from numba import njit
from numpy.typing import NDArray

from overfly.types import UInt8Array

PIXEL_BYTES = 4
LONGEST_RUN_PX = 64  # 256 bytes; the format ends at 258
LONGEST_CODE = 15
END, FIRST_LENGTH, SYMBOLS = 256, 257, 286
HEADER = b"\x78\x01"
LOW = np.uint64(0xFFFFFFFF)


def _lengths_of_runs() -> NDArray[np.int64]:
    """(LONGEST_RUN_PX + 1, 3) for each length of a run: its symbol, how many bits follow it, their value."""
    table = np.zeros((LONGEST_RUN_PX + 1, 3), np.int64)
    first = 3
    for number in range(SYMBOLS - 1 - FIRST_LENGTH):
        bits = max(0, number // 4 - 1)
        for length in range(first, first + (1 << bits)):
            if length % PIXEL_BYTES == 0 and length <= PIXEL_BYTES * LONGEST_RUN_PX:
                table[length // PIXEL_BYTES] = FIRST_LENGTH + number, bits, length - first
        first += 1 << bits
    return table


LENGTHS_OF_RUNS = _lengths_of_runs()


def deflated(pixels: UInt8Array) -> bytes:
    """A zlib stream of pixels (n, 4); threads may share the work."""
    data = np.ascontiguousarray(pixels).reshape(-1)
    packed = np.empty(len(data) // 2 + 256, np.uint32)  # no byte takes more than 15 bits
    n_bits = _pack(data, data.view(np.uint32), LENGTHS_OF_RUNS, packed)
    body = packed[: n_bits // 32 + 1].astype("<u4").tobytes()[: -(-n_bits // 8)]
    return HEADER + body + zlib.adler32(data.data).to_bytes(4, "big")


@njit(cache=True, nogil=True)
def _pack(data, pixels, lengths_of_runs, packed):  # type: ignore[no-untyped-def]
    """One block with a code of its own; how many bits it takes of packed."""
    sizes = _code_lengths(_counts(data, pixels, lengths_of_runs))
    codes = _codes(sizes)
    word, held, used = _head(sizes, packed)
    at = 0
    while at < len(pixels):
        run = _run(data, pixels, at)
        if run:
            symbol, bits, value = lengths_of_runs[run]
            word, held, used = _put(word, held, used, packed, codes[symbol], sizes[symbol])
            # behind it the distance: one bit, 0
            word, held, used = _put(word, held, used, packed, np.uint64(value), bits + 1)
            at += run
            continue
        for first in (PIXEL_BYTES * at, PIXEL_BYTES * at + 2):
            one, other = data[first], data[first + 1]
            both = codes[one] | codes[other] << np.uint64(sizes[one])
            word, held, used = _put(word, held, used, packed, both, sizes[one] + sizes[other])
        at += 1
    word, held, used = _put(word, held, used, packed, codes[END], sizes[END])
    packed[used] = np.uint32(word & LOW)
    return 32 * used + held


@njit(cache=True, nogil=True)
def _counts(data, pixels, lengths_of_runs):  # type: ignore[no-untyped-def]
    """(SYMBOLS,) how often each occurs; two do at least."""
    counts = np.zeros(SYMBOLS, np.int64)
    counts[0] = counts[END] = 1
    at = 0
    while at < len(pixels):
        run = _run(data, pixels, at)
        if run:
            counts[lengths_of_runs[run, 0]] += 1
            at += run
            continue
        for k in range(PIXEL_BYTES):
            counts[data[PIXEL_BYTES * at + k]] += 1
        at += 1
    return counts


@njit(cache=True, nogil=True)
def _run(data, pixels, at):  # type: ignore[no-untyped-def]
    """How many pixels from here on do nothing but repeat the byte before."""
    if at == 0:
        return 0
    last = np.uint32(data[PIXEL_BYTES * at - 1]) * np.uint32(0x01010101)
    run, most = 0, min(LONGEST_RUN_PX, len(pixels) - at)
    while run < most and pixels[at + run] == last:
        run += 1
    return run


@njit(cache=True, nogil=True)
def _head(sizes, packed):  # type: ignore[no-untyped-def]
    """The block's beginning and its code."""
    word, held, used = np.uint64(0), 0, 0
    for value, bits in ((1, 1), (2, 2), (SYMBOLS - 257, 5), (0, 5), (15, 4)):
        word, held, used = _put(word, held, used, packed, np.uint64(value), bits)
    # lengths of codes are told by four bits each, whatever they are: symbols 16 to 18, for runs, go unused
    for k in range(19):
        word, held, used = _put(word, held, used, packed, np.uint64(0 if k < 3 else 4), 3)
    for k in range(SYMBOLS):
        word, held, used = _put(word, held, used, packed, np.uint64(_reversed(sizes[k], 4)), 4)
    # the only distance is that to the byte before
    return _put(word, held, used, packed, np.uint64(_reversed(1, 4)), 4)


@njit(cache=True, nogil=True, inline="always")
def _put(word, held, used, packed, code, size):  # type: ignore[no-untyped-def]
    """Add a code of at most 32 bits to the held bits of a word, of which there are less than 32 before and
    after; without a branch, which nothing could foretell."""
    word |= code << np.uint64(held)
    held += size
    packed[used] = np.uint32(word & LOW)
    is_full = held >> 5
    return word >> np.uint64(is_full << 5), held & 31, used + is_full


@njit(cache=True, nogil=True)
def _code_lengths(counts):  # type: ignore[no-untyped-def]
    """(n,) bits of each symbol's code (Huffman 1952), 0 where it does not occur; two symbols do at least."""
    weights = counts.copy()
    while True:
        order = np.argsort(weights)
        order = order[weights[order] > 0]
        n = len(order)
        weight, parent = np.empty(2 * n - 1, np.int64), np.empty(2 * n - 1, np.int64)
        weight[:n] = weights[order]
        leaf, inner = 0, n
        for made in range(n, 2 * n - 1):  # leaves and inner nodes both come in the order of their weights
            weight[made] = 0
            for _ in range(2):
                if leaf < n and (inner >= made or weight[leaf] <= weight[inner]):
                    child = leaf
                    leaf += 1
                else:
                    child = inner
                    inner += 1
                parent[child] = made
                weight[made] += weight[child]
        depth = np.zeros(2 * n - 1, np.int64)
        for node in range(2 * n - 3, -1, -1):
            depth[node] = depth[parent[node]] + 1
        if depth.max() <= LONGEST_CODE:
            lengths = np.zeros(len(counts), np.int64)
            lengths[order] = depth[:n]
            return lengths
        weights = np.where(weights > 0, weights // 2 + 1, 0)  # more alike: the tree becomes less deep


@njit(cache=True, nogil=True)
def _codes(sizes):  # type: ignore[no-untyped-def]
    """(n,) canonical codes, the first bit lowest."""
    codes, code = np.zeros(len(sizes), np.uint64), 0
    for size in range(1, LONGEST_CODE + 1):
        code <<= 1
        for symbol in range(len(sizes)):
            if sizes[symbol] == size:
                codes[symbol] = np.uint64(_reversed(code, size))
                code += 1
    return codes


@njit(cache=True, nogil=True, inline="always")
def _reversed(value, bits):  # type: ignore[no-untyped-def]
    turned = 0
    for _ in range(bits):
        turned = turned << 1 | value & 1
        value >>= 1
    return turned
