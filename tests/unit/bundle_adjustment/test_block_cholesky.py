"""The sparse factorisation against numpy's dense one."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from mrasfm_engine.bundle_adjustment.block_cholesky import BLOCK, BlockFactor, BlockPattern, Elimination

Floats = NDArray[np.float64]


def chain(columns: int, band: int, loops: int, seed: int = 0) -> tuple[BlockPattern, Floats]:
    """Pattern and blocks of a positive definite matrix that couples neighbours, and some others."""
    rng = np.random.default_rng(seed)
    near = [(k, k + d) for d in range(1, band + 1) for k in range(columns - d)]
    far = rng.integers(0, columns, (loops, 2)).tolist()
    i, j = np.array([*near, *far, (0, 0)], dtype=np.int64).T
    pattern = BlockPattern.of_pairs(columns, i, j)
    blocks = rng.normal(0.0, 0.1, (len(pattern.row), BLOCK, BLOCK))
    column = pattern.column_of_block()
    on_diagonal = np.flatnonzero(pattern.row == column)
    degree = np.bincount(pattern.row, minlength=columns) + np.bincount(column, minlength=columns)
    blocks[on_diagonal] += np.swapaxes(blocks[on_diagonal], 1, 2) + np.eye(BLOCK) * degree[:, None, None]
    return pattern, blocks


def dense(pattern: BlockPattern, blocks: Floats) -> Floats:
    """The whole matrix."""
    whole = np.zeros((pattern.columns, BLOCK, pattern.columns, BLOCK))
    column = pattern.column_of_block()
    for block, i, j in zip(blocks, pattern.row, column, strict=True):
        whole[i, :, j, :] = block
        whole[j, :, i, :] = block.T
    return whole.reshape(BLOCK * pattern.columns, -1)


CHAINS = [(1, 0, 0), (2, 1, 0), (40, 3, 0), (40, 3, 12), (25, 24, 0), (60, 0, 0)]


@pytest.mark.parametrize(("columns", "band", "loops"), CHAINS)
def test_solutions_and_inverse(columns: int, band: int, loops: int) -> None:
    pattern, blocks = chain(columns, band, loops)
    matrix = dense(pattern, blocks)
    factor = BlockFactor.from_blocks(Elimination.from_pattern(pattern), blocks)
    assert factor is not None
    right = np.random.default_rng(1).normal(size=(BLOCK * columns, 4))
    np.testing.assert_allclose(factor.solve(right), np.linalg.solve(matrix, right), rtol=1e-10, atol=1e-13)
    np.testing.assert_allclose(factor.solve(right[:, 1]), np.linalg.solve(matrix, right[:, 1]), rtol=1e-10, atol=1e-13)
    inverse = np.linalg.inv(matrix).reshape(columns, BLOCK, columns, BLOCK)
    expected = inverse[np.arange(columns), :, np.arange(columns), :]
    np.testing.assert_allclose(factor.inverse_diagonal(), expected, rtol=1e-9, atol=1e-13)


@pytest.mark.parametrize(("columns", "band", "loops"), CHAINS)
def test_right_hand_sides_that_most_columns_know_nothing_of(columns: int, band: int, loops: int) -> None:
    pattern, blocks = chain(columns, band, loops)
    factor = BlockFactor.from_blocks(Elimination.from_pattern(pattern), blocks)
    assert factor is not None
    rng = np.random.default_rng(2)
    right = np.zeros((columns, BLOCK, 45))
    for first in range(0, 45, 5):
        right[rng.integers(columns), :, first : first + 5] = rng.normal(size=(BLOCK, 5))
    right = right.reshape(BLOCK * columns, 45)
    right[:, 20:30] = 0.0
    found = factor.solve(right)
    np.testing.assert_allclose(found, np.linalg.solve(dense(pattern, blocks), right), rtol=1e-9, atol=1e-13)
    half = factor.forward(right)
    assert not half[:, 20:30].any()
    np.testing.assert_allclose(half.T @ half, right.T @ found, rtol=1e-9, atol=1e-13)


def test_only_the_lower_triangle_of_diagonal_blocks_is_read() -> None:
    pattern, blocks = chain(10, 2, 3)
    order = Elimination.from_pattern(pattern)
    right = np.ones(60)
    whole = BlockFactor.from_blocks(order, blocks)
    lower = blocks.copy()
    lower[pattern.first[:-1]] = np.tril(lower[pattern.first[:-1]])
    half = BlockFactor.from_blocks(order, lower)
    assert whole is not None
    assert half is not None
    np.testing.assert_array_equal(half.solve(right), whole.solve(right))


def test_not_positive_definite() -> None:
    pattern, blocks = chain(12, 2, 0)
    blocks[pattern.first[5], 3, 3] = -1.0
    assert BlockFactor.from_blocks(Elimination.from_pattern(pattern), blocks) is None
    blocks[pattern.first[5], 3, 3] = np.nan
    assert BlockFactor.from_blocks(Elimination.from_pattern(pattern), blocks) is None


def test_a_chain_of_units_stays_sparse() -> None:
    """Ten loops of twenty units each: the factor has few blocks more than the matrix, where a band would have many."""
    n, i, j = 2000, [], []
    for d in range(1, 9):
        i.append(np.arange(n - d))
        j.append(np.arange(n - d) + d)
    for k in range(10):
        a, b = 90 * k, n - 100 * (k + 1)
        for d in range(-4, 5):
            i.append(np.arange(a + 10, a + 30))
            j.append(np.arange(b + 10, b + 30) + d)
    pattern = BlockPattern.of_pairs(n, np.concatenate(i), np.concatenate(j))
    blocks = len(Elimination.from_pattern(pattern).factor.row)
    assert len(pattern.row) < blocks < 2.5 * len(pattern.row)


def test_an_empty_matrix() -> None:
    none = np.zeros(0, dtype=np.int64)
    pattern = BlockPattern.of_pairs(0, none, none)
    factor = BlockFactor.from_blocks(Elimination.from_pattern(pattern), np.zeros((0, BLOCK, BLOCK)))
    assert factor is not None
    assert factor.solve(np.zeros(0)).shape == (0,)
