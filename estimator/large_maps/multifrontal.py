"""Sparse Cholesky factorisation by small dense fronts (multifrontal method).

A sparse symmetric positive definite H is factorised node by node (`eliminate`),
children first [1]_.  A node eliminates its unknowns p from the front, the dense sum of
its own entries of H and of its children's updates; r are the other unknowns of the
front::

    front = [H_pp H_pr; · H_rr],   L Lᵀ = H_pp,   X = L⁻¹ H_pr,   update = H_rr − Xᵀ X

The update is the Schur complement of H_pp, and is added to the parent's front.
`InformationMatrix` holds the sparse H of a map of landmarks.

References
----------
.. [1] I. Duff, J. Reid, The multifrontal solution of indefinite sparse symmetric
   linear equations, ACM TOMS 9(3), 1983.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import lapack
from scipy.sparse import bsr_array, csc_array

from ...arrays import Array, BoolArray, IntArray
from ...jit import jit
from ..guards import saved_states


class Node(NamedTuple):
    """One eliminated front."""

    own: IntArray  # p, the unknowns that the node eliminates
    rest: IntArray  # r, the unknowns that the front links with them
    lower: Array  # L, shape (p, p)
    response: Array  # X, shape (p, r)

    @property
    def nbytes(self) -> int:
        """Memory of the arrays [bytes]."""
        return sum(array.nbytes for array in self)


def eliminate(top: Array, remainder: Array, own: IntArray, rest: IntArray) -> Node:
    """Eliminate the first unknowns of a front, which becomes the update.

    Parameters
    ----------
    top : ndarray, shape (p, p + r)
        Upper triangle of [H_pp H_pr].
    remainder : ndarray, shape (r, r)
        Upper triangle of H_rr; then that of the update.
    own, rest : ndarray
        The unknowns of a :class:`Node`.

    Raises
    ------
    numpy.linalg.LinAlgError
        If H_pp is not positive definite.
    """
    from scipy.linalg.blas import dsyrk, dtrsm  # noqa: PLC0415 (slow to import)

    p = len(own)
    lower = _cholesky(top[:, :p].T)
    response = top[:, p:].copy()
    if response.size:
        # The transposes are contiguous in Fortran order: nothing is copied.
        dtrsm(1.0, lower.T, response.T, side=1, overwrite_b=1)
        dsyrk(-1.0, response.T, 1.0, remainder.T, lower=1, overwrite_c=1)
    return Node(own, rest, lower, response)


def _cholesky(matrix: Array) -> Array:
    """Factorise the lower triangle of a matrix."""
    try:
        return np.linalg.cholesky(matrix).astype(np.float64, copy=False)
    except np.linalg.LinAlgError as error:
        raise np.linalg.LinAlgError(
            "the information matrix is not positive definite"
        ) from error


def substitute_forward(nodes: Sequence[Node], values: Array) -> None:
    """Replace b by y, with L y = b, in place.

    Unknowns that no node eliminates receive b_r − H_rp H_pp⁻¹ b_p.

    Parameters
    ----------
    nodes : sequence of Node
        Children first.
    values : ndarray, shape (N,) or (N, k)
    """
    for node in nodes:
        right = values[node.own]
        if not right.any():
            continue
        y = solved(node.lower, right)
        values[node.own] = y
        values[node.rest] -= node.response.T @ y


def substitute_back(nodes: Sequence[Node], values: Array) -> None:
    """Replace y by x, with Lᵀ x = y, in place; unknowns of no node are given."""
    for node in reversed(nodes):
        right = values[node.own] - node.response @ values[node.rest]
        values[node.own] = solved(node.lower, right, transposed=True)


def marginal_covariance(
    nodes: Sequence[Node], rows: csc_array
) -> tuple[Array, dict[int, Array]]:
    """Return A H⁻¹ Aᵀ = Yᵀ Y, with L Y = Aᵀ, for a sparse A.

    The function visits only nodes that A touches and their ancestors.  It keeps a row
    of Y from the first node that changes it until its own node is done.

    Parameters
    ----------
    nodes : sequence of Node
        Children first.
    rows : csc_array, shape (v, N)
        A.

    Returns
    -------
    covariance : ndarray, shape (v, v)
    remainder : dict of int to ndarray, shape (v,)
        Rows of −H_rp H_pp⁻¹ Aᵀ, by unknowns r that no node eliminates.  Rows that are
        not listed are zero.
    """
    size = rows.shape[0]
    starts = rows.indptr.tolist()
    changed = np.diff(rows.indptr) > 0
    live: dict[int, Array] = {}
    total = np.zeros((size, size))
    for node in nodes:
        if not changed[node.own].any():
            continue
        own = node.own.tolist()
        right = np.zeros((len(own), size))
        for place, unknown in enumerate(own):
            here = slice(starts[unknown], starts[unknown + 1])
            right[place, rows.indices[here]] = rows.data[here]
            if unknown in live:
                right[place] += live.pop(unknown)
        used = np.flatnonzero(right.any(axis=0))
        Y = solved(node.lower, right[:, used])
        total[used[:, None], used] += Y.T @ Y
        changed[node.rest] = True
        changes = node.response.T @ Y
        for unknown, change in zip(node.rest.tolist(), changes, strict=True):
            if unknown not in live:
                live[unknown] = np.zeros(size)
            live[unknown][used] -= change
    return total, live


class GrowingCovariance:
    """Covariance of variables that are added one group after another.

    The caller numbers the variables. The row of a variable is its number. The columns
    are in the order in which the variables are added, so products read whole blocks.

    Parameters
    ----------
    size : int
        Number of variables.
    """

    def __init__(self, size: int) -> None:
        self.matrix = np.empty((size, size))
        #: The column of each variable.
        self.places = np.empty(size, dtype=np.int64)
        self._added = np.empty(size, dtype=np.int64)
        self._count = 0

    def append(self, new: IntArray, at: IntArray, T: Array, noise: Array) -> None:
        """Add variables y = T x + w.

        Parameters
        ----------
        new, at : ndarray, shapes (p,) and (r,)
            Numbers of y, and of x, which have been added before.
        T : ndarray, shape (p, r)
        noise : ndarray, shape (p, p)
            Covariance of w.
        """
        done, own = self._count, slice(self._count, self._count + len(new))
        rows = T @ self.matrix[at, :done]
        P = noise + rows[:, self.places[at]] @ T.T
        self.matrix[new, :done] = rows
        self.matrix[self._added[:done], own] = rows.T
        self.matrix[new, own] = (P + P.T) / 2
        self.places[new] = np.arange(own.start, own.stop)
        self._added[own], self._count = new, own.stop


def inverse(nodes: Sequence[Node], rows: IntArray, size: int) -> GrowingCovariance:
    """Return H⁻¹ from nodes that eliminate all unknowns, the last node first.

    With T = L⁻ᵀ X, the rows of a node follow from those of its rest, for all unknowns o
    of the nodes after it::

        Σ_po = −T Σ_ro,   Σ_pp = (L Lᵀ)⁻¹ + T Σ_rr Tᵀ

    Parameters
    ----------
    nodes : sequence of Node
        Children first.
    rows : ndarray, shape (N,)
        The row of each unknown.
    size : int
        Number of unknowns plus number of variables that the caller will add.
    """
    found = GrowingCovariance(size)
    for node in reversed(nodes):
        root = solved(node.lower, np.eye(len(node.own)))
        T = solved(node.lower, node.response, transposed=True)
        found.append(rows[node.own], rows[node.rest], -T, root.T @ root)
    return found


def solved(lower: Array, right: Array, *, transposed: bool = False) -> Array:
    """Return L⁻¹ b, or L⁻ᵀ b."""
    if not right.size:
        return right.copy()
    # solve_triangular calls the same routine, at several times the cost of a small L.
    found, _ = lapack.dtrtrs(lower.T, right, lower=0, trans=not transposed)
    return np.asarray(found)


@jit
def add_update(top: Array, rest: Array, at: IntArray, update: Array) -> None:
    """Add a child's update (r, r) to the rows and columns ``at`` (r,) of a front.

    The front is ``top`` (p, n), its first rows, above ``rest`` (n - p, n - p), the
    other rows without their first columns.  Only upper triangles are read and written.
    """
    p = len(top)
    for i in range(len(at)):
        for j in range(i, len(at)):
            row, column = at[i], at[j]
            if row > column:
                row, column = column, row
            if row < p:
                top[row, column] += update[i, j]
            else:
                rest[row - p, column - p] += update[i, j]


_ARRAY_OBJECTS = 220  # memory of two empty array objects [bytes]


class InformationMatrix:
    """Symmetric sparse matrix of 2 × 2 blocks, one row of blocks for each landmark.

    Row i holds the slots of the landmarks linked with landmark i, including i itself,
    and the corresponding blocks.  Rows are replaced one by one, so that the cost of
    changing a few landmarks does not depend on the size of the map.
    """

    def __init__(self) -> None:
        self._links: list[IntArray] = []
        self._blocks: list[Array] = []
        self._place = np.zeros(0, dtype=np.int64)  # scratch, see _found

    def __len__(self) -> int:
        return len(self._links)

    @property
    def nbytes(self) -> int:
        """Memory of links and blocks [bytes]."""
        return sum(
            links.nbytes + blocks.nbytes + _ARRAY_OBJECTS
            for links, blocks in zip(self._links, self._blocks, strict=True)
        )

    @property
    def block_count(self) -> int:
        """Number of nonzero 2 × 2 blocks."""
        return sum(map(len, self._links))

    def grow(self, count: int) -> None:
        """Append empty rows until the matrix has ``count`` rows."""
        for _ in range(count - len(self)):
            self._links.append(np.empty(0, dtype=np.int64))
            self._blocks.append(np.empty((0, 2, 2)))
        if len(self._place) < count:
            self._place = np.zeros(2 * count, dtype=np.int64)

    def dense(self, slots: IntArray) -> Array:
        """Return the rows and columns of a few landmarks, shape (2k, 2k)."""
        return np.asarray(self.submatrix(slots, slots).toarray())

    def submatrix(self, rows: IntArray, columns: IntArray) -> bsr_array:
        """Return the blocks of some rows and columns, shape (2r, 2c), sparse."""
        shape = (2 * len(rows), 2 * len(columns))
        if not (len(rows) and len(columns)):
            return bsr_array(shape)
        counts, links, blocks = self.rows(rows)
        place, wanted = self._found(columns, links)
        owner = np.repeat(np.arange(len(rows)), counts)[wanted]
        starts = np.searchsorted(owner, np.arange(len(rows) + 1))
        return bsr_array((blocks[wanted], place[wanted], starts), shape=shape)

    def replace(self, slots: IntArray, dense: Array) -> None:
        """Replace the rows and columns of a few landmarks, omitting zero blocks."""
        k = len(slots)
        blocks = dense.reshape(k, 2, k, 2).transpose(0, 2, 1, 3)
        linked = np.asarray(blocks.any(axis=(2, 3)))
        for i, slot in enumerate(slots.tolist()):
            links = self._links[slot]
            kept = ~self._found(slots, links)[1]
            new = linked[i]
            self._links[slot] = np.concatenate([links[kept], slots[new]])
            self._blocks[slot] = np.concatenate(
                [self._blocks[slot][kept], blocks[i, new]]
            )

    def _found(self, slots: IntArray, links: IntArray) -> tuple[IntArray, BoolArray]:
        """Return the places of links among slots, and which of them are among these.

        The scratch array needs no clearing: a place that an earlier call has left
        there does not lead to the link.
        """
        self._place[slots] = np.arange(len(slots))
        place = self._place[links]
        return place, slots.take(place, mode="clip") == links

    def links(self, slot: int) -> IntArray:
        """Return the landmarks linked with a landmark, including itself."""
        return self._links[slot]

    def is_filled(self, slots: IntArray) -> BoolArray:
        """Return which landmarks have a nonempty row, shape (k,)."""
        return np.array([len(self._links[i]) > 0 for i in slots.tolist()], dtype=bool)

    def neighbours(self, slots: IntArray) -> IntArray:
        """Return all landmarks linked with the given ones, without these."""
        return np.setdiff1d(self.rows(slots)[1], slots)

    def rows(self, slots: IntArray) -> tuple[IntArray, IntArray, Array]:
        """Return row lengths, links and blocks of landmarks, row after row."""
        rows: Sequence[int] = slots.tolist()
        if not rows:
            nothing = np.empty(0, dtype=np.int64)
            return nothing, nothing, np.empty((0, 2, 2))
        links = [self._links[i] for i in rows]
        counts = np.array([len(each) for each in links], dtype=np.int64)
        blocks = np.concatenate([self._blocks[i] for i in rows])
        return counts, np.concatenate(links), blocks

    def state_dict(self) -> dict[str, Array | IntArray]:
        """Return copies of all rows, one after another."""
        counts, links, blocks = self.rows(np.arange(len(self)))
        return {"counts": counts, "links": links, "blocks": blocks}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Replace all rows by those of a :meth:`state_dict`.

        Raises
        ------
        ValueError
            If the arrays do not fit together; the matrix is then unchanged.
        """
        saved = saved_states.read(state, ROWS, "matrix_")
        counts, links, blocks = (saved[key] for key in ROWS)
        _check_rows(counts, links, blocks)
        ends = np.cumsum(counts)[:-1]
        self._links = [part.copy() for part in np.split(links, ends)][: len(counts)]
        self._blocks = [part.copy() for part in np.split(blocks, ends)][: len(counts)]
        self._place = np.zeros(2 * len(counts), dtype=np.int64)


def _places(
    name: str, value: Any, shape: tuple[int, ...], least: int | None = None
) -> IntArray:
    """Return whole numbers, which may be given as floats."""
    values = saved_states.array(name, value, shape)
    if (np.abs(values) > 2.0**53).any():
        raise ValueError(f"state[{name!r}] must be whole numbers <= 2⁵³")
    return saved_states.whole_numbers(name, values.astype(np.int64), shape, least)


PLACES = saved_states.Kind(np.int64, _places)
COUNTS = saved_states.Kind(np.int64, partial(_places, least=0))
ROWS: saved_states.Table = {
    "counts": (COUNTS, "m"),
    "links": (COUNTS, -1),
    "blocks": (saved_states.NUMBERS, -1, 2, 2),
}


def _check_rows(counts: IntArray, links: IntArray, blocks: Array) -> None:
    if counts.sum() != len(links) or blocks.shape != (len(links), 2, 2):
        raise ValueError(
            f"state['matrix_links'] and state['matrix_blocks'] must have "
            f"{counts.sum()} rows, got {len(links)} and {blocks.shape}"
        )
    rows = np.repeat(np.arange(len(counts)), counts)
    order, mirrored = np.lexsort((links, rows)), np.lexsort((rows, links))
    same = np.array_equal(rows[order], links[mirrored]) and np.array_equal(
        links[order], rows[mirrored]
    )
    if not same or not np.allclose(
        blocks[order], blocks[mirrored].transpose(0, 2, 1), rtol=1e-9, atol=0
    ):
        raise ValueError(
            "state['matrix_links'] with state['matrix_blocks'] must be symmetric"
        )


AT_ONCE = 128  # rows that are copied at a time


def symmetric(covariance: Array) -> Array:
    """Copy the lower half into the upper one, in place."""
    n = len(covariance)
    for first in range(0, n, AT_ONCE):
        last = min(first + AT_ONCE, n)
        own = covariance[first:last, first:last]
        own[:] = np.tril(own) + np.tril(own, -1).T
        covariance[first:last, last:] = covariance[last:, first:last].T
    return covariance


def pairs(places: Sequence[int] | IntArray) -> IntArray:
    """Return the two columns of each landmark, in turn: 2 p, 2 p + 1.

    Examples
    --------
    >>> pairs([0, 3])
    array([0, 1, 6, 7])
    """
    return (2 * np.asarray(places, dtype=np.int64)[:, None] + np.arange(2)).ravel()
