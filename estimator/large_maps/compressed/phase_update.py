"""Exact deferral: a phase in a local map, and its effect on the rest of the map.

At the beginning of a phase let S (s, width) be the covariance of the s local
coordinates x_a (pose and local landmarks) with all others, x_b.  The phase only
measures x_a.  The ordinary filter then runs on an extended state (x_a, y)::

    mean (x_a, 0),   covariance [P_aa  T; Tᵀ  0]

with any invertible T.  x_b is a linear function of y, x_b = S̃ᵀ y + terms that do not
change, with S = T S̃.  With the final covariance [P_aa Φ; Φᵀ −Ψ] and mean (x_a, y), the
phase changes the rest of the map by::

    x_b ← x_b + S̃ᵀ y,   P_ab ← Φ S̃,   P_bb ← P_bb − S̃ᵀ Ψ S̃

This holds for local landmarks, too: x_b may contain them as they were at the beginning.
(Guivant and Nebot, 2001, in the form of an augmented state with T = I.)

Here T Tᵀ = P_aa.  Then Ψ has eigenvalues of at most 1.  With T = I, they would be of
the size of the information about x_a.  Where P_aa has large and small eigenvalues, as
in a map whose place is known much less well than its shape, rounding would hide what a
phase reveals about the former, and variances could become negative.

In the invariant frame a correction also rotates and shears points,
q⁺ = q + V(t) δq, and the covariance is transported, P ← G P Gᵀ, e_q⁺ = e_q + J (q⁺ − q)
e_θ.  Both are linear in q read as a complex number, J = i.  There y is one complex
number for each of the s coordinates, a *virtual landmark* at the origin.  With x_b and
the rows of S read as complex numbers, the equations above hold unchanged.

Where the heading is poorly known, J y e_θ is most of the error e_y of y.  Its product
with S̃ is J m_b e_θ, where m_b = S̃ᵀ y is how far the points have moved.  This is often
far less than the terms of the product, whose rounding errors would then exceed the rest
of e_y.  The two are therefore kept apart: ỹ = e_y − J y e_θ takes the place of e_y, and
m_b becomes an additional row of S̃, which belongs to J e_θ.
"""

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from ....arrays import Array, IntArray
from ...filters.ekf import EkfSlam
from ..multifrontal import pairs
from .deferred_covariance import BLOCK, DeferredCovariance, Downdate, fill_extended


class Phase(NamedTuple):
    """The belief of the filter at the end of a phase, (x_a, y) in its own order.

    The pose comes first, then y, then the local landmarks.  The arrays are views of the
    filter's memory, which the next phase does not use.
    """

    mean: Array  # (size,)
    covariance: Array  # (size, size)
    reference: Array  # (size,) linearisation points, for filters that fix them
    first: int  # row of the first local landmark, 3 + e
    scale: Array  # T, (s, s), lower triangular
    invariant: bool  # whether what refers to y is read as complex numbers

    def coefficients(self, numbers: Array) -> Array:
        """Return rows (k, e) as the coefficients (k, s) of rows of S̃."""
        if self.invariant:
            return numbers.view(np.complex128)
        return numbers[:, : len(self.scale)]

    def cross(self, rows: IntArray) -> Array:
        """Return the covariance of rows with e_y, or with ỹ and J e_θ if invariant."""
        cross = self.covariance[rows, 3 : self.first]
        if not self.invariant:
            return cross
        heading = self.covariance[rows, 2:3]  # J e_θ is (0, e_θ)
        return np.hstack([cross - heading * self._turn, 0.0 * heading, heading])

    def gain(self, rows: IntArray) -> Array:
        """Return rows of Φ, shape (k, s); one column more in the invariant frame."""
        return self.coefficients(self.cross(rows))

    @property
    def loss(self) -> Array:
        """Ψ, shape (e, e), or (e + 2, e + 2) in the invariant frame."""
        heading, loss = np.split(-self.cross(np.arange(2, self.first)), [1])
        if not self.invariant:
            return loss
        return np.vstack([loss - self._turn.T * heading, 0.0 * heading, heading])

    @property
    def _turn(self) -> Array:
        """J y, the multiple of e_θ in e_y, shape (1, e)."""
        return (1j * self.shift).view(np.float64)

    @property
    def shift(self) -> Array:
        """The mean of y, shape (1, s)."""
        return self.coefficients(self.mean[None, 3 : self.first])

    def roots(self) -> tuple[Array, Array]:
        """Factor Ψ = U diag(σ) Uᵀ at its numerical rank.

        The rank of Ψ is that of the measurements of the phase, far below its size.  In
        the invariant frame, Ψ is indefinite.

        Returns
        -------
        root : ndarray, shape (rank, s)
            Uᵀ; one column more in the invariant frame.
        signs : ndarray, shape (rank,)
            σ, each 1 or -1.
        """
        root, signs = (_by_eigenvalues if self.invariant else _by_pivots)(self.loss)
        return self.coefficients(root), signs

    def scaled(self, strip: Array) -> Array:
        """Return S̃ = T⁻¹ S."""
        return _solve(self.scale, strip, side=1)

    def unscaled(self, coefficients: Array) -> Array:
        """Return Φ T⁻¹, whose product with S is that of Φ with S̃."""
        size = len(self.scale)
        solution = _solve(self.scale, coefficients[:, :size], side=0)
        return np.hstack([solution, coefficients[:, size:]])

    def extended(self, strip: Array, moved: Array) -> Array:
        """Return S or S̃; in the invariant frame, with m_b as an additional row."""
        return np.vstack([strip, moved]) if self.invariant else strip


def combine(coefficients: Array, strip: Array) -> Array:
    """Return Φ S, shape (k, width), of coefficients (k, s) and the strip (s, width)."""
    product: Array = coefficients @ strip.view(coefficients.dtype)
    return product.view(np.float64)


def _by_pivots(loss: Array) -> tuple[Array, Array]:
    """Pivoted Cholesky decomposition of a semidefinite matrix."""
    from scipy.linalg.lapack import dpstrf  # noqa: PLC0415 (slow to import)

    factor, pivots, rank, _ = dpstrf(loss, lower=True)
    root = np.empty((rank, len(loss)))
    order = np.arange(len(loss))  # faster than `numpy.tri`
    root[:, pivots - 1] = (factor.T * (order[:, None] <= order))[:rank]
    return root, np.ones(rank)


def _by_eigenvalues(loss: Array) -> tuple[Array, Array]:
    """Eigenvalue decomposition of a symmetric matrix, without its rows of zeros."""
    measured = loss[:-1, :-1].any()  # otherwise no point has moved
    used = np.flatnonzero(loss.any(axis=0) & measured)
    values, vectors = np.linalg.eigh(loss[used[:, None], used])
    least = np.finfo(np.float64).eps * len(used) * np.abs(values).max(initial=0.0)
    large = np.abs(values) > least
    root = np.zeros((large.sum(), len(loss)))
    root[:, used] = (vectors[:, large] * np.sqrt(np.abs(values[large]))).T
    return root, np.sign(values[large])


def _solve(scale: Array, rows: Array, side: int) -> Array:
    """Solve X T = rows, or T X = rows at side 1, for a lower triangular T."""
    from scipy.linalg.blas import dtrsm, ztrsm  # noqa: PLC0415 (slow to import)

    if not rows.size:
        return rows
    trsm = dtrsm if rows.dtype == np.float64 else ztrsm
    # The transposes are contiguous in Fortran order: BLAS copies none of them.
    solution: Array = trsm(1.0, scale.T, rows.T, side=side).T
    return solution


# What T Tᵀ adds to a variance, relative to it, so that T is invertible.
ADDED = 1e-12
# Variance of an exactly known coordinate in T Tᵀ; all its covariances are 0.
EXACT = 1e-24


def scale_of(covariance: Array) -> Array:
    """Return T, lower triangular and invertible, with T Tᵀ as close to P as it can be.

    Only the lower half of P is used.  A diagonal T is as right, and less accurate; it
    serves where P is indefinite.

    Examples
    --------
    >>> scale_of(np.array([[4.0, 2.0], [2.0, 10.0]])).round(9)
    array([[2., 0.],
           [1., 3.]])
    """
    from scipy.linalg.lapack import dpotrf  # noqa: PLC0415 (slow to import)

    sums = covariance.copy()
    variances = sums.ravel()[:: len(sums) + 1]  # its diagonal
    variances += ADDED * variances
    variances[variances <= 0] = EXACT
    factor, status = dpotrf(sums.T)
    return np.diag(np.sqrt(variances)) if status else factor.T


def virtual_landmarks(coordinates: int, invariant: bool) -> int:
    """Return the number of landmarks whose places the extension takes."""
    return coordinates if invariant else (coordinates + 1) // 2


def begin_phase(
    slam: EkfSlam, mean: Array, rows: Array, reference: Array, ids: list[int]
) -> Array:
    """Replace the map of a filter by the extension and a local map; return T.

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
    before, virtual = gaussian.arrays, size - len(rows)
    own = np.empty((len(rows), len(rows)))
    own[:3, :3], own[3:, :3] = before.covariance[:3, :3], rows[:3].T
    own[:, 3:] = rows
    scale = scale_of(own) if virtual else np.zeros((0, 0))
    gaussian.hold(None, ids, block=gaussian.blank(len(ids), more=len(ids) // 2))
    now, rest = gaussian.arrays, slice(3 + virtual, size)
    now.mean[:3], now.mean[rest] = before.mean[:3], mean
    now.reference[:3], now.reference[rest] = before.reference[:3], reference
    fill_extended(now.covariance, own, scale, virtual)
    return scale


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
    >>> [blocks_in_a_step(width, hurried=False) for width in (272, 1088, 6120)]
    [1, 2, 11]
    """
    return max(1, width // BLOCK // (1 if hurried else SPREAD))


class Exchanged(NamedTuple):
    """The rows of a change of the local map."""

    own: IntArray  # ascending columns of the old local landmarks, shape (a - 3,)
    order: IntArray  # their rows in the old belief of the filter
    needed: IntArray  # its rows whose Φ S is needed
    left: int  # how many of these, the first, belong to new landmarks that leave
    new: IntArray  # ascending columns of the landmarks to store
    places: IntArray  # their rows among those needed
    entering: IntArray  # ascending columns of the landmarks that enter
    staying: IntArray  # columns of the landmarks that stay, in the order of their rows


def exchanged_rows(
    slots: Mapping[int, int],
    local: Iterable[int],
    chosen: Collection[int],
    stored: int,
    first: int,
    own: IntArray,
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
    own : ndarray of int
        Columns of the old ones in the map's arrays.
    """
    old = list(local)
    staying = [k for k, i in enumerate(old) if i in chosen]
    leaving = [k for k in range(stored, len(old)) if old[k] not in chosen]
    left, before = 2 * len(leaving), set(old)
    entering = sorted((i for i in chosen if i not in before), key=slots.__getitem__)
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
        pairs([slots[old[k]] for k in staying]),
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
    moved: Array  # by which the phase has moved the points, shape (width,)
    rows: Exchanged
    group: int  # number of blocks that are exchanged at a time
    done: int = 0  # number of blocks that have been exchanged
    is_factored: bool = False  # whether what follows is known
    lost: Downdate = field(init=False, repr=False)  # to be deferred at the end
    _coefficients: Array = field(init=False, repr=False)  # (Φ above Uᵀ) T⁻¹, (k + r, s)
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
        if self.done == count:  # two copies of a covariance would drift apart
            rows, needed = self.rows, len(self.rows.needed)
            across = self._values[rows.left + 3 : needed, rows.entering]
            self._values[needed:, rows.staying] = across.T

    def beginning(self, stored: DeferredCovariance) -> Array:
        """Return the covariance with which a new phase begins, shape (a', a' - 3).

        It is that of pose and new local landmarks, without the columns of the pose, and
        does not need the new strip.
        """
        kept, entering = self.rows.needed[self.rows.left :], self.rows.entering
        S = self.old.scaled(np.ascontiguousarray(self.strip[:, entering]))
        S = self.old.extended(S, self.moved[entering])
        block, P = stored.marginal(entering), self.old.covariance
        lost = combine(self.old.coefficients(self.old.loss), S).T.copy()
        block -= combine(self.old.coefficients(lost), S)  # S̃ᵀ Ψ S̃
        across = combine(self.old.gain(kept), S)
        return np.block([[P[np.ix_(kept, kept[3:])], across], [across[3:].T, block]])

    @property
    def nbytes(self) -> int:
        """Memory that the exchange holds, without the old strip [bytes]."""
        arrays = [self._values, self.moved, self.old.covariance]
        if self.is_factored:
            arrays += [self._coefficients, self.lost.root]
        return sum(array.nbytes for array in arrays)

    def _factor(self, width: int) -> None:
        root, signs = self.old.roots()
        rows = np.concatenate([self.old.gain(self.rows.needed), root])
        self._coefficients = self.old.unscaled(rows)
        self.lost = Downdate(np.empty((width, len(signs))), signs, [])
        self.is_factored = True

    def _exchange(self, stored: DeferredCovariance, blocks: range) -> None:
        here = slice(blocks.start * BLOCK, blocks.stop * BLOCK)
        rows, values = self.rows, self._values
        S = self.old.extended(self.strip[:, here], self.moved[here])
        needed = len(rows.needed)
        gain, root = self._coefficients[:needed], self._coefficients[needed:]
        values[:needed, here] = combine(gain, S)
        if self.old.invariant:
            self.lost.root[here] = combine(root, S).T
        else:  # without a copy
            np.matmul(S.T, root.T, out=self.lost.root[here])
        own = _within(rows.own, here)
        inside = self.old.covariance[rows.needed[:, None], rows.order[own]]
        values[:needed, rows.own[own]] = inside
        if len(rows.new):
            self.lost.root[rows.new[_within(rows.new, here)]] = 0.0
            stored.put(blocks, rows.new, values, rows.places)
        stored.read(blocks, rows.entering, values[needed:], self.lost)


def _within(columns: IntArray, here: slice) -> slice:
    """Return where ascending columns lie between two limits."""
    start, end = columns.searchsorted((here.start, here.stop)).tolist()
    return slice(start, end)
