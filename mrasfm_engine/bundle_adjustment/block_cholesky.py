"""Sparse Cholesky factorisation by blocks, for the units of long drives.

A drive is a long chain: a unit shares points with those some seconds before and after it, and with others only where
the route returns. The matrix that couples units is a band with few blocks beside it, and its factor stays nearly as
sparse when the units are eliminated in a good order. A direct factorisation keeps the digits that conjugate gradients
lose on chains, whose condition number grows with the square of their length.

With the units in elimination order, block column j of the factor of A = L L' follows from those before it that have a
block in row j (left-looking; George and Liu, "Computer Solution of Large Sparse Positive Definite Systems", 1981):

    W_i = A_ij - sum over k of L_ik L_jk'        L_jj = cholesky(W_j)        L_ij = W_i L_jj^-T

Where L has blocks follows from A's places alone: the rows of column j, and those of every column whose first row below
its diagonal is j. `Elimination` finds order and places once a problem; numbers follow once an iteration.

The blocks of A^-1 in the same places (all marginal covariances among them) follow backwards from Z = A^-1 without the
rest of the inverse (Takahashi, Fagan and Chen, 1973):

    Z_ij = - sum over k > j of Z_ik L_kj L_jj^-1        Z_jj = L_jj^-T L_jj^-1 - sum over k > j of Z_jk L_kj L_jj^-1
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse
import scipy.sparse.linalg

from mrasfm_engine.jit import njit
from mrasfm_engine.types import Bools, Floats, Ints

BLOCK = 6
RIGHT_HAND_SIDES = 8  # next to one another, that are skipped together where all are zero
FULL = 0.8  # of all places: where so many are taken, no order leaves others empty


@dataclass(frozen=True, kw_only=True)
class BlockPattern:
    """Blocks of the lower triangle of a symmetric matrix, by block columns: every diagonal one at least."""

    first: Ints  # (columns + 1,)
    row: Ints  # rows of column j: row[first[j]:first[j + 1]], ascending from j

    @staticmethod
    def of_pairs(columns: int, i: Ints, j: Ints) -> BlockPattern:
        """The pattern with the diagonal and blocks (i, j), in either order and any number of times."""
        every = np.arange(columns, dtype=np.int64)
        keys = np.unique(np.concatenate([every * (columns + 1), np.minimum(i, j) * columns + np.maximum(i, j)]))
        column, row = np.divmod(keys, max(columns, 1))
        return BlockPattern(first=np.searchsorted(column, np.arange(columns + 1)).astype(np.int64), row=row)

    @property
    def columns(self) -> int:
        """Number of block columns."""
        return len(self.first) - 1

    def column_of_block(self) -> Ints:
        """The column (blocks,) of every block."""
        return np.repeat(np.arange(self.columns, dtype=np.int64), np.diff(self.first))


@dataclass(frozen=True, kw_only=True)
class Elimination:
    """The order in which the columns of a pattern are eliminated, and the factor's pattern in that order."""

    position: Ints  # (columns,) when a column is eliminated
    factor: BlockPattern
    source: Ints  # (blocks of the matrix,) its place among the factor's blocks
    transposed: Bools  # (blocks of the matrix,) whether it is above the diagonal there

    @staticmethod
    def from_pattern(pattern: BlockPattern) -> Elimination:
        """A minimum degree order for a pattern (Liu's, of A' + A, as SuperLU has it)."""
        n, row, column = pattern.columns, pattern.row, pattern.column_of_block()
        full = len(row) > FULL * n * (n + 1) / 2
        position = np.arange(n, dtype=np.int64) if full else _minimum_degree(n, row, column)
        i, j = position[row], position[column]
        ordered = BlockPattern.of_pairs(n, i, j)
        first, rows = _fill(ordered.first, ordered.row)
        factor = BlockPattern(first=first, row=rows)
        keys = factor.column_of_block() * n + factor.row
        return Elimination(
            position=position,
            factor=factor,
            source=np.searchsorted(keys, np.minimum(i, j) * n + np.maximum(i, j)).astype(np.int64),
            transposed=i < j,
        )


def _minimum_degree(n: int, row: Ints, column: Ints) -> Ints:
    """Order in which each column (n,) is eliminated; SuperLU is asked by factorising a matrix with these places."""
    below = row != column
    ones = np.ones(int(below.sum()))
    lower = scipy.sparse.csc_matrix((ones, (row[below], column[below])), shape=(n, n))
    degree = np.asarray((lower + lower.T).sum(axis=0)).ravel()
    dominant = scipy.sparse.diags(degree + 1.0) - lower - lower.T
    found = scipy.sparse.linalg.splu(
        dominant.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
    )
    return np.asarray(found.perm_c, dtype=np.int64)


@njit(cache=True)
def _fill(first: Any, row: Any) -> Any:
    """The factor's pattern, from that of the matrix in elimination order."""
    n = len(first) - 1
    mark = np.full(n, -1, np.int64)
    child, sibling = np.full(n, -1, np.int64), np.full(n, -1, np.int64)
    out_first = np.zeros(n + 1, np.int64)
    out = np.empty(max(4 * len(row), 16), np.int64)
    count = 0
    for j in range(n):
        begin = count
        mark[j] = j
        if count + n - j > len(out):
            grown = np.empty(2 * len(out) + n, np.int64)
            grown[:count] = out[:count]
            out = grown
        out[count] = j
        count += 1
        for s in range(first[j], first[j + 1]):
            if mark[row[s]] != j:
                mark[row[s]] = j
                out[count] = row[s]
                count += 1
        c = child[j]
        while c >= 0:
            for s in range(out_first[c], out_first[c + 1]):
                if out[s] > j and mark[out[s]] != j:
                    mark[out[s]] = j
                    out[count] = out[s]
                    count += 1
            c = sibling[c]
        out[begin:count].sort()
        out_first[j + 1] = count
        if count > begin + 1:
            parent = out[begin + 1]
            sibling[j] = child[parent]
            child[parent] = j
    return out_first, out[:count].copy()


@njit(cache=True, forceinline=True, error_model="numpy", fastmath={"contract", "reassoc", "arcp"})
def _subtract_product(out: Any, x: Any, y: Any) -> None:
    """Subtract x y from a block; written out by rows of y, that are next to one another in memory."""
    for a in range(BLOCK):
        x0, x1, x2, x3, x4, x5 = x[a, 0], x[a, 1], x[a, 2], x[a, 3], x[a, 4], x[a, 5]
        for b in range(BLOCK):
            out[a, b] -= x0 * y[0, b] + x1 * y[1, b] + x2 * y[2, b] + x3 * y[3, b] + x4 * y[4, b] + x5 * y[5, b]


@njit(cache=True, error_model="numpy", fastmath={"contract", "reassoc", "arcp"})
def _factorise(first: Any, row: Any, l: Any) -> bool:  # noqa: E741
    """Turn blocks of A in l (blocks, 6, 6) into those of L; False where A is not positive definite."""
    n = len(first) - 1
    place = np.empty(n, np.int64)  # of a row within the current column
    begin = np.empty(n, np.int64)  # of a column: its first block that is not used yet
    head, following = np.full(n, -1, np.int64), np.full(n, -1, np.int64)  # columns whose next row is j, as a list
    of_row = np.empty((BLOCK, BLOCK))
    for j in range(n):
        for s in range(first[j], first[j + 1]):
            place[row[s]] = s
        k = head[j]
        while k >= 0:
            after = following[k]
            p = begin[k]
            for b in range(BLOCK):
                for c in range(BLOCK):
                    of_row[c, b] = l[p, b, c]
            for s in range(p, first[k + 1]):
                _subtract_product(l[place[row[s]]], l[s], of_row)
            begin[k] = p + 1
            if p + 1 < first[k + 1]:
                following[k] = head[row[p + 1]]
                head[row[p + 1]] = k
            k = after
        d = first[j]
        for a in range(BLOCK):
            for b in range(a + 1):
                v = l[d, a, b]
                for c in range(b):
                    v -= l[d, a, c] * l[d, b, c]
                if a == b:
                    if not v > 0.0:
                        return False
                    l[d, a, a] = np.sqrt(v)
                else:
                    l[d, a, b] = v / l[d, b, b]
                    l[d, b, a] = 0.0
        for s in range(d + 1, first[j + 1]):
            for a in range(BLOCK):
                for b in range(BLOCK):
                    v = l[s, a, b]
                    for c in range(b):
                        v -= l[s, a, c] * l[d, b, c]
                    l[s, a, b] = v / l[d, b, b]
        begin[j] = d + 1
        if d + 1 < first[j + 1]:
            following[j] = head[row[d + 1]]
            head[row[d + 1]] = j
    return True


@njit(cache=True, error_model="numpy", fastmath={"contract", "reassoc", "arcp"})
def _forward(first: Any, row: Any, l: Any, x: Any) -> None:  # noqa: E741
    """Turn right-hand sides x (columns, 6, m) into L^-1 x.

    Of those that are zero down to a column it does nothing there: the cameras of one scene of a map, of which most
    units know nothing.
    """
    n, m = len(first) - 1, x.shape[2]
    begins, ends = np.empty(m + 1, np.int64), np.empty(m + 1, np.int64)  # runs of right-hand sides that are not zero
    for j in range(n):
        d, runs = first[j], 0
        for lo in range(0, m, RIGHT_HAND_SIDES):
            hi, some = min(lo + RIGHT_HAND_SIDES, m), False
            for a in range(BLOCK):
                for q in range(lo, hi):
                    some |= x[j, a, q] != 0.0
            if some and runs > 0 and ends[runs - 1] == lo:
                ends[runs - 1] = hi
            elif some:
                begins[runs], ends[runs] = lo, hi
                runs += 1
        for r in range(runs):
            lo, hi = begins[r], ends[r]
            for a in range(BLOCK):
                for b in range(a):
                    for q in range(lo, hi):
                        x[j, a, q] -= l[d, a, b] * x[j, b, q]
                for q in range(lo, hi):
                    x[j, a, q] /= l[d, a, a]
            for s in range(d + 1, first[j + 1]):
                for a in range(BLOCK):
                    for b in range(BLOCK):
                        for q in range(lo, hi):
                            x[row[s], a, q] -= l[s, a, b] * x[j, b, q]


@njit(cache=True, error_model="numpy", fastmath={"contract", "reassoc", "arcp"})
def _backward(first: Any, row: Any, l: Any, x: Any) -> None:  # noqa: E741
    """Turn right-hand sides x (columns, 6, m) into L^-T x."""
    n, m = len(first) - 1, x.shape[2]
    for j in range(n - 1, -1, -1):
        d = first[j]
        for s in range(d + 1, first[j + 1]):
            for a in range(BLOCK):
                for b in range(BLOCK):
                    for q in range(m):
                        x[j, b, q] -= l[s, a, b] * x[row[s], a, q]
        for a in range(BLOCK - 1, -1, -1):
            for b in range(a + 1, BLOCK):
                for q in range(m):
                    x[j, a, q] -= l[d, b, a] * x[j, b, q]
            for q in range(m):
                x[j, a, q] /= l[d, a, a]


@njit(cache=True, error_model="numpy", fastmath={"contract", "reassoc", "arcp"})
def _selected_inverse(first: Any, row: Any, l: Any, z: Any) -> None:  # noqa: E741
    """The inverse's blocks z (blocks, 6, 6) in the places of the factor l."""
    n = len(first) - 1
    place = np.zeros(n, np.int64)  # of a row within the current column; of other rows anything
    inverse, transposed = np.zeros((BLOCK, BLOCK)), np.empty((BLOCK, BLOCK))
    for j in range(n - 1, -1, -1):
        d, end = first[j], first[j + 1]
        inverse[:] = 0.0
        for b in range(BLOCK):
            inverse[b, b] = 1.0 / l[d, b, b]
            for a in range(b + 1, BLOCK):
                v = 0.0
                for c in range(b, a):
                    v -= l[d, a, c] * inverse[c, b]
                inverse[a, b] = v / l[d, a, a]
        m = end - d - 1
        g = np.zeros((m, BLOCK, BLOCK))  # L_kj L_jj^-1
        for s in range(m):
            for a in range(BLOCK):
                for b in range(BLOCK):
                    for c in range(b, BLOCK):
                        g[s, a, b] += l[d + 1 + s, a, c] * inverse[c, b]
            place[row[d + 1 + s]] = s
        z[d:end] = 0.0
        for s in range(m):
            # Z_ik for all i, k below j is in column min(i, k), as those rows are all coupled once j is eliminated.
            k = row[d + 1 + s]
            for t in range(first[k], first[k + 1]):
                i = row[t]
                r = place[i]
                if r >= m or row[d + 1 + r] != i:
                    continue
                _subtract_product(z[d + 1 + r], z[t], g[s])
                if r != s:
                    for a in range(BLOCK):
                        for c in range(BLOCK):
                            transposed[a, c] = z[t, c, a]
                    _subtract_product(z[d + 1 + s], transposed, g[r])
        for a in range(BLOCK):
            for b in range(BLOCK):
                for c in range(max(a, b), BLOCK):
                    z[d, a, b] += inverse[c, a] * inverse[c, b]
                for s in range(m):
                    for c in range(BLOCK):
                        z[d, a, b] -= z[d + 1 + s, c, a] * g[s, c, b]


@dataclass(frozen=True, kw_only=True)
class BlockFactor:
    """The factor of one positive definite matrix."""

    elimination: Elimination
    blocks: Floats  # (factor's blocks, 6, 6)

    @staticmethod
    def from_blocks(elimination: Elimination, blocks: Floats) -> BlockFactor | None:
        """Factorise the matrix with these blocks (blocks, 6, 6) of its pattern; None where it is not positive definite.

        Diagonal blocks are taken by their lower triangle.
        """
        factor = np.zeros((len(elimination.factor.row), BLOCK, BLOCK))
        factor[elimination.source] = np.where(elimination.transposed[:, None, None], np.swapaxes(blocks, 1, 2), blocks)
        if not _factorise(elimination.factor.first, elimination.factor.row, factor):
            return None
        return BlockFactor(elimination=elimination, blocks=factor)

    def solve(self, right: Floats) -> Floats:
        """Solutions for right-hand sides (6 columns,) or (6 columns, m)."""
        return self.backward(self.forward(right))

    def forward(self, right: Floats) -> Floats:
        """L^-1 of right-hand sides (6 columns,) or (6 columns, m), in the order of elimination."""
        position, factor = self.elimination.position, self.elimination.factor
        x = np.empty((len(position), BLOCK, right.size // max(BLOCK * len(position), 1)))
        x[position] = right.reshape(x.shape)
        _forward(factor.first, factor.row, self.blocks, x)
        return x.reshape(right.shape)

    def backward(self, half: Floats) -> Floats:
        """Solutions of what `forward` has made of right-hand sides."""
        position, factor = self.elimination.position, self.elimination.factor
        x = half.reshape(len(position), BLOCK, half.size // max(BLOCK * len(position), 1)).copy()
        _backward(factor.first, factor.row, self.blocks, x)
        return x[position].reshape(half.shape)

    def pivots(self) -> Floats:
        """Pivot of every diagonal entry (columns, 6)."""
        on = self.elimination.factor.first[:-1][self.elimination.position]
        result: Floats = np.diagonal(self.blocks[on], axis1=1, axis2=2) ** 2
        return result

    def inverse_diagonal(self) -> Floats:
        """The inverse's diagonal blocks (columns, 6, 6)."""
        z = np.empty_like(self.blocks)
        _selected_inverse(self.elimination.factor.first, self.elimination.factor.row, self.blocks, z)
        result: Floats = z[self.elimination.factor.first[:-1][self.elimination.position]]
        return result
