"""Sparse Cholesky factorisation by small dense fronts (multifrontal method).

A sparse symmetric positive definite H is factorised node by node, children first
[1]_.  A node eliminates its unknowns p from the front, the dense sum of its own
entries of H and of its children's updates; r are the other unknowns of the front::

    front = [H_pp H_pr; · H_rr],   L Lᵀ = H_pp,   X = L⁻¹ H_pr,   update = H_rr − Xᵀ X

The update is the Schur complement of H_pp, and is added to the parent's front.

References
----------
.. [1] I. Duff, J. Reid, The multifrontal solution of indefinite sparse symmetric
   linear equations, ACM TOMS 9(3), 1983.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.linalg import lapack
from scipy.sparse import csc_array

from ....arrays import Array, IntArray


class Node(NamedTuple):
    """One eliminated front."""

    own: IntArray
    """p, the unknowns that the node eliminates."""
    rest: IntArray
    """r, the unknowns that the front links with them."""
    lower: Array
    """L, shape (p, p)."""
    response: Array
    """X, shape (p, r)."""

    @property
    def nbytes(self) -> int:
        """Memory of the arrays [bytes]."""
        return sum(array.nbytes for array in self)


def eliminate(front: Array, own: IntArray, rest: IntArray) -> tuple[Node, Array]:
    """Eliminate the first unknowns of a front.

    Parameters
    ----------
    front : ndarray, shape (p + r, p + r + k)
        Rows and columns of the unknowns ``own``, then ``rest``; then k right sides.

    Returns
    -------
    node : Node
    solved : ndarray, shape (p, r + k)
        X, then L⁻¹ b_p of the right sides b; by columns in memory.

    Raises
    ------
    numpy.linalg.LinAlgError
        If H_pp is not positive definite.
    """
    p, r = len(own), len(rest)
    lower = _cholesky(front[:p, :p])
    solved = _solve(lower, front[:p, p:])
    response = np.ascontiguousarray(solved[:, :r])
    return Node(own, rest, lower, response), solved


def eliminate_in_place(
    top: Array, remainder: Array, own: IntArray, rest: IntArray
) -> Node:
    """Eliminate the first unknowns of a front, which becomes the update.

    This takes half the work of :func:`eliminate` followed by the product Xᵀ X.

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
        solved = _solve(node.lower, right)
        values[node.own] = solved
        values[node.rest] -= node.response.T @ solved


def substitute_back(nodes: Sequence[Node], values: Array) -> None:
    """Replace y by x, with Lᵀ x = y, in place; unknowns of no node are given."""
    for node in reversed(nodes):
        right = values[node.own] - node.response @ values[node.rest]
        values[node.own] = _solve(node.lower, right, transposed=True)


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
        Y = _solve(node.lower, right[:, used])
        total[used[:, None], used] += Y.T @ Y
        changed[node.rest] = True
        for unknown, change in zip(
            node.rest.tolist(), node.response.T @ Y, strict=True
        ):
            if unknown not in live:
                live[unknown] = np.zeros(size)
            live[unknown][used] -= change
    return total, live


def _solve(lower: Array, right: Array, *, transposed: bool = False) -> Array:
    """Return L⁻¹ b, or L⁻ᵀ b."""
    if not right.size:
        return right.copy()
    # solve_triangular calls the same routine, at several times the cost of a small L.
    solved, _ = lapack.dtrtrs(lower.T, right, lower=0, trans=not transposed)
    return np.asarray(solved)
