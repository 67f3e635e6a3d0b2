"""A change of a covariance that is applied later, and its saved form."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from ....arrays import Array, IntArray
from ...support import saved_states

_CHUNK = 128  # rows that are changed at a time


class Downdate(NamedTuple):
    """A change not yet applied to the stored covariance: P ← P − W diag(s) Wᵀ."""

    root: Array  # W, shape (width, rank)
    signs: Array  # s, shape (rank,), each 1 or -1


def saved_downdates(state: Mapping[str, Any], width: int) -> list[Downdate]:
    """Return the pending downdates of a state, or refuse them."""
    signs = saved_states.array("far_pending_signs", state["pending_signs"], (-1,))
    root = saved_states.array(
        "far_pending_root", state["pending_root"], (width, len(signs))
    )
    shapes = saved_states.whole_numbers(
        "far_pending_shapes", state["pending_shapes"], (-1, 2), 0
    )
    if shapes[:, 1].sum() != len(signs) or (shapes[:, 0] > width).any():
        raise ValueError(
            f"state['far_pending_shapes'] must add up to a rank of {len(signs)} in "
            f"{width} rows, got {shapes.tolist()}"
        )
    if not np.isin(signs, (-1, 1)).all():
        raise ValueError("state['far_pending_signs'] must be 1 or -1")
    ends = np.cumsum(shapes[:, 1]).tolist()
    return [
        Downdate(root[:rows, end - rank : end].copy(), signs[end - rank : end].copy())
        for (rows, rank), end in zip(shapes.tolist(), ends, strict=True)
    ]


def rows_of(root: Array, columns: IntArray) -> Array:
    """Return rows of W; columns newer than W have zeros."""
    if len(root) > columns.max(initial=0):
        chosen: Array = root[columns]
        return chosen
    rows = np.zeros((len(columns), root.shape[1]))
    inside = columns < len(root)
    rows[inside] = root[columns[inside]]
    return rows


def subtract(covariance: Array, root: Array, signs: Array) -> None:
    """P ← P − W diag(s) Wᵀ in place, a few rows at a time, without a second matrix."""
    for first in range(0, len(covariance), _CHUNK):
        own = slice(first, first + _CHUNK)
        covariance[own] -= (root[own] * signs) @ root.T


def symmetric(covariance: Array) -> Array:
    """Copy the lower half into the upper one, in place."""
    n = len(covariance)
    for first in range(0, n, _CHUNK):
        last = min(first + _CHUNK, n)
        own = covariance[first:last, first:last]
        own[:] = np.tril(own) + np.tril(own, -1).T
        covariance[first:last, last:] = covariance[last:, first:last].T
    return covariance
