"""Covariance between the landmarks of a large map, with deferred downdates.

`DeferredCovariance` stores blocks of the covariance. A `Downdate` is a change that is
applied later; the compiled functions below copy rows and columns.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from ....arrays import Array, IntArray
from ....jit import jit
from ...support import saved_states
from ...support.argument_checks import refuse_beyond_memory
from ...support.undo import Undo, contents
from ..multifrontal import symmetric

# Rows of one block: 64 landmarks.
BLOCK = 128
# Smallest rank to apply; smaller downdates wait: memory limits thin products.
WORTHWHILE = 40
# Larger pending ranks must not wait for the exchange of rows.
LARGEST_BACKLOG = 400
_EVERY_ROW = np.arange(BLOCK)


class Downdate(NamedTuple):
    """A change not yet applied to the stored covariance: P ← P − W diag(s) Wᵀ."""

    root: Array  # W, shape (width, rank)
    signs: Array  # s, shape (rank,), each 1 or -1


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

    def read(
        self, blocks: range, columns: IntArray, rows: Array, coming: Downdate
    ) -> None:
        """Fill the part of rows (c, width) of P that some blocks store.

        Pending downdates are subtracted, and one that is not pending yet.
        The columns (c,) are ascending.
        """
        bounds = _bounds(columns, blocks)
        for k, start, end in zip(blocks, bounds, bounds[1:], strict=False):
            block, first = self._blocks[k], k * BLOCK
            if end > start:
                rows[start:end, : first + BLOCK] = block[columns[start:end] - first]
            read_columns(block, first, columns[:start], rows)
        for index, (root, signs) in enumerate([*self._pending, coming]):
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

    def defer(self, downdate: Downdate) -> None:
        """Subtract W diag(s) Wᵀ later; once only if an interrupt repeats the call."""
        is_new = all(downdate is not each for each in self._pending)
        if is_new and len(downdate.signs):
            self._pending.append(downdate)

    def work(self, rank: float) -> None:
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
        table = {"covariance": (saved_states.NUMBERS, -1)}
        flat = saved_states.read(state, table, "far_")["covariance"]
        count = round(np.sqrt(2 * flat.size / BLOCK**2 + 0.25) - 0.5)
        if flat.size != BLOCK**2 * count * (count + 1) // 2:
            raise ValueError(
                "the stored covariance must be whole blocks of rows, got shape "
                f"{flat.shape}"
            )
        saved = saved_states.read(state, PENDING, "far_", w=BLOCK * count)
        pending = _downdates(saved)
        under_way, done, credit = progress = saved["progress"].tolist()
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


# What a saved state holds about downdates.
PENDING: saved_states.Table = {
    "pending_signs": (saved_states.NUMBERS, "r"),
    "pending_root": (saved_states.NUMBERS, "w", "r"),
    "pending_shapes": (saved_states.COUNTS, -1, 2),
    "progress": (saved_states.NUMBERS, 3),
}


def _downdates(saved: Mapping[str, Any]) -> list[Downdate]:
    """Return the pending downdates of a state, or refuse them."""
    signs, root, shapes, _ = (saved[key] for key in PENDING)
    if shapes[:, 1].sum() != len(signs) or (shapes[:, 0] > len(root)).any():
        raise ValueError(
            f"state['far_pending_shapes'] must add up to a rank of {len(signs)} in "
            f"{len(root)} rows, got {shapes.tolist()}"
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
    for first in range(0, len(covariance), BLOCK):
        own = slice(first, first + BLOCK)
        covariance[own] -= (root[own] * signs) @ root.T


# --------------------------------------------------------------------------------------
# Copy rows and columns between the arrays of a map and a local map, compiled.


@jit
def read_columns(block: Array, first: int, columns: IntArray, rows: Array) -> None:
    """Copy some columns of a block into rows (c, width), from column ``first`` on.

    The copy runs row by row, because neighbours share a cache line.
    """
    for i in range(len(block)):
        for j in range(len(columns)):
            rows[j, first + i] = block[i, columns[j]]


@jit
def read_marginal(
    block: Array, first: int, columns: IntArray, covariance: Array
) -> None:
    """Copy what a block holds of the covariance (c, c) of some columns, lower half."""
    last = first + len(block)
    for i in range(len(columns)):
        row = columns[i]
        if first <= row < last:
            for j in range(len(columns)):
                column = columns[j]
                if column <= row:
                    value = block[row - first, column]
                    covariance[i, j] = covariance[j, i] = value


@jit
def write_columns(
    block: Array,
    first: int,
    own: IntArray,
    columns: IntArray,
    rows: Array,
    places: IntArray,
) -> None:
    """Copy the rows at ``places``, from column ``first`` on, into some columns.

    Only the rows ``own`` of the block change.
    """
    for i in own:
        for j in range(len(columns)):
            block[i, columns[j]] = rows[places[j], first + i]


@jit
def fill_extended(
    covariance: Array, pose: Array, rows: Array, virtual: int, step: int
) -> None:
    """Put a local map and the extension of a phase into the covariance of a filter.

    Parameters
    ----------
    covariance : ndarray, shape (capacity, capacity)
        Zeros.
    pose : ndarray, shape (3, 3)
        Covariance of the pose.
    rows : ndarray, shape (a, a - 3)
        Covariance of pose and local landmarks with the local landmarks.  Of the last
        a - 3 rows, only the lower half is used.
    virtual, step : int
        Number of columns of the extension; every ``step``-th belongs to a coordinate.
    """
    for i in range(len(rows)):
        for j in range(i + 1):
            value = pose[i, j] if i < 3 else rows[j, i - 3]
            if j >= 3:
                value = rows[i, j - 3]
            k, m = i + virtual * (i >= 3), j + virtual * (j >= 3)
            covariance[k, m] = covariance[m, k] = value
        if virtual:
            k, m = i + virtual * (i >= 3), 3 + step * i
            covariance[k, m] = covariance[m, k] = 1.0


@jit
def unpivot(factor: Array, places: IntArray, rows: Array) -> None:
    """Copy the first rows of a triangular factor, its columns to their places."""
    for i in range(len(rows)):
        for j in range(i, len(places)):
            rows[i, places[j]] = factor[i, j]
