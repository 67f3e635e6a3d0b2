"""A Gaussian over robot pose and landmarks, in arrays that grow with the map.

`GaussianMap` adds, removes and merges landmarks, and saves its state. `ScanWorkspace`
holds the arrays of one scan, and a `ScanReport` its results.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cached_property, partial
from itertools import compress, repeat
from typing import Any, NamedTuple

import numpy as np

from ...arrays import Array, IntArray
from ..interface import Belief, MapView, UpdateReport
from ..kernels.kalman_gain import (
    ABSORBED,
    ADDED,
    BLOCK,
    COLUMN,
    FIRST,
    GATED,
    INNOVATION,
    JACOBIAN,
    MEAN_BEFORE,
    META_WIDTH,
    NEAR,
    OUTCOME,
    ROOT,
    SKIPPED,
    SLOT,
    USED,
    WHITE,
    BeliefArrays,
    Rules,
    Workspace,
    new_ledger,
    new_workspace,
)
from ..models.rigid_motion import ErrorFrame
from ..support.memory_limit import aligned_zeros, landmarks_that_fit
from ..support.saved_states import COVARIANCE, IDS, NUMBERS, Table
from ..support.undo import Recall, Undo
from .landmark_merging import coincide

FIRST_ALLOCATION = 8  # landmarks


class GaussianMap:
    """Mean, covariance and linearisation points of a pose and its landmarks.

    The state is (x, y, θ, l1x, l1y, …), landmarks in the order of ``slots``.  The first
    ``size`` entries of every array are in use; the others are zero, room for more.

    Arrays, ``slots`` and ``size`` are replaced at once, so that an interrupt finds the
    map before a change or after it.  Kernels change the arrays in place, each in one
    call; the landmarks that a kernel adds follow from the places that it has written.

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

    def __init__(self) -> None:
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
        undo_places, arrays, n = self.bookmark(), self.arrays, self.size
        mean, P, reference = arrays
        parts: Sequence[Array] = (mean[:3], reference[:3], P[:3, :n], P[:n, :3])
        if not motion:
            parts = self.used
        saved = [part.copy() for part in parts]

        def undo() -> None:
            undo_places()
            for array in arrays:
                array[n:] = array.T[n:] = 0.0
            for part, before in zip(parts, saved, strict=True):
                part[...] = before

        return undo

    def bookmark(self) -> Undo:
        """Return what takes back later changes, but for those made by kernels."""
        return partial(self._become, self.arrays, self.slots)

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
        fitting = landmarks_that_fit(landmarks, landmarks + more)
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
        self.readings, self.capacity = room, capacity

    def place(self, gaussian: GaussianMap, ids: Sequence[int]) -> int:
        """Write the slots of a scan's landmarks to the ledger, with room for new ones.

        Parameters
        ----------
        gaussian : GaussianMap
            The map that the next update changes; it expects the new landmarks.
        ids : sequence of int
            The landmark of each reading.

        Returns
        -------
        int
            Length of the state.
        """
        slots, size = gaussian.slots_of(ids), gaussian.size
        new = slots.count(-1)
        gaussian.make_room(new)
        self.make_room(len(ids), gaussian.capacity)
        places = self.ledger[SLOT, : len(ids)]
        places[:] = slots
        if new:
            gaussian.expect(ids, places)
        self._ids = ids
        return size

    def watch(self) -> Recall[ScanReport]:
        """Return a function that gives the report of the next update when done."""
        if self.readings:
            self.arrays.rows[MEAN_BEFORE, ABSORBED] = 0.0
        return self._recalled

    def _recalled(self) -> ScanReport | None:
        if not (self.readings and self.arrays.rows[MEAN_BEFORE, ABSORBED]):
            return None
        ids = list(self._ids)
        used = int((self.ledger[OUTCOME, : len(ids)] == USED).sum())
        white = self.arrays.rows[FIRST : FIRST + 2 * used, WHITE]
        return self.report(float(white @ white), ids, used)

    def report(self, nis: float, ids: list[int], used: int) -> ScanReport:
        """Return the report of the last update, on copies of what it has left."""
        left = copy_scan(self.arrays.rows, self.ledger[:, : len(ids)], used)
        return ScanReport(nis, ids, left)

    def failed_reading(self, status: int, readings: int) -> int:
        """Return the reading whose innovation covariance could not be factored."""
        used = np.flatnonzero(self.ledger[OUTCOME, :readings] == USED)
        return int(used[status])


def workspace_for(rules: Rules, readings: int, capacity: int) -> Workspace:
    """Allocate what updates by these rules need, with this many readings at most."""
    return new_workspace(
        readings,
        capacity,
        iterated=rules.iterations > 1,
        spoilable=readings > BLOCK,
    )


def not_positive_definite(landmark_id: int) -> np.linalg.LinAlgError:
    """Return the error of an innovation covariance that cannot be factored."""
    return np.linalg.LinAlgError(
        "the innovation covariance is not positive definite at the reading of "
        f"landmark {landmark_id}: the belief or measurement_std is degenerate"
    )


class ScanRecord(NamedTuple):
    """The stacked system of one scan, copied out of the workspace."""

    rows: Array  # (2m, at least 3 + 2m + META_WIDTH)
    ledger: IntArray  # (LEDGER_HEIGHT, readings), its columns counted in these rows

    @property
    def innovation(self) -> Array:
        """Innovations ν, shape (m, 2)."""
        return self.rows[:, INNOVATION].reshape(-1, 2)

    def joint_factor(self) -> Array:
        """Return L of S = L Lᵀ, shape (2m, 2m), lower triangular.

        Off its diagonal blocks L = H Aᵀ, since Q is diagonal.
        """
        rows, count = self.rows, len(self.rows)
        H = rows[:, JACOBIAN : JACOBIAN + 5]
        columns = np.repeat(self.ledger[COLUMN, : count // 2], 2)
        every = np.arange(count)
        pose = H[:, :3] @ rows[:, :3].T
        x = H[every, 3, None] * rows[:, columns].T
        y = H[every, 4, None] * rows[:, columns + 1].T
        factor: Array = np.tril(pose + x + y)
        for k in range(0, count, 2):
            factor[k : k + 2, k : k + 2] = rows[k : k + 2, ROOT : ROOT + 2]
        return factor


def copy_scan(rows: Array, ledger: IntArray, used: int) -> tuple[Array, IntArray]:
    """Copy the parts of a :class:`ScanRecord` out of the workspace.

    Where the map is much larger than the scan, the copy has only the columns of the
    pose and of the landmarks read.

    Parameters
    ----------
    rows : ndarray
        Of the workspace.
    ledger : ndarray of int64
        One column for each reading of the scan.
    used : int
        Number of readings in use.
    """
    found, kept = rows[FIRST : FIRST + 2 * used], ledger.copy()
    if found.shape[1] <= 4 * (3 + 2 * used + META_WIDTH):
        return found.copy(), kept
    columns = ledger[COLUMN, :used]
    landmarks = np.stack([columns, columns + 1], axis=1).ravel()
    chosen = np.concatenate([[0, 1, 2], landmarks, np.arange(-META_WIDTH, 0)])
    kept[COLUMN, :used] = 3 + 2 * np.arange(used)
    return found[:, chosen], kept


class ScanReport(UpdateReport):
    """The results of one scan, from the arrays that its kernel has left; a snapshot.

    Parameters
    ----------
    nis : float
        νᵀ S⁻¹ ν.
    ids : list of int
        Landmark of each reading.
    copies : tuple of ndarray
        The parts of a :class:`ScanRecord`.
    """

    _ids: list[int]
    _copies: tuple[Array, IntArray]

    def __init__(
        self, nis: float, ids: list[int], copies: tuple[Array, IntArray]
    ) -> None:
        parts = self.__dict__
        parts["nis"], parts["_ids"], parts["_copies"] = nis, ids, copies

    @property
    def _record(self) -> ScanRecord:
        return ScanRecord(*self._copies)

    @cached_property
    def degrees_of_freedom(self) -> int:
        """Of the NIS: twice the number of associated readings."""
        return len(self._record.rows)

    @cached_property
    def associated_ids(self) -> tuple[int, ...]:
        """Mapped landmarks whose readings corrected the belief."""
        return self._with_outcome(USED)

    @cached_property
    def added_ids(self) -> tuple[int, ...]:
        """Landmarks that entered the map."""
        return self._with_outcome(ADDED)

    @cached_property
    def rejected_ids(self) -> tuple[int, ...]:
        """Mapped landmarks whose readings the chi-square gate rejected."""
        return self._with_outcome(GATED)

    @cached_property
    def skipped_ids(self) -> tuple[int, ...]:
        """Landmarks whose readings are too close to use."""
        return self._with_outcome(SKIPPED)

    @cached_property
    def near_ids(self) -> tuple[int, ...]:
        """Mapped landmarks within 10 σ of the robot."""
        return tuple(compress(self._ids, self._record.ledger[NEAR].tolist()))

    @cached_property
    def innovation(self) -> Array:
        """ν, shape (m, 2), rows (bearing, range) [rad, m]."""
        return self._record.innovation

    @property
    def factor(self) -> Callable[[], Array]:
        """The function that returns L, shape (2m, 2m), L Lᵀ = S."""
        return self._record.joint_factor

    def _with_outcome(self, outcome: int) -> tuple[int, ...]:
        chosen = self._record.ledger[OUTCOME] == outcome
        return tuple(compress(self._ids, chosen.tolist()))
