"""A large sparse information matrix over landmarks, stored row by row."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from scipy.sparse import bsr_array

from ....arrays import Array, BoolArray, IntArray
from ...support import saved_states

_ARRAY_OBJECTS = 220
"""Memory of two empty array objects [bytes]."""


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

    def checkpoint(self) -> Callable[[], None]:
        """Return what takes back later changes; rows are replaced, never changed."""
        links, blocks = list(self._links), list(self._blocks)

        def undo() -> None:
            self._links, self._blocks = list(links), list(blocks)

        return undo

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

    def diagonal(self, slots: IntArray) -> Array:
        """Return the diagonal blocks of landmarks, shape (k, 2, 2)."""
        counts, links, blocks = self.rows(slots)
        return np.asarray(blocks[links == np.repeat(slots, counts)])

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

    def nearest_by_links(self, slots: IntArray, count: int) -> IntArray:
        """Return up to ``count`` other landmarks, fewest links away first."""
        found: list[IntArray] = []
        missing, front = count, slots
        is_found = np.zeros(len(self), dtype=bool)
        is_found[slots] = True
        while missing > 0 and len(front):
            front = np.unique(self.rows(front)[1])
            front = front[~is_found[front]][:missing]
            is_found[front] = True
            found.append(front)
            missing -= len(front)
        return np.concatenate([*found, np.empty(0, dtype=np.int64)])

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
        if not len(slots):
            return slots
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
        counts, links = (
            saved_states.whole_numbers(f"matrix_{key}", state[key], (-1,), 0)
            for key in ("counts", "links")
        )
        blocks = saved_states.array("matrix_blocks", state["blocks"], (-1, 2, 2))
        _check_rows(counts, links, blocks)
        ends = np.cumsum(counts)[:-1]
        self._links = [part.copy() for part in np.split(links, ends)][: len(counts)]
        self._blocks = [part.copy() for part in np.split(blocks, ends)][: len(counts)]
        self._place = np.zeros(2 * len(counts), dtype=np.int64)


def _check_rows(counts: IntArray, links: IntArray, blocks: Array) -> None:
    if counts.sum() != len(links) or blocks.shape != (len(links), 2, 2):
        raise ValueError(
            f"state['matrix_links'] and state['matrix_blocks'] must have "
            f"{counts.sum()} rows, got {len(links)} and {blocks.shape}"
        )
    if len(links) and not 0 <= links.min() <= links.max() < len(counts):
        raise ValueError(
            f"state['matrix_links'] must lie in [0, {len(counts)}), got "
            f"{links.min()} to {links.max()}"
        )
    rows = np.repeat(np.arange(len(counts)), counts)
    order, mirrored = np.lexsort((links, rows)), np.lexsort((rows, links))
    same = np.array_equal(rows[order], links[mirrored]) and np.array_equal(
        links[order], rows[mirrored]
    )
    if not same or not np.allclose(
        blocks[order], blocks[mirrored].transpose(0, 2, 1), rtol=1e-9, atol=0
    ):
        raise ValueError("state['matrix_blocks'] must be a symmetric matrix")
