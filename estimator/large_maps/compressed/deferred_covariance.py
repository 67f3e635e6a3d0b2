"""Covariance between the landmarks of a large map, with deferred downdates."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from ....arrays import Array, IntArray
from ...support import saved_states
from ...support.memory_limit import refuse_beyond_memory
from ...support.undo import Undo, contents
from .downdate import Downdate, rows_of, saved_downdates, symmetric
from .row_exchange import read_columns, read_marginal, write_columns

# Rows of one block: 64 landmarks.
BLOCK = 128
# Smallest rank to apply; smaller downdates wait: memory limits thin products.
WORTHWHILE = 40
# Larger pending ranks must not wait for the exchange of rows.
LARGEST_BACKLOG = 400
_EVERY_ROW = np.arange(BLOCK)


class DeferredCovariance:
    """Lower half of a growing covariance, in blocks of rows, with pending downdates.

    Block k holds rows 128 k to 128 (k + 1) of P, as far as the diagonal.  This takes
    half the memory of a square and grows without a copy.  Every block is contiguous, so
    that BLAS changes it in place::

        P = stored − W diag(s) Wᵀ

    W is small.  Reading subtracts its product, and :meth:`work` applies it to one block
    after the other.  A local map may read the rows of its landmarks and update its
    copy; the stored rows of these landmarks are invalid until it puts them back.  Rows
    are read and put block by block, between which :meth:`work` must not be called.
    """

    def __init__(self) -> None:
        self._blocks: list[Array] = []
        self._pending: list[Downdate] = []
        self._under_way = False  # whether the first downdate is being applied
        self._done = 0  # number of blocks to which it has been applied
        self._credit = 0.0  # multiplications granted and not yet used

    @property
    def width(self) -> int:
        """Number of rows and columns of the blocks."""
        return BLOCK * len(self._blocks)

    @property
    def pending_rank(self) -> int:
        """Rank of all pending downdates."""
        return sum(len(downdate.signs) for downdate in self._pending)

    @property
    def is_up_to_date(self) -> bool:
        """Whether the pending downdates may wait longer."""
        return self.pending_rank <= LARGEST_BACKLOG

    @property
    def nbytes(self) -> int:
        """Size of blocks and pending downdates [bytes]."""
        roots = [downdate.root for downdate in self._pending]
        return sum(array.nbytes for array in self._blocks + roots)

    def make_room(self, columns: int) -> None:
        """Append blocks of zeros until there are at least this many columns.

        Raises
        ------
        MemoryError
            If memory does not suffice; nothing is appended.
        """
        if self.width >= columns:
            return
        refuse_beyond_memory(
            f"half a covariance of {columns // 2} landmarks",
            stored_bytes(columns // 2),
            "'submaps' and 'sparse_information' take less",
            held=stored_bytes(self.width // 2),
        )
        while self.width < columns:
            self._blocks.append(np.zeros((BLOCK, self.width + BLOCK)))

    def read(self, blocks: range, columns: IntArray, rows: Array) -> None:
        """Fill the part of rows (c, width) of P that some blocks store.

        Pending downdates are subtracted; the columns (c,) are ascending.
        """
        bounds = _bounds(columns, blocks)
        for k, start, end in zip(blocks, bounds, bounds[1:], strict=False):
            block, first = self._blocks[k], k * BLOCK
            if end > start:
                rows[start:end, : first + BLOCK] = block[columns[start:end] - first]
            read_columns(block, first, columns[:start], rows)
        for index, (root, signs) in enumerate(self._pending):
            applied = self._done if index == 0 else 0  # only the first has been begun
            left = range(max(blocks.start, applied), blocks.stop)
            first, last = left.start * BLOCK, left.stop * BLOCK
            if last > first:
                start, end = _bounds(columns, range(left.start, left.stop))[
                    :: len(left)
                ]
                weights, before = rows_of(root, columns[:end]) * signs, root[:last]
                rows[start:end, : len(before)] -= weights[start:] @ before.T
                rows[:start, first : len(before)] -= weights[:start] @ before[first:].T

    def put(
        self, blocks: range, columns: IntArray, rows: Array, places: IntArray
    ) -> None:
        """Store the part of rows that belongs to some blocks.

        Parameters
        ----------
        blocks : range
        columns : ndarray, shape (c,)
            Ascending.
        rows : ndarray, shape (·, width)
        places : ndarray, shape (c,)
            The rows of these columns.
        """
        bounds = _bounds(columns, blocks)
        for k, start, end in zip(blocks, bounds, bounds[1:], strict=False):
            block, first, others = self._blocks[k], k * BLOCK, _EVERY_ROW
            if end > start:
                own = rows[places[start:end], : first + BLOCK]
                block[columns[start:end] - first] = own
            if end - start > BLOCK // 4:  # most are written already
                others = np.delete(_EVERY_ROW, columns[start:end] - first)
            write_columns(block, first, others, columns[:end], rows, places)

    def forget(self, columns: IntArray) -> None:
        """Drop the pending downdates of rows that are about to be put."""
        for root, _ in self._pending:
            root[columns[columns < len(root)]] = 0.0

    def checkpoint(self) -> Undo:
        """Return what takes back later calls.

        The stored rows of local landmarks are invalid, and remain so.
        """
        return contents(self)

    def defer(self, root: Array, signs: Array) -> None:
        """Subtract W diag(s) Wᵀ later, W of shape (width, rank)."""
        if len(signs):
            self._pending.append(Downdate(root, signs))

    def work(self, rank: int) -> None:
        """Apply pending downdates, for the cost of one full downdate of this rank.

        Blocks are changed as a whole; unused cost is kept for the next call.
        """
        self._credit += rank * (self.width * (self.width + BLOCK) / 2)
        while self._begin():
            root, signs = self._pending[0]
            cost = len(signs) * self._blocks[self._done].size
            if cost > self._credit:
                return
            self._apply(self._done)
            self._credit -= cost
            self._done += 1
            if self._done * BLOCK >= len(root):
                self._pending.pop(0)
                self._under_way, self._done = False, 0
        self._credit = 0.0

    def marginal(self, columns: IntArray) -> Array:
        """Return the covariance (c, c) of some columns; exactly symmetric."""
        covariance = np.empty((len(columns), len(columns)))
        holding = set((columns // BLOCK).tolist())
        for k in holding:
            read_marginal(self._blocks[k], k * BLOCK, columns, covariance)
        applied = columns < self._done * BLOCK
        for index, (root, signs) in enumerate(self._pending):
            rows = rows_of(root, columns)
            change = (rows * signs) @ rows.T
            if index == 0 and self._done:
                change[applied[:, None] & applied] = 0.0
            covariance -= change
        return symmetric(covariance)

    def diagonal(self) -> Array:
        """Return the stored variances (width,), without pending downdates."""
        diagonals = [block.diagonal(first) for first, block in self._enumerate()]
        return np.concatenate([np.empty(0), *diagonals])

    def state_dict(self, invalid: IntArray | None = None) -> dict[str, Any]:
        """Return copies of everything as arrays, invalid rows (c,) as zeros."""
        unused = np.zeros(0, dtype=np.int64) if invalid is None else invalid
        unused = unused[unused < self.width]
        rank = [len(downdate.signs) for downdate in self._pending]
        root = np.zeros((self.width, sum(rank)))
        for downdate, last in zip(self._pending, np.cumsum(rank), strict=True):
            first = last - len(downdate.signs)
            root[: len(downdate.root), first:last] = downdate.root
        root[unused] = 0.0
        blocks = [np.empty(0)]
        for first, block in self._enumerate():
            valid = block.copy()
            valid[:, unused[unused < first + BLOCK]] = 0.0
            valid[unused[(unused >= first) & (unused < first + BLOCK)] - first] = 0.0
            blocks.append(valid.ravel())
        signs = [downdate.signs for downdate in self._pending]
        return {
            "covariance": np.concatenate(blocks),
            "pending_root": root,
            "pending_signs": np.concatenate([np.empty(0), *signs]),
            "pending_shapes": np.array(
                [(len(d.root), len(d.signs)) for d in self._pending], dtype=np.int64
            ).reshape(-1, 2),
            "progress": np.array([self._under_way, self._done, self._credit]),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from what :meth:`state_dict` returned, or refuse it unchanged."""
        flat = saved_states.array("far_covariance", state["covariance"], (-1,))
        count = round(np.sqrt(2 * flat.size / BLOCK**2 + 0.25) - 0.5)
        if flat.size != BLOCK**2 * count * (count + 1) // 2:
            raise ValueError(
                "the stored covariance must be whole blocks of rows, got shape "
                f"{flat.shape}"
            )
        pending = saved_downdates(state, BLOCK * count)
        progress = saved_states.array("far_progress", state["progress"], (3,)).tolist()
        under_way, done, credit = progress
        if not (
            under_way in (0, 1) and done in range(count + 1) and credit >= 0
        ) or under_way > len(pending):
            raise ValueError(
                f"state['far_progress'] must be 0 or 1, at most {count} blocks and a "
                f"credit >= 0, got {progress}"
            )
        ends = BLOCK**2 * np.cumsum(np.arange(1, count + 1))
        parts = np.split(flat, ends)[:count]
        self._blocks = [part.reshape(BLOCK, -1).copy() for part in parts]
        self._pending = pending
        self._under_way, self._done, self._credit = bool(under_way), int(done), credit

    def _enumerate(self) -> list[tuple[int, Array]]:
        """Return the first row and the array of each block."""
        return [(k * BLOCK, block) for k, block in enumerate(self._blocks)]

    def _begin(self) -> bool:
        """Return whether a downdate is under way; join the pending ones to start it."""
        if not self._under_way and self.pending_rank >= WORTHWHILE:
            width = max(len(downdate.root) for downdate in self._pending)
            root = np.zeros((width, self.pending_rank))
            last = 0
            for downdate in self._pending:
                first, last = last, last + len(downdate.signs)
                root[: len(downdate.root), first:last] = downdate.root
            signs = np.concatenate([downdate.signs for downdate in self._pending])
            self._pending = [Downdate(root, signs)]
            self._under_way, self._done = True, 0
        return self._under_way

    def _apply(self, k: int) -> None:
        """Apply the downdate under way to a copy of one block, which replaces it."""
        from scipy.linalg.blas import dgemm  # noqa: PLC0415 (slow to import)

        root, signs = self._pending[0]
        first, last = k * BLOCK, (k + 1) * BLOCK
        # The transposes are contiguous in Fortran order: dgemm copies none of them.
        self._blocks[k] = dgemm(
            -1.0,
            root[:last].T,
            (root[first:last] * signs).T,
            1.0,
            self._blocks[k].T,
            trans_a=True,
        ).T


def stored_bytes(landmarks: int) -> int:
    """Return the size of the blocks for this many landmarks [bytes]."""
    blocks = -(-2 * landmarks // BLOCK)
    return 8 * BLOCK**2 * blocks * (blocks + 1) // 2


def _bounds(columns: IntArray, blocks: range) -> list[int]:
    """Return how many of ascending columns lie before each block and the last's end."""
    starts = BLOCK * np.arange(blocks.start, blocks.stop + 1)
    bounds: list[int] = columns.searchsorted(starts).tolist()
    return bounds
