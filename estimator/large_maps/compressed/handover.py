"""A change of the local map, spread over several steps.

The rows of the landmarks that leave go back to the stored covariance, those of the
landmarks that enter are read, and Φ S becomes the strip of the new local map.  The new
phase needs none of this before it ends: it begins with the covariance of its own
landmarks alone.  The exchange therefore proceeds block by block.
"""

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from ....arrays import Array, IntArray
from ..sparse_cholesky.coordinates import pairs
from .deferred_covariance import BLOCK, DeferredCovariance
from .downdate import subtract, symmetric
from .phase_update import Phase, combine, roots

SPREAD = 4
"""Steps that a change of the local map takes in a large map."""


def blocks_in_a_step(width: int, *, hurried: bool) -> int:
    """Return how many blocks of a covariance of this width to exchange in a step.

    Examples
    --------
    >>> [blocks_in_a_step(width, hurried=False) for width in (256, 1024, 6016)]
    [1, 2, 11]
    """
    blocks = width // BLOCK
    return max(1, blocks if hurried else blocks // SPREAD)


class Exchanged(NamedTuple):
    """The rows of a change of the local map."""

    own: IntArray
    """Columns of the old local landmarks, shape (a - 3,)."""
    kept: IntArray
    """Rows of the pose and of landmarks that stay, in the old local map."""
    leaving: IntArray
    """Ascending columns of the landmarks that leave."""
    places: IntArray
    """Their rows in the old local map."""
    entering: IntArray
    """Ascending columns of the landmarks that enter."""


def exchanged_rows(
    slots: Mapping[int, int], local: Iterable[int], chosen: Collection[int]
) -> tuple[Exchanged, dict[int, None]]:
    """Return the rows of a change of the local map, and its landmarks in their order.

    Parameters
    ----------
    slots : mapping
        Place of each landmark in the map's arrays.
    local, chosen : collection of int
        The old and the new local landmarks.
    """
    old = list(local)
    staying = [k for k, i in enumerate(old) if i in chosen]
    places = {slots[i]: k for k, i in enumerate(old) if i not in chosen}
    leaving, before = sorted(places), set(old)
    entering = sorted((i for i in chosen if i not in before), key=slots.__getitem__)
    rows = Exchanged(
        pairs([slots[i] for i in old]),
        np.r_[0:3, 3 + pairs(staying)],
        pairs(leaving),
        3 + pairs([places[slot] for slot in leaving]),
        pairs([slots[i] for i in entering]),
    )
    return rows, dict.fromkeys([old[k] for k in staying] + entering)


@dataclass
class Handover:
    """Exchange of rows between the stored covariance and two local maps.

    One group of blocks follows the other.  The results do not depend on the time at
    which this happens.
    """

    coefficients: Array
    """Φ above Uᵀ of the old phase, shape (a + r, e)."""
    strip: Array
    """S of the old phase, shape (s, width)."""
    covariance: Array
    """P_aa at the end of the old phase, without the columns of the pose."""
    rows: Exchanged
    lost: Array
    """W of the deferred downdate, shape (width, r), to be filled."""
    next_strip: Array
    """S of the new phase, shape (s', width), to be filled."""
    invariant: bool
    group: int
    """Number of blocks that are exchanged at a time."""
    done: int = 0
    """Number of blocks that have been exchanged."""
    _values: Array = field(init=False, repr=False)
    _order: IntArray = field(init=False, repr=False)

    def __post_init__(self) -> None:
        self._values = np.zeros((len(self.covariance), len(self.lost)))
        self._order = np.argsort(self.rows.own)

    @property
    def nbytes(self) -> int:
        """Memory that the exchange holds [bytes]."""
        arrays = (self.coefficients, self.strip, self.covariance, self._values)
        return sum(array.nbytes for array in arrays)

    def advance(self, stored: DeferredCovariance, blocks: int) -> None:
        """Exchange groups of blocks until ``blocks`` are done, or all."""
        count = len(self.lost) // BLOCK
        while self.done < min(blocks, count):
            last = min(self.done + self.group, count)
            self._exchange(stored, range(self.done, last))
            self.done = last

    def _exchange(self, stored: DeferredCovariance, blocks: range) -> None:
        here, a = slice(blocks.start * BLOCK, blocks.stop * BLOCK), len(self._values)
        if self.coefficients.size:
            part = combine(self.coefficients, self.strip[:, here], self.invariant)
            self._values[:, here] = part[:a]
            self.lost[here] = part[a:].T
        own = self._order[_within(self.rows.own[self._order], here)]
        self._values[:, self.rows.own[own]] = self.covariance[:, own]
        self.lost[self.rows.leaving[_within(self.rows.leaving, here)]] = 0.0
        stored.put(blocks, self.rows.leaving, self._values, self.rows.places)
        count = len(self.rows.kept)
        self.next_strip[:count, here] = self._values[self.rows.kept, here]
        stored.read(blocks, self.rows.entering, self.next_strip[count:])


def begin_handover(
    stored: DeferredCovariance,
    strip: Array,
    now: Phase,
    rows: Exchanged,
    *,
    invariant: bool,
    hurried: bool,
) -> tuple[Handover, Array]:
    """Begin a handover; also return the covariance with which a new phase begins.

    Parameters
    ----------
    stored : DeferredCovariance
    strip : ndarray, shape (s, width)
        S of the old phase.
    now : Phase
        The end of the old phase.
    rows : Exchanged
    invariant, hurried : bool

    Returns
    -------
    handover : Handover
    covariance : ndarray, shape (a', a' - 3)
        Of pose and new local landmarks, without the columns of the pose.
    """
    root, signs = np.empty((0, now.gain.shape[1])), np.empty(0)
    if len(now.loss):
        root, signs = roots(now.loss, invariant)
    coefficients, a = np.concatenate([now.gain, root]), len(now.mean)
    entering = np.ascontiguousarray(strip[:, rows.entering])
    near = combine(coefficients, entering, invariant)
    block = stored.marginal(rows.entering)
    subtract(block, near[a:].T, signs)
    stored.forget(rows.leaving)
    lost = np.zeros((stored.width, len(signs)))
    stored.defer(lost, signs)
    size = len(rows.kept) + len(rows.entering)
    handover = Handover(
        coefficients,
        strip,
        now.covariance[:, 3:],
        rows,
        lost,
        np.empty((size, stored.width)),
        invariant,
        blocks_in_a_step(stored.width, hurried=hurried),
    )
    across = near[rows.kept]
    inside = now.covariance[np.ix_(rows.kept, rows.kept[3:])]
    return handover, np.block([[inside, across], [across[3:].T, symmetric(block)]])


def _within(columns: IntArray, here: slice) -> slice:
    """Return where ascending columns lie between two limits."""
    start, end = columns.searchsorted((here.start, here.stop)).tolist()
    return slice(start, end)
