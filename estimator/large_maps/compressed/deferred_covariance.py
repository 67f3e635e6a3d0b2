"""Covariance between the landmarks of a large map, with deferred downdates.

`DeferredCovariance` stores blocks of the covariance. A `Downdate` is a change that is
applied later; the compiled functions below copy rows and columns.
"""

from collections.abc import Mapping
from itertools import starmap
from typing import Any, NamedTuple

import numpy as np

from ....argument_checks import covariance_bytes, too_large
from ....arrays import Array, IntArray
from ....jit import jit
from ...guards import saved_states
from ..multifrontal import symmetric
from ..undo import Undo, contents

# Rows of one block: 68 landmarks.
#
# Rows whose lengths are multiples of a high power of two would compete for the same few
# places of the processor's caches.
BLOCK = 136
# Smallest rank to apply; smaller downdates wait: memory limits thin products.
WORTHWHILE = 40
# Larger pending ranks must not wait for the exchange of rows.
LARGEST_BACKLOG = 400


class Downdate(NamedTuple):
    """A change not yet applied to the stored covariance: P ← P − W diag(s) Wᵀ."""

    root: Array  # W, shape (width, rank)
    signs: Array  # s, shape (rank,), each 1 or -1
    applied: list[int]  # one number for each block that has changed already


class DeferredCovariance:
    """Lower half of a growing covariance, in blocks of rows, with pending downdates.

    Block k holds rows 136 k to 136 (k + 1) of P, as far as the diagonal.  This takes
    half the memory of a square and grows without a copy.  Every block is contiguous, so
    that BLAS changes it in place::

        P = stored − W diag(s) Wᵀ

    W is small.  Reading subtracts its product, and :meth:`work` applies it to one block
    after the other.  The rows of a new landmark are invalid until they are put.  Rows
    are read and put block by block, between which :meth:`work` must not be called.
    """

    def __init__(self) -> None:
        self._blocks: list[Array] = []
        self._pending: list[Downdate] = []
        self._under_way = False  # whether the first downdate is being applied
        self._done = 0  # number of blocks to which it has been applied
        self._credit = 0.0  # multiplications granted, less those made

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
        try:
            more = [
                np.zeros((BLOCK, width + BLOCK))
                for width in range(self.width, columns, BLOCK)
            ]
        except MemoryError:
            what, size = f"half a covariance of {columns // 2} landmarks", columns // 2
            raise too_large(what, covariance_bytes(size) / 2) from None
        self._blocks.extend(more)

    def read(
        self, blocks: range, columns: IntArray, rows: Array, coming: Downdate
    ) -> None:
        """Fill the part of rows (c, width) of P that some blocks store.

        Pending downdates are subtracted, and one that is not pending yet.
        The columns (c,) are ascending.
        """
        from scipy.linalg.blas import dgemm  # noqa: PLC0415 (slow to import)

        bounds = _bounds(columns, blocks)
        for k, start, end in zip(blocks, bounds, bounds[1:], strict=False):
            read_rows(self._blocks[k], k * BLOCK, columns[:end], start, rows)
        applied = self._done  # blocks; only the first downdate has been begun
        for root, signs, _ in [*self._pending, coming]:
            left = range(max(blocks.start, applied), blocks.stop)
            applied, first, last = 0, left.start * BLOCK, left.stop * BLOCK
            if last <= first:
                continue
            start, end = columns.searchsorted((first, last)).tolist()
            weights, before = rows_of(root, columns[:end]) * signs, root[:last]
            for own, at in (slice(start, end), 0), (slice(start), first):
                part = rows[own, at : len(before)]
                if part.size and part.flags.c_contiguous:  # without another array
                    factors = before[at:].T, weights[own].T
                    dgemm(-1.0, *factors, 1.0, part.T, True, False, True)
                else:
                    part -= weights[own] @ before[at:].T

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
            own = columns[:end]
            write_rows(self._blocks[k], k * BLOCK, own, start, rows, places)

    def forget(self, columns: IntArray) -> None:
        """Drop the pending downdates of rows that are about to be put."""
        for root, _, _ in self._pending if len(columns) else ():
            root[columns[columns < len(root)]] = 0.0

    def checkpoint(self) -> Undo:
        """Return what takes back later calls, but for changes of the blocks.

        Rows that have been put are invalid again.  A downdate that is applied remains
        so, and :meth:`work` does not repeat it.
        """
        return contents(self)

    def defer(self, downdate: Downdate) -> None:
        """Subtract W diag(s) Wᵀ later; once only if an interrupt repeats the call."""
        is_new = all(downdate is not each for each in self._pending)
        if is_new and len(downdate.signs):
            self._pending.append(downdate)

    def work(self, rank: float) -> None:
        """Apply pending downdates, for the cost of one full downdate of this rank.

        Blocks are changed as a whole; what this costs too little or too much is kept
        for the next call.
        """
        self._credit += rank * (self.width * (self.width + BLOCK) / 2)
        while self._begin():
            root, signs, _ = self._pending[0]
            last, count = self._done, len(root) // BLOCK
            for block in self._blocks[last:count]:
                cost = len(signs) * block.size
                if cost > 2 * self._credit:
                    break
                self._credit -= cost
                last += 1
            self._apply(range(self._done, last))
            self._done = last
            if last < count:
                return
            self._pending.pop(0)
            self._under_way, self._done = False, 0
        self._credit = min(self._credit, 0.0)

    def marginal(self, columns: IntArray) -> Array:
        """Return the covariance (c, c) of some columns; exactly symmetric."""
        covariance = np.empty((len(columns), len(columns)))
        for k in set((columns // BLOCK).tolist()):
            read_marginal(self._blocks[k], k * BLOCK, columns, covariance)
        applied = columns < self._done * BLOCK
        for index, (root, signs, _) in enumerate(self._pending):
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
        if done not in range(count + 1) or under_way not in (0, min(1, len(pending))):
            raise ValueError(
                f"state['far_progress'] must be 0 or 1, at most {count} blocks and a "
                f"credit, got {progress}"
            )
        ends = BLOCK**2 * np.cumsum(np.arange(1, count + 1))
        parts = np.split(flat, ends)[:count]
        self._blocks = [part.reshape(BLOCK, -1) for part in parts]
        self._pending = pending
        if pending:
            pending[0].applied.extend(range(int(done)))
        self._under_way, self._done, self._credit = bool(under_way), int(done), credit

    def _enumerate(self) -> list[tuple[int, Array]]:
        """Return the first row and the array of each block."""
        return [(k * BLOCK, block) for k, block in enumerate(self._blocks)]

    def _begin(self) -> bool:
        """Return whether a downdate is under way; join the pending ones to start it."""
        if not self._under_way and self.pending_rank >= WORTHWHILE:
            width = max(len(downdate.root) for downdate in self._pending)
            root, last = np.empty((width, self.pending_rank)), 0
            for downdate in self._pending:
                first, last = last, last + len(downdate.signs)
                root[: len(downdate.root), first:last] = downdate.root
                root[len(downdate.root) :, first:last] = 0.0
            signs = np.concatenate([downdate.signs for downdate in self._pending])
            self._pending = [Downdate(root, signs, self._pending[0].applied)]
            self._under_way, self._done = True, 0
        return self._under_way

    def _apply(self, blocks: range) -> None:
        """Apply the downdate under way to some blocks, in place, unless it has been."""
        from scipy.linalg.blas import dgemm  # noqa: PLC0415 (slow to import)

        root, signs, applied = self._pending[0]
        first = max(blocks.start, len(applied))
        weighted = root[first * BLOCK : blocks.stop * BLOCK]
        if (signs < 0).any():
            weighted = weighted * signs
        calls = []
        for k, block in enumerate(self._blocks[first : blocks.stop]):
            own = weighted[k * BLOCK : (k + 1) * BLOCK]
            # The transposes are contiguous in Fortran order: dgemm copies none of them.
            factors = root[: block.shape[1]].T, own.T
            calls.append((-1.0, *factors, 1.0, block.T, True, False, True))
        # No line of Python runs between the change of a block and the note of it: an
        # interrupt finds neither or both.
        applied.extend(map(len, starmap(dgemm, calls)))


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
        Downdate(
            root[:rows, end - rank : end].copy(), signs[end - rank : end].copy(), []
        )
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
def read_rows(
    block: Array, first: int, columns: IntArray, start: int, rows: Array
) -> None:
    """Copy what a block holds of the rows (c, width) of some columns.

    The first ``start`` are columns of the block, and the others are among its rows.
    Columns are copied row by row, because neighbours share a cache line.
    """
    for i in range(len(block)):
        for j in range(start):
            rows[j, first + i] = block[i, columns[j]]
    for j in range(start, len(columns)):
        for i in range(first + len(block)):
            rows[j, i] = block[columns[j] - first, i]


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
def write_rows(
    block: Array,
    first: int,
    columns: IntArray,
    start: int,
    rows: Array,
    places: IntArray,
) -> None:
    """Store what a block holds of the rows at ``places``, as :func:`read_rows`."""
    for j in range(start, len(columns)):
        block[columns[j] - first] = rows[places[j], : first + len(block)]
    for i in range(len(block)):
        for j in range(len(columns)):
            block[i, columns[j]] = rows[places[j], first + i]


@jit
def fill_extended(covariance: Array, own: Array, scale: Array, virtual: int) -> None:
    """Put a local map and the extension of a phase into the covariance of a filter.

    Parameters
    ----------
    covariance : ndarray, shape (capacity, capacity)
        Zeros.
    own : ndarray, shape (s, s)
        Covariance of pose and local landmarks; the lower half is used.
    scale : ndarray, shape (s, s)
        T, lower triangular; unused if ``virtual`` is 0.
    virtual : int
        Number of columns of the extension, one or two for each coordinate.
    """
    step = virtual // len(own)
    for i in range(len(own)):
        k = i + virtual * (i >= 3)
        for j in range(i + 1):
            m = j + virtual * (j >= 3)
            covariance[k, m] = covariance[m, k] = own[i, j]
            if virtual:
                m = 3 + step * j
                covariance[k, m] = covariance[m, k] = scale[i, j]
