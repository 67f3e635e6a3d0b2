"""Exact deferral: a phase in a local map, and its effect on the rest of the map.

At the beginning of a phase let S (s, width) be the covariance of the s local
coordinates x_a (pose and local landmarks) with all others, x_b.  The phase only
measures x_a.  The ordinary filter then runs on an extended state (x_a, y)::

    mean (x_a, 0),   covariance [P_aa  I; I  0]

x_b is a linear function of y, x_b = Sᵀ y + terms that do not change.  With the final
covariance [P_aa Φ; Φᵀ −Ψ] and mean (x_a, y), the phase changes the rest of the map by::

    x_b ← x_b + Sᵀ y,   P_ab ← Φ S,   P_bb ← P_bb − Sᵀ Ψ S

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
from ..multifrontal import pairs, symmetric
from .deferred_covariance import (
    BLOCK,
    DeferredCovariance,
    Downdate,
    fill_extended,
    unpivot,
)


class Phase(NamedTuple):
    """The parts of the filter's belief at the end of a phase."""

    mean: Array  # (a,) of pose and local landmarks
    reference: Array  # (a,) their linearisation points, for filters that fix them
    covariance: Array  # P_aa, (a, a)
    gain: Array  # Φ, (a, e)
    loss: Array  # Ψ, (e, e)
    shift: Array  # y, (1, e)


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
    """Split the belief of a filter that ran on an extended state; return copies.

    Without an extension the covariance is a view: the local map may be large.
    """
    size, rest = slam.map.size, 3 + 2 * virtual
    mean, covariance = slam.map.mean[:size], slam.map.covariance[:size, :size]
    if not virtual:
        reference, nothing = slam.map.reference[:size].copy(), np.empty((size, 0))
        none = np.empty((1, 0))
        return Phase(mean.copy(), reference, covariance, nothing, none[:0], none)
    rows = np.concatenate([covariance[:3], covariance[rest:]])
    return Phase(
        _without(mean, rest),
        _without(slam.map.reference[:size], rest),
        np.concatenate([rows[:, :3], rows[:, rest:]], axis=1),
        rows[:, 3:rest].copy(),
        -covariance[3:rest, 3:rest],
        mean[None, 3:rest].copy(),
    )


def _without(vector: Array, rest: int) -> Array:
    return np.concatenate([vector[:3], vector[rest:]])


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

    used = np.flatnonzero(loss.diagonal())
    factor, pivots, rank, _ = dpstrf(loss[used[:, None], used], lower=True)
    root = np.zeros((rank, len(loss)))
    unpivot(factor.T, used[pivots - 1], root)
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
# The rows of the landmarks that leave go back to the stored covariance, those of the
# landmarks that enter are read, and Φ S becomes the strip of the new local map.  The
# new phase needs none of this before it ends: it begins with the covariance of its own
# landmarks alone.  Ψ is therefore factored in the step after the change, and the
# exchange proceeds block by block in the steps that follow.

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

    own: IntArray  # columns of the old local landmarks, shape (a - 3,)
    kept: IntArray  # rows of the pose and of landmarks that stay, in the old local map
    leaving: IntArray  # ascending columns of the landmarks that leave
    places: IntArray  # their rows in the old local map
    entering: IntArray  # ascending columns of the landmarks that enter


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
    which this happens.  The stored covariance must not change in between.
    """

    old: Phase  # the end of the old phase
    strip: Array  # S of the old phase, shape (s, width)
    rows: Exchanged
    next_strip: Array  # S of the new phase, shape (s', width), to be filled
    invariant: bool
    group: int  # number of blocks that are exchanged at a time
    done: int = 0  # number of blocks that have been exchanged
    is_factored: bool = False  # whether what follows is known
    lost: Downdate = field(init=False, repr=False)  # to be deferred at the end
    _coefficients: Array = field(init=False, repr=False)  # Φ above Uᵀ, (a + r, e)
    _values: Array = field(init=False, repr=False)
    _order: IntArray = field(init=False, repr=False)

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

    @property
    def nbytes(self) -> int:
        """Memory that the exchange holds [bytes]."""
        arrays = [self.strip, self.old.covariance, self.old.gain, self.old.loss]
        if self.is_factored:
            arrays += [self._coefficients, self._values, self.lost.root]
        return sum(array.nbytes for array in arrays)

    def _factor(self, width: int) -> None:
        root, signs = np.empty((0, self.old.gain.shape[1])), np.empty(0)
        if len(self.old.loss):
            root, signs = roots(self.old.loss, self.invariant)
        self._coefficients = np.concatenate([self.old.gain, root])
        self._values = np.zeros((len(self.old.mean), width))
        self._order = np.argsort(self.rows.own)
        self.lost = Downdate(np.zeros((width, len(signs))), signs)
        self.is_factored = True

    def _exchange(self, stored: DeferredCovariance, blocks: range) -> None:
        here, a = slice(blocks.start * BLOCK, blocks.stop * BLOCK), len(self._values)
        if self._coefficients.size:
            part = combine(self._coefficients, self.strip[:, here], self.invariant)
            self._values[:, here] = part[:a]
            self.lost.root[here] = part[a:].T
        own = self._order[_within(self.rows.own[self._order], here)]
        self._values[:, self.rows.own[own]] = self.old.covariance[:, 3 + own]
        self.lost.root[self.rows.leaving[_within(self.rows.leaving, here)]] = 0.0
        stored.put(blocks, self.rows.leaving, self._values, self.rows.places)
        count = len(self.rows.kept)
        self.next_strip[:count, here] = self._values[self.rows.kept, here]
        stored.read(blocks, self.rows.entering, self.next_strip[count:], self.lost)


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
    entering = np.ascontiguousarray(strip[:, rows.entering])
    block = stored.marginal(rows.entering)
    lost = np.ascontiguousarray(combine(now.loss, entering, invariant).T)
    block -= combine(lost, entering, invariant)  # Sᵀ Ψ S
    stored.forget(rows.leaving)
    next_strip = np.empty((len(rows.kept) + len(rows.entering), stored.width))
    group = blocks_in_a_step(stored.width, hurried=hurried)
    handover = Handover(now, strip, rows, next_strip, invariant, group)
    across = combine(now.gain[rows.kept], entering, invariant)
    inside = now.covariance[np.ix_(rows.kept, rows.kept[3:])]
    return handover, np.block([[inside, across], [across[3:].T, symmetric(block)]])


def _within(columns: IntArray, here: slice) -> slice:
    """Return where ascending columns lie between two limits."""
    start, end = columns.searchsorted((here.start, here.stop)).tolist()
    return slice(start, end)
