"""Exact deferral: a phase in a local map, and its effect on the rest of the map.

At the beginning of a phase let S (s, width) be the covariance of the s local
coordinates x_a (pose and local landmarks) with all others, x_b.  The phase only
measures x_a.  The ordinary filter then runs on an extended state (x_a, y)::

    mean (x_a, 0),   covariance [P_aa  I; I  0]

x_b is a linear function of y, x_b = Sᵀ y + terms that do not change.  With the final
covariance [P_aa Φ; Φᵀ −Ψ] and mean (x_a, y), the phase changes the rest of the map by::

    x_b ← x_b + Sᵀ y,   P_ab ← Φ S,   P_bb ← P_bb − Sᵀ Ψ S

This holds for local landmarks, too: x_b may contain them as they were at the beginning.
(Guivant and Nebot, 2001, in the form of an augmented state.)

In the invariant frame a correction also rotates and shears points,
q⁺ = q + V(t) δq, and the covariance is transported, P ← T P Tᵀ, e_q⁺ = e_q + J (q⁺ − q)
e_θ.  Both are linear in q read as a complex number, J = i.  There y is one complex
number for each of the s coordinates, a *virtual landmark* at the origin.  With x_b and
the rows of S read as complex numbers, the equations above hold unchanged.
"""

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from ....arrays import Array, IntArray
from ...filters.ekf import EkfSlam
from ...filters.gaussian_map import parts_of
from ..multifrontal import pairs
from .deferred_covariance import (
    BLOCK,
    DeferredCovariance,
    Downdate,
    fill_extended,
    unpivot,
)


class Phase(NamedTuple):
    """The belief of the filter at the end of a phase, (x_a, y) in its own order.

    The pose comes first, then y, then the local landmarks.  The arrays are views of the
    filter's memory, which the next phase does not use.
    """

    mean: Array  # (size,)
    reference: Array  # linearisation points, for filters that fix them
    covariance: Array  # (size, size)
    first: int  # row of the first local landmark, 3 + e

    def gain(self, rows: IntArray) -> Array:
        """Return rows of Φ, shape (k, e)."""
        chosen: Array = self.covariance[rows, 3 : self.first]
        return chosen

    @property
    def loss(self) -> Array:
        """Ψ, shape (e, e)."""
        return -self.covariance[3 : self.first, 3 : self.first]

    @property
    def shift(self) -> Array:
        """The mean of y, shape (1, e)."""
        return self.mean[None, 3 : self.first]


def virtual_landmarks(coordinates: int, invariant: bool) -> int:
    """Return the number of landmarks whose places the extension takes."""
    return coordinates if invariant else (coordinates + 1) // 2


def begin_phase(
    slam: EkfSlam, mean: Array, rows: Array, reference: Array, ids: list[int]
) -> None:
    """Replace the map of a filter by the extension, followed by a local map.

    Parameters
    ----------
    slam : EkfSlam
        The pose and its covariance are kept.
    mean, reference : ndarray, shape (2n,)
        Of the n local landmarks.
    rows : ndarray, shape (3 + 2n, 2n)
        Covariance of pose and local landmarks with these; the lower half is used.
    ids : list of int
        Identities of the virtual landmarks, if any, then of the local ones.
    """
    gaussian, size = slam.map, 3 + 2 * len(ids)
    block = gaussian.blank(len(ids), more=len(ids) // 2)
    parts, virtual = parts_of(block), size - len(rows)
    step = 2 if virtual == 2 * len(rows) else 1
    for array, head, tail in (
        (parts.mean, gaussian.mean[:3], mean),
        (parts.reference, gaussian.reference[:3], reference),
    ):
        array[:3], array[3 + virtual : size] = head, tail
    fill_extended(parts.covariance, gaussian.covariance[:3, :3], rows, virtual, step)
    gaussian.hold(None, ids, block=block)


def end_phase(slam: EkfSlam, virtual: int) -> Phase:
    """Return the belief of a filter that ran on an extended state."""
    mean, covariance, reference = slam.map.used
    return Phase(mean, reference, covariance, 3 + 2 * virtual)


def combine(coefficients: Array, strip: Array, invariant: bool) -> Array:
    """Return Φ S, shape (k, width), of coefficients (k, e) and the strip (s, width)."""
    if not invariant:
        product: Array = coefficients[:, : len(strip)] @ strip
        return product
    turned = coefficients.view(np.complex128) @ strip.view(np.complex128)
    return turned.view(np.float64)


def roots(loss: Array, invariant: bool) -> tuple[Array, Array]:
    """Factor Ψ = U diag(s) Uᵀ at its numerical rank.

    The rank of Ψ is that of the measurements of the phase, far below its size.  In the
    invariant frame, Ψ is indefinite.

    Returns
    -------
    root : ndarray, shape (rank, e)
        Uᵀ.
    signs : ndarray, shape (rank,)
        s, each 1 or -1.
    """
    if not invariant:
        return _by_pivots(loss)
    used = np.flatnonzero(loss.any(axis=0))
    root, signs = _by_eigenvalues(loss[used[:, None], used])
    rows = np.zeros((len(root), len(loss)))
    rows[:, used] = root
    return rows, signs


def _by_pivots(loss: Array) -> tuple[Array, Array]:
    """Pivoted Cholesky decomposition of a semidefinite matrix."""
    from scipy.linalg.lapack import dpstrf  # noqa: PLC0415 (slow to import)

    factor, pivots, rank, _ = dpstrf(loss, lower=True)
    root = np.zeros((rank, len(loss)))
    unpivot(factor.T, pivots - 1, root)
    return root, np.ones(rank)


def _by_eigenvalues(part: Array) -> tuple[Array, Array]:
    """Eigenvalue decomposition of a symmetric matrix."""
    if not len(part):
        return part, np.empty(0)
    values, vectors = np.linalg.eigh(part)
    least = np.finfo(np.float64).eps * len(part) * np.abs(values).max()
    large = np.abs(values) > least
    root = (vectors[:, large] * np.sqrt(np.abs(values[large]))).T
    return root, np.sign(values[large])


# --------------------------------------------------------------------------------------
# A change of the local map, spread over several steps.
#
# The rows of the landmarks that are new to the map are stored, those of the landmarks
# that enter are read, and Φ S becomes the strip of the new local map.  The new phase
# needs none of this before it ends: it begins with the covariance of its own landmarks
# alone.  Ψ is therefore factored in the step after the change, and the exchange
# proceeds block by block in the steps that follow.

SPREAD = 4  # steps that an exchange takes in a large map


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

    own: IntArray  # ascending columns of the old local landmarks, shape (a - 3,)
    order: IntArray  # their rows in the old belief of the filter
    needed: IntArray  # its rows whose Φ S is needed
    left: int  # how many of these, the first, belong to new landmarks that leave
    new: IntArray  # ascending columns of the landmarks to store
    places: IntArray  # their rows among those needed
    entering: IntArray  # ascending columns of the landmarks that enter


def exchanged_rows(
    slots: Mapping[int, int],
    local: Iterable[int],
    chosen: Collection[int],
    stored: int,
    first: int,
) -> tuple[Exchanged, dict[int, None]]:
    """Return the rows of a change of the local map, and its landmarks in their order.

    Parameters
    ----------
    slots : mapping
        Place of each landmark in the map's arrays.
    local, chosen : collection of int
        The old and the new local landmarks.
    stored : int
        How many old ones, the first, are in the stored covariance.
    first : int
        Row of the first old one in the belief of the filter.
    """
    old = list(local)
    staying = [k for k, i in enumerate(old) if i in chosen]
    leaving = [k for k in range(stored, len(old)) if old[k] not in chosen]
    left, before = 2 * len(leaving), set(old)
    entering = sorted((i for i in chosen if i not in before), key=slots.__getitem__)
    own = pairs([slots[i] for i in old])
    order = own.argsort()
    place = {k: 2 * row for row, k in enumerate(leaving)}
    place |= {k: left + 3 + 2 * row for row, k in enumerate(staying)}
    new = sorted(range(stored, len(old)), key=lambda k: slots[old[k]])
    rows = Exchanged(
        own[order],
        first + order,
        np.concatenate([first + pairs(leaving), (0, 1, 2), first + pairs(staying)]),
        left,
        pairs([slots[old[k]] for k in new]),
        np.array([place[k] + c for k in new for c in (0, 1)], dtype=np.int64),
        pairs([slots[i] for i in entering]),
    )
    return rows, dict.fromkeys([old[k] for k in staying] + entering)


@dataclass
class Handover:
    """Exchange of rows between the stored covariance and two local maps.

    One group of blocks follows the other.  The results do not depend on the time at
    which this happens.  The stored covariance must not change in between.
    """

    old: Phase  # the end of the old phase
    strip: Array  # S of the old phase, shape (s, width)
    rows: Exchanged
    invariant: bool
    group: int  # number of blocks that are exchanged at a time
    done: int = 0  # number of blocks that have been exchanged
    is_factored: bool = False  # whether what follows is known
    lost: Downdate = field(init=False, repr=False)  # to be deferred at the end
    _root: Array = field(init=False, repr=False)  # Uᵀ, (r, e)
    _values: Array = field(init=False, repr=False)  # rows of P, (left + s', width)

    def __post_init__(self) -> None:
        """Make room for the new strip and for the rows to store."""
        size = len(self.rows.needed) + len(self.rows.entering)
        self._values = np.empty((size, self.strip.shape[1]))

    @property
    def next_strip(self) -> Array:
        """S of the new phase, shape (s', width), as far as it has been exchanged."""
        return self._values[self.rows.left :]

    def advance(self, stored: DeferredCovariance, blocks: int) -> None:
        """Exchange groups of blocks until ``blocks`` are done, or all.

        The first call factors Ψ; with 0 blocks, it does no more.
        """
        count = stored.width // BLOCK
        if not self.is_factored:
            self._factor(stored.width)
        while self.done < min(blocks, count):
            last = min(self.done + self.group, count)
            self._exchange(stored, range(self.done, last))
            self.done = last

    def beginning(self, stored: DeferredCovariance) -> Array:
        """Return the covariance with which a new phase begins, shape (a', a' - 3).

        It is that of pose and new local landmarks, without the columns of the pose, and
        does not need the new strip.
        """
        kept, entering = self.rows.needed[self.rows.left :], self.rows.entering
        S = np.ascontiguousarray(self.strip[:, entering])
        block, P = stored.marginal(entering), self.old.covariance
        lost = np.ascontiguousarray(combine(self.old.loss, S, self.invariant).T)
        block -= combine(lost, S, self.invariant)  # Sᵀ Ψ S
        across = combine(self.old.gain(kept), S, self.invariant)
        return np.block([[P[np.ix_(kept, kept[3:])], across], [across[3:].T, block]])

    @property
    def nbytes(self) -> int:
        """Memory that the exchange holds, without the old strip [bytes]."""
        arrays = [self._values, self.old.covariance]
        if self.is_factored:
            arrays += [self._root, self.lost.root]
        return sum(array.nbytes for array in arrays)

    def _factor(self, width: int) -> None:
        self._root, signs = roots(self.old.loss, self.invariant)
        self.lost = Downdate(np.empty((width, len(signs))), signs, [])
        self.is_factored = True

    def _exchange(self, stored: DeferredCovariance, blocks: range) -> None:
        here = slice(blocks.start * BLOCK, blocks.stop * BLOCK)
        rows, values, S = self.rows, self._values, self.strip[:, here]
        needed = self.old.gain(rows.needed)
        values[: len(needed), here] = combine(needed, S, self.invariant)
        if self.invariant:
            self.lost.root[here] = combine(self._root, S, self.invariant).T
        else:  # without a copy
            np.matmul(S.T, self._root[:, : len(S)].T, out=self.lost.root[here])
        own = _within(rows.own, here)
        inside = self.old.covariance[rows.needed[:, None], rows.order[own]]
        values[: len(needed), rows.own[own]] = inside
        if len(rows.new):
            self.lost.root[rows.new[_within(rows.new, here)]] = 0.0
            stored.put(blocks, rows.new, values, rows.places)
        stored.read(blocks, rows.entering, values[len(needed) :], self.lost)


def _within(columns: IntArray, here: slice) -> slice:
    """Return where ascending columns lie between two limits."""
    start, end = columns.searchsorted((here.start, here.stop)).tolist()
    return slice(start, end)
