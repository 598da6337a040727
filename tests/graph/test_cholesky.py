"""The block Cholesky factorisation against dense linear algebra, on random graphs."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from overfly.graph.cholesky import factorise
from overfly.graph.symbolic import analyse


def random_system(n: int, extra: int, block: int, seed: int):
    """Pattern of a chain with extra links, blocks of a positive definite matrix, and the dense matrix
    itself.
    """
    random = np.random.default_rng(seed)
    links = {(k, k + 1) for k in range(n - 1)}
    for _ in range(extra):
        a, b = sorted(random.integers(0, n, 2))
        if a != b:
            links.add((int(a), int(b)))
    pairs = np.array(sorted(links))
    swapped = random.random(len(pairs)) < 0.5
    first, second = np.where(swapped, pairs[:, 1], pairs[:, 0]), np.where(swapped, pairs[:, 0], pairs[:, 1])
    dense = np.zeros((n, block, n, block))
    for a, b in zip(first, second, strict=True):
        J = random.normal(size=(block, 2, block))
        H = np.einsum("rak,rbl->akbl", J, J)
        dense[np.ix_([a, b], range(block), [a, b], range(block))] += H
    dense += np.eye(n * block).reshape(dense.shape)
    diagonal = np.array([dense[k, :, k, :] for k in range(n)])
    off_diagonal = np.array([dense[a, :, b, :] for a, b in zip(first, second, strict=True)])
    return first, second, diagonal, off_diagonal, dense.reshape(n * block, n * block)


@settings(max_examples=25, deadline=None)
@given(
    n=st.integers(2, 60),
    extra=st.integers(0, 60),
    block=st.sampled_from([3, 4, 6]),
    seed=st.integers(0, 10**6),
)
def test_solves_what_dense_algebra_solves(n, extra, block, seed):
    first, second, diagonal, off_diagonal, dense = random_system(n, extra, block, seed)
    factor = factorise(analyse(n, first, second), diagonal, off_diagonal)
    right = np.random.default_rng(seed).normal(size=(n, block, 2))
    expected = np.linalg.solve(dense, right.reshape(n * block, 2)).reshape(right.shape)
    np.testing.assert_allclose(factor.solve(right), expected, rtol=1e-8, atol=1e-8)


@settings(max_examples=15, deadline=None)
@given(
    n=st.integers(2, 50), extra=st.integers(0, 50), block=st.sampled_from([3, 6]), seed=st.integers(0, 10**6)
)
def test_selected_inverse_is_the_inverse(n, extra, block, seed):
    first, second, diagonal, off_diagonal, dense = random_system(n, extra, block, seed)
    factor = factorise(analyse(n, first, second), diagonal, off_diagonal)
    inverse = np.linalg.inv(dense).reshape(n, block, n, block)
    np.testing.assert_allclose(
        factor.inverse_diagonal(), [inverse[k, :, k, :] for k in range(n)], rtol=1e-8, atol=1e-10
    )
    nodes = np.array([0, n - 1])
    expected = inverse[np.ix_(nodes, range(block), nodes, range(block))].reshape(2 * block, 2 * block)
    np.testing.assert_allclose(factor.inverse_blocks(nodes), expected, rtol=1e-8, atol=1e-10)


def test_a_kept_order_serves_a_grown_pattern():
    first, second, diagonal, off_diagonal, dense = random_system(30, 20, 3, 1)
    order = np.random.default_rng(2).permutation(30)
    factor = factorise(analyse(30, first, second, order), diagonal, off_diagonal)
    right = np.ones((30, 3))
    np.testing.assert_allclose(factor.solve(right).ravel(), np.linalg.solve(dense, right.ravel()), rtol=1e-9)


@pytest.mark.parametrize("block", [3, 6])
def test_not_positive_definite_is_told(block):
    first, second, diagonal, off_diagonal, _ = random_system(10, 5, block, 3)
    diagonal[4] -= 1e6 * np.eye(block)
    assert factorise(analyse(10, first, second), diagonal, off_diagonal) is None
