"""A Gaussian over robot pose and landmarks, in arrays that grow with the map."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property, partial
from itertools import repeat
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...arrays import Array, ComplexArray, IntArray
from ..interface import Belief, MapView
from ..kernels.kalman_gain import (
    BLOCK,
    OUTCOME,
    USED,
    BeliefArrays,
    Rules,
    Workspace,
    new_ledger,
    new_workspace,
    prior_system,
)
from ..kernels.scan_update import copy_scan
from ..models.rigid_motion import ErrorFrame, left_jacobian
from ..support.memory_limit import aligned_zeros, landmarks_that_fit
from ..support.saved_states import COVARIANCE, IDS, NUMBERS, Table
from ..support.undo import Undo

FIRST_ALLOCATION = 8  # landmarks


class GaussianMap:
    """Mean, covariance and linearisation points of a pose and its landmarks.

    The state is (x, y, θ, l1x, l1y, …), landmarks in the order of ``slots``.  The first
    ``size`` entries of every array are in use; the others are zero, room for more.

    Arrays, ``slots`` and ``size`` are replaced at once, so that an interrupt finds the
    map before a change or after it.  Kernels change the arrays in place, each in one
    call; the landmarks that a kernel adds follow from the places that it has written.

    Parameters
    ----------
    copies : int
        Number of covariances of this size that updates of the filter need, for the
        check of the available memory.

    Examples
    --------
    >>> gaussian = GaussianMap()
    >>> gaussian.reset(np.zeros(3), np.eye(3))
    >>> places = np.array([-1])
    >>> gaussian.expect([7], places)
    >>> places[0] = 0  # by a kernel that adds the landmark
    >>> gaussian.size, gaussian.slots
    (5, {7: 0})
    """

    arrays: BeliefArrays
    """Mean, covariance and linearisation points, as kernels take them."""

    def __init__(self, copies: int = 1) -> None:
        self.copies = copies
        self.reset(np.zeros(3), np.zeros((3, 3)))

    def reset(self, pose: Array, pose_covariance: Array) -> None:
        """Start with an empty map at a pose (3,)."""
        arrays = self._zeros(FIRST_ALLOCATION)
        self._become(_filled(arrays, (pose, pose_covariance, pose)), {})

    @cached_property
    def slots(self) -> dict[int, int]:
        """Place of each landmark in the state: column 3 + 2 slot."""
        before, ids, places = self._expected
        pairs = zip(ids, places.tolist(), strict=True)
        return before | {i: slot for i, slot in pairs if slot >= 0}

    @cached_property
    def size(self) -> int:
        """Length of the state, 3 + 2n."""
        return 3 + 2 * len(self.slots)

    @property
    def mean(self) -> Array:
        """Shape (capacity,); the heading is not wrapped."""
        return self.arrays.mean

    @property
    def covariance(self) -> Array:
        """Shape (capacity, capacity), of the additive error."""
        return self.arrays.covariance

    @property
    def reference(self) -> Array:
        """Shape (capacity,): linearisation points, for filters that fix them."""
        return self.arrays.reference

    @property
    def capacity(self) -> int:
        """Length of the arrays."""
        return len(self.arrays.mean)

    @staticmethod
    def capacity_for(landmarks: int) -> int:
        """Return the length of a mean with room for this many landmarks.

        Kernels need a multiple of 4, and one unused entry.
        """
        return (3 + 2 * landmarks) // 4 * 4 + 4

    def allocate(self, landmarks: int, more: int = 0) -> None:
        """Replace the arrays by zeros with room for landmarks.

        Parameters
        ----------
        landmarks : int
            Landmarks that must have room.
        more : int
            Landmarks to come, as far as memory allows.
        """
        self.arrays = self._zeros(landmarks, more)

    def make_room(self, landmarks: int) -> None:
        """Grow the arrays if this many more landmarks do not fit."""
        n = self.size
        if n + 2 * landmarks < len(self.arrays.mean):
            return
        grown = self._zeros(len(self.slots) + landmarks, more=len(self.slots))
        self.arrays = _filled(grown, self.used)

    def expect(self, ids: Sequence[int], places: IntArray) -> None:
        """Let the next kernel add landmarks.

        Parameters
        ----------
        ids : sequence of int, length m
            The landmarks of a scan.
        places : ndarray, shape (m,)
            Their slots, negative for landmarks that are not mapped.  The kernel writes
            the slots of those that it adds.
        """
        self._expected = self.slots, ids, places
        del self.size, self.slots  # they follow from what the kernel writes

    def relabel(self, ids: Iterable[int]) -> None:
        """Take the arrays to hold these landmarks instead, in this order."""
        self._become(self.arrays, {i: slot for slot, i in enumerate(ids)})

    def remove(self, ids: Sequence[int]) -> None:
        """Marginalise landmarks; all other numbers keep their last bit."""
        self._keep_without(self.used, ids)

    def checkpoint(self, *, motion: bool = False) -> Undo:
        """Return what takes back later changes; ``motion``: only those of the pose."""
        arrays, slots = self.arrays, self.slots
        mean, P, reference = self.used
        if not motion:
            copies = BeliefArrays(mean.copy(), P.copy(), reference.copy())
            return partial(self._refill, self.capacity, copies, slots)
        parts = mean[:3], reference[:3], P[:3], P[:, :3]
        saved = [part.copy() for part in parts]

        def undo() -> None:
            self._become(arrays, slots)
            for part, before in zip(parts, saved, strict=True):
                part[...] = before

        return undo

    @property
    def used(self) -> BeliefArrays:
        """The part of the arrays that is in use."""
        n = self.size
        mean, covariance, reference = self.arrays
        return BeliefArrays(mean[:n], covariance[:n, :n], reference[:n])

    def _refill(self, capacity: int, used: BeliefArrays, slots: dict[int, int]) -> None:
        """Continue with new arrays of this capacity."""
        self._become(_filled(_zeros(capacity), used), slots)

    def _keep_without(self, used: BeliefArrays, ids: Sequence[int]) -> None:
        gone, slots = set(ids), [self.slots[i] for i in ids]
        kept = BeliefArrays(*(without_landmarks(array, slots) for array in used))
        left = [i for i in self.slots if i not in gone]
        self._refill(self.capacity, kept, {i: slot for slot, i in enumerate(left)})

    def _zeros(self, landmarks: int, more: int = 0) -> BeliefArrays:
        fitting = landmarks_that_fit(landmarks, landmarks + more, self.copies)
        return _zeros(self.capacity_for(fitting))

    def _become(self, arrays: BeliefArrays, slots: dict[int, int]) -> None:
        """Replace all at once."""
        vars(self).update(arrays=arrays, slots=slots, size=3 + 2 * len(slots))

    def merge(
        self,
        kept: Sequence[int],
        gone: Sequence[int],
        *,
        frame: ErrorFrame,
        at_reference: bool,
    ) -> None:
        """Condition on landmarks being one in pairs, and remove the second of each.

        Parameters
        ----------
        kept, gone : sequence of int
            The landmarks.
        frame : {"additive", "invariant"}
            Error frame of the filter.
        at_reference : bool
            Whether the filter linearises at its reference points.
        """
        mean, covariance, reference = self.used
        merged = coincide(
            mean,
            covariance,
            [self.slots[i] for i in kept],
            [self.slots[i] for i in gone],
            frame=frame,
            reference=reference if at_reference else None,
        )
        self._keep_without(BeliefArrays(*merged, reference), gone)

    def slots_of(self, ids: Iterable[int]) -> list[int]:
        """Return the places of landmarks, -1 for those not in the map."""
        return list(map(self.slots.get, ids, repeat(-1)))

    def rename(self, names: Mapping[int, int]) -> None:
        """Give landmarks other identities."""
        self.slots = {names.get(i, i): slot for i, slot in self.slots.items()}

    def view(self) -> MapView:
        """Return the whole map without a copy."""
        return MapView(self.mean, self.covariance, list(self.slots))

    def belief(
        self, frame: ErrorFrame = "additive", ids: Sequence[int] | None = None
    ) -> Belief:
        """Return a snapshot of the whole map, or of the pose and some landmarks."""
        if ids is not None:
            return Belief.marginal(self.mean, self.covariance, self.slots, ids, frame)
        n = self.size
        return Belief(self.mean[:n], self.covariance[:n, :n], tuple(self.slots), frame)

    def state_dict(self) -> dict[str, Any]:
        """Return copies of the used part of the arrays."""
        n = self.size
        return {
            "mean": self.mean[:n].copy(),
            "covariance": self.covariance[:n, :n].copy(),
            "reference": self.reference[:n].copy(),
            "landmark_ids": np.array(list(self.slots), dtype=np.int64),
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned, without checks."""
        ids: list[int] = np.asarray(state["landmark_ids"]).tolist()
        saved = state["mean"], state["covariance"], state["reference"]
        arrays = _filled(self._zeros(max(FIRST_ALLOCATION, len(ids))), saved)
        self._become(arrays, {i: slot for slot, i in enumerate(ids)})


MAP_STATE: Table = {
    "landmark_ids": (IDS, "n"),
    "mean": (NUMBERS, "3+2n"),
    "covariance": (COVARIANCE, "3+2n", "3+2n"),
    "reference": (NUMBERS, "3+2n"),
}
"""What a saved map must be."""


def without_landmarks(array: Array, slots: Iterable[int]) -> Array:
    """Drop the entries of landmarks from a mean, or rows and columns from a covariance.

    Dropping entries of a Gaussian marginalises them: all other numbers keep their last
    bit.

    Parameters
    ----------
    array : ndarray, shape (3 + 2n,) or (3 + 2n, 3 + 2n)
    slots : iterable of int
        The landmarks to drop.

    Examples
    --------
    >>> without_landmarks(np.arange(7.0), [0])
    array([0., 1., 2., 5., 6.])
    """
    columns = [column for slot in slots for column in (3 + 2 * slot, 4 + 2 * slot)]
    for axis in range(array.ndim):
        array = np.delete(array, columns, axis=axis)
    return array


def _zeros(capacity: int) -> BeliefArrays:
    """Return arrays of zeros of this length."""
    covariance = aligned_zeros(capacity, capacity)
    return BeliefArrays(np.zeros(capacity), covariance, np.zeros(capacity))


def _filled(arrays: BeliefArrays, contents: Sequence[Array]) -> BeliefArrays:
    """Put smaller arrays into zeros, and return these."""
    for array, content in zip(arrays, contents, strict=True):
        array[tuple(slice(size) for size in content.shape)] = content
    return arrays


class ScanWorkspace:
    """Ledger and intermediate results of one update.

    Parameters
    ----------
    rules : Rules
        They decide which arrays an update needs.
    """

    def __init__(self, rules: Rules) -> None:
        self._rules = rules
        self.readings = self.capacity = 0
        """Most readings in a scan, and length of the mean."""

    def make_room(self, readings: int, capacity: int) -> None:
        """Grow the arrays where a scan could overflow them."""
        if readings < self.readings and capacity == self.capacity:
            return
        room = 8 + 2 * readings
        self.arrays = workspace_for(self._rules, room, capacity)
        self.ledger = new_ledger(room)
        height = len(self.arrays.rows)
        self._first_row = prior_system(height, self._rules.iterations)
        self.readings, self.capacity = room, capacity

    def copies(self, used: int, readings: int) -> tuple[Array, IntArray]:
        """Return copies of what the last update has left, for a :class:`ScanRecord`."""
        ledger, first = self.ledger[:, :readings], self._first_row
        return copy_scan(self.arrays.rows, ledger, used, first)

    def failed_reading(self, status: int, readings: int) -> int:
        """Return the reading whose innovation covariance could not be factored."""
        used = np.flatnonzero(self.ledger[OUTCOME, :readings] == USED)
        return int(used[status])


def workspace_for(rules: Rules, readings: int, capacity: int) -> Workspace:
    """Allocate what updates by these rules need, with this many readings at most."""
    repeated = rules.iterations > 1 or rules.sequential
    return new_workspace(
        readings,
        capacity,
        iterated=rules.iterations > 1,
        spoilable=repeated or readings > BLOCK,
    )


def covariances_for(rules: Rules) -> int:
    """Return how many arrays of the size of P an update needs: P, and copies of it."""
    iterated = rules.iterations > 1
    return 1 + iterated + (iterated or rules.sequential)


def not_positive_definite(landmark_id: int) -> np.linalg.LinAlgError:
    """Return the error of an innovation covariance that cannot be factored."""
    return np.linalg.LinAlgError(
        "the innovation covariance is not positive definite at the reading of "
        f"landmark {landmark_id}: the belief or measurement_std is degenerate"
    )


# --------------------------------------------------------------------------------------
# Merge landmarks of a Gaussian map: their offset, and the condition that it is 0.
#
# Pure functions of mean (3 + 2n,) and covariance P (3 + 2n, 3 + 2n) in the order
# (x, y, θ, l1x, l1y, …); a landmark is named by its slot 0 … n − 1.

MOST_ITERATIONS = 50
TURN_TOLERANCE = 1e-13
"""Iterations of a turn end when it changes by less [rad]."""


class ConditionedMap(NamedTuple):
    """Mean and covariance of robot and map after conditioning."""

    mean: Array
    """Shape (3 + 2n,)."""
    covariance: Array
    """Shape (3 + 2n, 3 + 2n), of the additive error."""


class Separation(NamedTuple):
    """Offset of two landmarks and its covariance."""

    offset: Array
    """D = l_i − l_j, shape (2,) [m]."""
    covariance: Array
    """C, shape (2, 2) [m²]."""

    @property
    def squared(self) -> float:
        """Dᵀ C⁻¹ D: χ² of 2 degrees of freedom if both are one; ∞ if C is singular."""
        (a, b), (_, c) = self.covariance
        determinant = a * c - b * b
        if not determinant > 0:
            return np.inf
        x, y = self.offset
        return float((c * x * x - 2 * b * x * y + a * y * y) / determinant)

    @property
    def largest_std(self) -> float:
        """Standard deviation in the most uncertain direction [m]."""
        return float(np.sqrt(max(np.linalg.eigvalsh(self.covariance)[-1], 0.0)))


def separation(mean: Array, covariance: Array, one: int, other: int) -> Separation:
    """Return the offset of two landmarks and its covariance.

    ::

        D = l_i − l_j,    C = P_ii + P_jj − P_ij − P_ji

    Parameters
    ----------
    mean, covariance : ndarray
        The map; entries behind it are ignored.
    one, other : int
        Slots i and j.
    """
    i, j = slice(3 + 2 * one, 5 + 2 * one), slice(3 + 2 * other, 5 + 2 * other)
    cross = covariance[i, j]
    spread = covariance[i, i] + covariance[j, j] - cross - cross.T
    return Separation(mean[i] - mean[j], spread)


def coincide(
    mean: Array,
    covariance: Array,
    one: int | Sequence[int],
    other: int | Sequence[int],
    *,
    frame: ErrorFrame = "additive",
    reference: Array | None = None,
) -> ConditionedMap:
    """Condition a map on two of its landmarks being one, or on several such pairs.

    The condition is a measurement 0 = l_i − l_j without noise.  With D = l̂_i − l̂_j::

        H = [… −J D …  I … −I …],   S = H P Hᵀ = L Lᵀ,   A = L⁻¹ H P
        δ = −Aᵀ L⁻¹ M D,    P ← P − Aᵀ A

    The columns are those of θ, l_i and l_j.  The condition holds no information about a
    rotation of the whole map, and neither must H.  Its heading column is therefore
    −J D, with D taken at the points where the filter linearises.  The additive EKF has
    no heading column, since the condition is linear in its error, and M = 1.  In the
    invariant frame δ is composed with the state and P follows, as in
    :class:`~slamgym.estimator.filters.ekf.InvariantEkfSlam`.  There the condition
    R(t) D + V(t) (ξ_i − ξ_j) = 0 holds for M = V(−t)⁻¹, where t is the turn in δ, which
    is found by iteration.  Several pairs have their rows of D and H below each other.

    Parameters
    ----------
    mean, covariance : ndarray
        The map.
    one, other : int or sequence of int
        Slots i and j of the two landmarks, or of each pair.
    frame : {"additive", "invariant"}
        Error frame of the filter.
    reference : ndarray, shape (3 + 2n,), optional
        Points at which the filter linearises, where not at its estimate.

    Returns
    -------
    ConditionedMap
        Both landmarks of a pair have the same mean and covariance in it; drop either.

    Raises
    ------
    numpy.linalg.LinAlgError
        If C is not positive definite.

    Examples
    --------
    Two equally good estimates of one landmark meet halfway, with half the variance:

    >>> P = np.diag([0, 0, 0, 1.0, 1.0, 1.0, 1.0])
    >>> mean, P = coincide(np.array([0, 0, 0, 4.0, 0, 6.0, 0]), P, 0, 1)
    >>> mean[3:], P.diagonal()[3:]
    (array([5., 0., 5., 0.]), array([0.5, 0.5, 0.5, 0.5]))
    """
    i, j = _columns(one), _columns(other)
    offset = mean[i] - mean[j]
    rows = covariance[i] - covariance[j]
    if frame == "invariant" or reference is not None:
        at = mean if reference is None else reference
        lever = (at[i] - at[j]).reshape(-1, 2)[:, ::-1] * (1.0, -1.0)
        lever = lever.ravel()
        rows = rows + np.outer(lever, covariance[2])
        S = rows[:, i] - rows[:, j] + np.outer(rows[:, 2], lever)
    else:
        S = rows[:, i] - rows[:, j]
    L = np.linalg.cholesky((S + S.T) / 2)
    gains = np.linalg.solve(L, rows)
    P = covariance - gains.T @ gains
    if frame == "additive":
        return ConditionedMap(mean - gains.T @ np.linalg.solve(L, offset), P)
    shift = _turned_shift(L, gains, offset)
    return _composed(mean, P, shift)


def _turned_shift(
    L: NDArray[np.floating], gains: NDArray[np.floating], offset: Array
) -> Array:
    """Return δ, iterated until its turn is the one at which M was computed."""
    points, turn = offset[::2] + 1j * offset[1::2], 0.0
    for _ in range(MOST_ITERATIONS):
        seen = points / left_jacobian(np.array(-turn))
        flat = np.column_stack([seen.real, seen.imag]).ravel()
        white = np.linalg.solve(L, flat)
        before, turn = turn, float(-gains[:, 2] @ white)
        if abs(turn - before) <= TURN_TOLERANCE:
            break
    return np.asarray(-gains.T @ white)


def _columns(slots: int | Sequence[int]) -> IntArray:
    """Return the columns of landmarks in the state."""
    first = 3 + 2 * np.atleast_1d(np.asarray(slots, dtype=np.int64))
    return np.asarray((first[:, None] + np.arange(2)).ravel())


def _composed(mean: Array, covariance: Array, shift: Array) -> ConditionedMap:
    """Compose an invariant correction with the state, and transform P to match.

    ::

        q ← R(t) q + V(t) (δq − t J q),    θ ← θ + t,    t = δθ
        P ← T P Tᵀ,    T = I + v e_θᵀ,    v = J (q⁺ − q)
    """
    turn = shift[2]
    points, moves = _points(mean), _points(shift)
    turned = np.exp(1j * turn) * points
    moved = turned + left_jacobian(turn) * (moves - 1j * turn * points)
    way = _state(1j * (moved - points), 0.0)
    cross = np.outer(way, covariance[2])
    P = covariance + (cross + cross.T) + covariance[2, 2] * np.outer(way, way)
    return ConditionedMap(_state(moved, mean[2] + turn), P)


def _points(state: Array) -> ComplexArray:
    """Robot position and landmarks as complex numbers, shape (1 + n,)."""
    plane = np.delete(state, 2).reshape(-1, 2)
    return np.asarray(plane[:, 0] + 1j * plane[:, 1])


def _state(points: ComplexArray, heading: float) -> Array:
    flat = np.column_stack([points.real, points.imag]).ravel()
    return np.insert(flat, 2, heading)
