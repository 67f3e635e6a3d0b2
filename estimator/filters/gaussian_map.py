"""A Gaussian over robot pose and landmarks, in arrays that grow with the map.

`GaussianMap` holds the memory of a filter: a single block, which Python passes to
kernels as one argument.  `update_map` takes in one scan, and `move_pose` one odometry
reading.  A `ScanReport` holds the results of a scan.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from functools import cached_property
from itertools import accumulate
from typing import Any, ClassVar, NamedTuple, cast
from weakref import ref

import numpy as np

from ...argument_checks import (
    aligned_copy,
    aligned_zeros,
    covariance_bytes,
    too_large,
    with_copies,
)
from ...arrays import Array, IntArray
from ...jit import jit_in_place, njit_inlined, njit_internal
from ..beliefs import Belief, MapView, UpdateReport, columns_of
from ..kernels import scan_update as scan
from ..kernels.scan_update import DONE, BeliefArrays, Rules, update_lower_half
from ..models.rigid_motion import ErrorFrame, predict

FIRST_LANDMARKS = FIRST_READINGS = 8  # that a new map has room for

# Status of an update besides those of `update_belief`.
REPEATED, NO_ROOM = -3, -4

# The block begins with these integers.

CAPACITY = 0  # length of the mean
HEIGHT = 1  # of the rows of the workspace
BEFORE = 2  # height of its copy of P
LANDMARKS = 3  # number of landmarks in the map
TABLED = 4  # how many of them are in the table
STEPS = 5  # how many odometry readings and scans the belief has taken in
SCANNED, IN_USE = 6, 7  # number of readings in the last scan, and of those in use
LOWER = 8  # 1 if only the lower half of P and the rows of the pose are up to date
STARTS = 13  # where each part begins, and the end
NUMBERS = 24

# Values in floating point; the rules come first.
MOTION = len(Rules._fields)  # (σx², σy², σα²) per step
MOVED = MOTION + 3  # the same for the last motion
NIS = MOVED + 3  # of the last scan
VALUES = 24

#: Takes block, readings and ids in; returns the status.
UpdateKernel = Callable[..., int]

#: Attributes of a map that follow from its block.
_FROM_BLOCK = {"parts", "_slots", "newest"}


class GaussianMap:
    """Mean, covariance and linearisation points of a pose and its landmarks.

    The state is (x, y, θ, l1x, l1y, …), landmarks in the order of ``slots``.  The first
    ``size`` entries of every array are in use; the others are zero, room for more.

    All of it lies in one block of memory, with room for the work of an update.  Kernels
    change the block in place, each in one call; all else replaces it at once.  An
    interrupt therefore finds the map before a change or after it.

    Parameters
    ----------
    values : sequence of float
        The rules of the filter, and the variances of its motion noise.

    Examples
    --------
    >>> from slamgym.estimator.kernels.scan_update import DONE
    >>> gaussian = GaussianMap((*Rules(), 0.1, 0.1, 0.1))
    >>> gaussian.take_in(update_map, np.array([[0.0, 2.0]]), np.array([7])) == DONE
    True
    >>> gaussian.slots, gaussian.mean[3:5]
    ({7: 0}, array([2., 0.]))
    """

    #: The memory, as kernels take it.
    block: Array
    #: Its parts by name.
    parts: Parts
    _slots: dict[int, int]
    newest: Callable[[], Any]  # returns the last report, or None if it is not in use
    _anew: ClassVar[Mapping[str, Any]] = {}  # attributes to reset with a new block

    def __init__(self, values: Sequence[float]) -> None:
        capacity = self.capacity_for(FIRST_LANDMARKS)
        self._become(new_block(capacity, FIRST_READINGS, np.array(values)))

    def _become(
        self, block: Array, parts: Parts | None = None, last: Any = None, **named: Any
    ) -> None:
        parts = parts or parts_of(block)

        def newest() -> Any:  # `last`, but None after the next scan
            return None if parts.numbers[SCANNED] else last

        named = {**self._anew, **named, "_slots": {}, "newest": newest}
        vars(self).update(named, block=block, parts=parts)

    def __getstate__(self) -> dict[str, Any]:
        """Return the memory and all else by name, without what follows from them."""
        return {k: v for k, v in vars(self).items() if k not in _FROM_BLOCK}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Continue with a memory."""
        self._become(aligned_copy(state["block"]), **_without_block(state))

    def snapshot(self) -> dict[str, Any]:
        """Return a copy of the memory and all else by name, for :meth:`resume`."""
        block = aligned_zeros(len(self.block))
        copy_memory(self.block, block)
        return {**with_copies(_without_block(self.__getstate__())), "block": block}

    def resume(self, snapshot: Mapping[str, Any]) -> None:
        """Return to a :meth:`snapshot`, in place where the layout is the same."""
        self.detach_report()
        memory, starts = snapshot["block"], slice(STARTS, NUMBERS)
        if memory[starts].tobytes() == self.block[starts].tobytes():
            self._slots, self.newest = {}, type(None)
            copy_memory(memory, self.block)
            vars(self).update(_without_block(snapshot))
        else:
            self.__setstate__(dict(snapshot))

    def reset(self, pose: Array, pose_covariance: Array) -> None:
        """Start with an empty map at a pose (3,)."""
        self.hold(BeliefArrays(pose, pose_covariance, pose), ())

    def adopt(self, values: Sequence[float]) -> None:
        """Continue by other rules and variances."""
        rooms = self.capacity, len(self.parts.scan_ids)
        self.hold(self.used, self.slots, block=new_block(*rooms, np.array(values)))

    @property
    def slots(self) -> dict[int, int]:
        """Place of each landmark in the state: column 3 + 2 slot."""
        count = int(self.parts.numbers[LANDMARKS])
        if len(self._slots) < count:  # a kernel has added landmarks
            self._slots = {i: k for k, i in enumerate(self.parts.ids[:count].tolist())}
        return self._slots

    @property
    def landmark_slots(self) -> dict[int, int]:
        """The same, for a map that may hold other points than landmarks."""
        return self.slots

    @property
    def size(self) -> int:
        """Length of the state, 3 + 2n."""
        return 3 + 2 * int(self.parts.numbers[LANDMARKS])

    @property
    def steps(self) -> int:
        """Number of steps taken; it changes together with the belief."""
        return int(self.parts.numbers[STEPS])

    @property
    def arrays(self) -> BeliefArrays:
        """Mean, covariance and linearisation points."""
        return BeliefArrays(self.mean, self.covariance, self.reference)

    @property
    def mean(self) -> Array:
        """Shape (capacity,); the heading is not wrapped."""
        return self.parts.mean

    @property
    def covariance(self) -> Array:
        """Shape (capacity, capacity), of the additive error."""
        if self.parts.numbers[LOWER]:
            complete(self.block)
        return self.parts.covariance

    @property
    def reference(self) -> Array:
        """Shape (capacity,): linearisation points, for filters that fix them."""
        return self.parts.reference

    @property
    def capacity(self) -> int:
        """Length of the arrays."""
        return len(self.parts.mean)

    @property
    def room(self) -> int:
        """Number of landmarks that the arrays have room for."""
        return (self.capacity - 4) // 2

    @staticmethod
    def capacity_for(landmarks: int) -> int:
        """Return the length of a mean with room for this many landmarks.

        Kernels need a multiple of 4, and one unused entry.
        """
        return (3 + 2 * landmarks) // 4 * 4 + 4

    def blank(self, landmarks: int, more: int = 0, readings: int = 0) -> Array:
        """Return the memory of an empty map, for :meth:`hold`.

        Parameters
        ----------
        landmarks : int
            Landmarks that must have room.
        more : int
            Further landmarks that should have room, as far as memory allows.
        readings : int
            Readings of a scan that must have room.
        """
        most = len(self.parts.scan_ids)
        if readings > most:
            most = 8 + 2 * readings
        capacity = self.capacity_for(landmarks + more) // 8 * 8  # it is rounded up
        capacity = max(capacity, self.capacity_for(landmarks))
        try:
            return new_block(capacity, most, self.parts.values[:NIS])  # no NIS yet
        except MemoryError:
            if more:
                return self.blank(landmarks, readings=readings)
            what = f"a covariance of {landmarks} landmarks"
            raise too_large(what, covariance_bytes(landmarks)) from None

    def hold(
        self,
        belief: BeliefArrays | None,
        ids: Collection[int],
        *,
        block: Array | None = None,
        steps: int = 0,
        report: UpdateReport | None = None,
    ) -> None:
        """Continue with another belief.

        Parameters
        ----------
        belief : BeliefArrays or None
            Of the length 3 + 2n; None if the block holds it.
        ids : collection of int
            The n landmarks, in their order.
        block : ndarray, optional
            The memory to use.
        steps : int
            Number of steps that have led to this belief.
        report : UpdateReport, optional
            The report of the last of these steps; it has ``detach``, as a `ScanReport`.
        """
        self.detach_report()
        if block is None:
            block = self.blank(max(FIRST_LANDMARKS, len(ids)))
        parts = parts_of(block)
        for array, content in zip(parts[2:5], belief or (), strict=belief is not None):
            array[tuple(slice(size) for size in content.shape)] = content
        parts.ids[: len(ids)] = [*ids]
        parts.numbers[LANDMARKS], parts.numbers[STEPS] = len(ids), self.steps + steps
        self._become(block, parts, report)

    def make_room(self, readings: int) -> None:
        """Grow the arrays where a scan of new landmarks could overflow them."""
        room, more = self.room, 0
        if len(self.slots) + readings > room:
            room, more = len(self.slots) + readings, len(self.slots) // 2
        elif readings <= len(self.parts.scan_ids):
            return
        self.hold(self.used, self.slots, block=self.blank(room, more, readings))

    def take_in(self, update: UpdateKernel, readings: Array, ids: IntArray) -> int:
        """Update the map with a scan, as `update_map`; return the status."""
        if (last := self.newest()) is not None:  # `detach_report`, inlined
            last.detach()
        status = update(self.block, readings, ids)
        if status == NO_ROOM:
            self.make_room(len(ids))
            status = update(self.block, readings, ids)
        return status

    def report(self) -> UpdateReport:
        """Return the report of the scan that has just been taken in."""
        report = ScanReport.__new__(ScanReport)  # in half the time of an __init__
        report.__dict__["_parts"] = self.parts  # a frozen dataclass refuses setattr
        self.newest = ref(report)
        return report

    def detach_report(self) -> None:
        """Copy the results of the last report, if it is still in use."""
        if (last := self.newest()) is not None:
            last.detach()

    def last_report(self) -> UpdateReport:
        """Return the report of the last scan or reading of the pose once more."""
        last = self.newest()
        return self.report() if last is None or last.is_detached else last

    def rename(self, names: Mapping[int, int]) -> None:
        """Give landmarks other identities."""
        self.hold(self.used, [names.get(i, i) for i in self.slots])

    def remove(self, ids: Sequence[int]) -> None:
        """Marginalise landmarks; all other numbers keep their last bit."""
        self.keep_without(self.used, ids)

    @property
    def used(self) -> BeliefArrays:
        """The part of the arrays that is in use."""
        n = self.size
        mean, covariance, reference = self.arrays
        return BeliefArrays(mean[:n], covariance[:n, :n], reference[:n])

    def keep_without(self, used: BeliefArrays, ids: Sequence[int]) -> None:
        """Continue with a belief over the present map, without these landmarks."""
        gone, slots = set(ids), [self.slots[i] for i in ids]
        kept = BeliefArrays(*(without_landmarks(array, slots) for array in used))
        left = [i for i in self.slots if i not in gone]
        self.hold(kept, left, block=self.blank(self.room))

    def view(self) -> MapView:
        """Return the whole map without a copy."""
        return MapView(self.mean, self.covariance, list(self.slots))

    def belief(
        self, frame: ErrorFrame = "additive", ids: Sequence[int] | None = None
    ) -> Belief:
        """Return a snapshot of the whole map, or of the pose and some landmarks."""
        if ids is None:
            P, whole = self.covariance[: self.size, : self.size], cast(Any, self.slots)
            return Belief(self.mean[: self.size], P, whole, frame)
        slots = [self.slots[i] for i in ids]
        columns = np.array(columns_of(slots))
        if not self.parts.numbers[LOWER] or 8 * len(ids) >= len(self.slots):
            P = self.covariance[columns[:, None], columns]
        else:
            at = np.maximum.outer(columns, columns), np.minimum.outer(columns, columns)
            P = self.parts.covariance[at]  # its lower half
        return Belief.owning(self.mean[columns], P, tuple(ids), frame)

    def state_dict(self) -> dict[str, Any]:
        """Return copies of the used part of the arrays."""
        found = {name: part.copy() for name, part in self.used._asdict().items()}
        return {**found, "landmark_ids": np.array(list(self.slots), dtype=np.int64)}

    def checked(self, state: Mapping[str, Any], **of: str) -> dict[str, Any]:
        """Return a saved state, or refuse it; ``of`` are classes that it must name."""
        from ..guards import saved_states  # noqa: PLC0415 (few drives load a state)

        return saved_states.read(state, saved_states.MAP_STATE, of=of)

    def restore(self, state: Mapping[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned, without checks."""
        saved = state["mean"], state["covariance"], state["reference"]
        self.hold(BeliefArrays(*saved), np.asarray(state["landmark_ids"]).tolist())


def _without_block(state: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in state.items() if name != "block"}


# --------------------------------------------------------------------------------------
# The memory of a filter, and the two steps that kernels take in it.


class Parts(NamedTuple):
    """The parts of a block, in their order; each begins on a cache line."""

    numbers: IntArray  # (NUMBERS,)
    values: Array  # (VALUES,)
    mean: Array  # this and the next two as in BeliefArrays
    covariance: Array
    reference: Array
    rows: Array  # this and the next as in Workspace
    before: Array
    ids: IntArray  # (capacity,) identity of the landmark in each slot
    table: IntArray  # slots + 1 by a hash of these identities; 0 is empty
    scan_ids: IntArray  # (readings,) of the last scan
    ledger: IntArray  # (LEDGER_HEIGHT, readings) of the last scan


def new_block(capacity: int, readings: int, values: Array) -> Array:
    """Allocate the memory of a filter with an empty map.

    Parameters
    ----------
    capacity, readings : int
        Least length of the mean, and of the list of readings in a scan.
    values : ndarray
        The rules, and the variances of the motion per step.
    """
    iterated = values[scan.ITERATIONS] > 1
    capacity, readings = (-(-size // 8) * 8 for size in (capacity, readings))
    height = scan.FIRST + (2 if iterated else 1) * (2 * readings + 2)
    before, table = min(capacity, scan.LARGE + 6), 1 << capacity.bit_length()
    rows, ledger = height * (capacity + scan.META_WIDTH), scan.LEDGER_HEIGHT * readings
    sizes = [VALUES, capacity, capacity**2, capacity, rows]
    sizes += [before**2, capacity, table, readings, ledger]
    starts = [*accumulate(sizes, initial=NUMBERS)]
    block = aligned_zeros(starts[-1])
    numbers = block[:NUMBERS].view(np.int64)
    numbers[: BEFORE + 1] = capacity, height, before
    numbers[STARTS:] = starts
    block[NUMBERS : NUMBERS + len(values)] = values
    return block


def parts_of(block: Array) -> Parts:
    """Return the parts of a block by name, without a copy."""
    numbers = block[:NUMBERS].view(np.int64)
    n, height, before = numbers[CAPACITY], numbers[HEIGHT], numbers[BEFORE]
    at = numbers[STARTS:]
    return Parts(
        numbers,
        block[at[0] : at[1]],
        block[at[1] : at[2]],
        block[at[2] : at[3]].reshape((n, n)),
        block[at[3] : at[4]],
        block[at[4] : at[5]].reshape((height, n + scan.META_WIDTH)),
        block[at[5] : at[6]].reshape((before, before)),
        block[at[6] : at[7]].view(np.int64),
        block[at[7] : at[8]].view(np.int64),
        block[at[8] : at[9]].view(np.int64),
        block[at[9] : at[10]].view(np.int64).reshape((scan.LEDGER_HEIGHT, -1)),
    )


parts_jit = njit_inlined(parts_of)


def copy_memory(block: Array, to: Array) -> None:
    """Copy all to a block of the same layout, but for room that is not in use."""
    parts = parts_of(block)
    begin, _, end = parts.numbers[STARTS + 4 : STARTS + 7].tolist()
    begin += parts.rows[: scan.FIRST + 2 * parts.numbers[IN_USE]].size
    to[:begin], to[end:] = block[:begin], block[end:]


@jit_in_place
def update_map(block: Array, readings: Array, ids: IntArray) -> int:
    """Update the belief of a filter with one scan, in place.

    Parameters
    ----------
    block : ndarray
        The memory of the filter (:class:`Parts`), which then also records the scan.
    readings : ndarray, shape (m, 2)
        Rows (β, r) [rad, m].
    ids : ndarray of int64, shape (m,)
        The landmark of each reading.

    Returns
    -------
    int
        DONE; REPEATED, if a landmark has two readings; NO_ROOM, if the new landmarks
        or the readings may not fit; or as of :func:`update_belief`.  Unless DONE, the
        belief has not changed.
    """
    parts, count = parts_jit(block), len(ids)
    numbers, slots = parts.numbers, parts.ledger[scan.SLOT]
    for k in range(count):
        for j in range(k):
            if ids[j] == ids[k]:
                return REPEATED
    mapped = numbers[LANDMARKS]
    if count > len(parts.scan_ids):
        return NO_ROOM
    if mapped + find_slots(parts, ids, slots) > (numbers[CAPACITY] - 4) // 2:
        return NO_ROOM
    complete_rows(parts, count)
    size = 3 + 2 * mapped
    status, used, nis = update_lower_half(
        parts[2:5], size, readings, count, parts.ledger, parts[5:7], parts.values
    )
    if status == DONE:
        if used > 0:
            numbers[LOWER] = size > scan.LARGE
        for k in range(count):
            parts.scan_ids[k] = ids[k]
            if parts.ledger[scan.OUTCOME, k] == scan.ADDED:
                parts.ids[slots[k]] = ids[k]
                numbers[LANDMARKS] += 1
        numbers[SCANNED], numbers[IN_USE], parts.values[NIS] = count, used, nis
        numbers[STEPS] += 1
    return int(status)


@jit_in_place
def complete(block: Array) -> None:
    """Copy the lower half of the covariance into the upper, if it is out of date."""
    parts = parts_jit(block)
    complete_rows(parts, parts.numbers[LANDMARKS])


@njit_internal
def complete_rows(parts: Parts, count: int) -> None:
    """Complete the rows of the landmarks of a scan, or all rows if these are many."""
    numbers, slots = parts.numbers, parts.ledger[scan.SLOT]
    size = 3 + 2 * numbers[LANDMARKS]
    if numbers[LOWER] and 8 * count >= numbers[LANDMARKS]:
        scan.mirror(parts.covariance, size)
        numbers[LOWER] = 0
    elif numbers[LOWER]:
        for k in range(count):
            if slots[k] >= 0:
                scan.refresh(parts.covariance, size, 3 + 2 * slots[k])


@njit_internal
def find_slots(parts: Parts, ids: IntArray, slots: IntArray) -> int:
    """Fill the slots of landmarks, -1 for new ones; count these.

    The table holds slots + 1 and is at most half full.  A search begins at the hash of
    an identity and ends at its slot or at an empty entry.
    """
    numbers, table, mask, new = parts.numbers, parts.table, len(parts.table) - 1, 0
    for slot in range(numbers[TABLED], numbers[LANDMARKS]):  # not in the table yet
        at = hash_of(parts.ids[slot]) & mask
        while table[at] > 0:
            at = (at + 1) & mask
        table[at] = slot + 1
    numbers[TABLED] = numbers[LANDMARKS]
    for k in range(len(ids)):
        at = hash_of(ids[k]) & mask
        while table[at] > 0 and parts.ids[table[at] - 1] != ids[k]:
            at = (at + 1) & mask
        slots[k] = table[at] - 1
        new += table[at] == 0
    return new


@njit_internal
def hash_of(landmark_id: int) -> int:
    """Mix the bits of an identity (Fibonacci hashing of both halves)."""
    low, high = landmark_id & 0xFFFFFFFF, (landmark_id >> 32) & 0xFFFFFFFF
    return (low * 0x278DDE6D + high * 0x1F123BB5) >> 20


@jit_in_place
def move_pose(
    block: Array, forward: float, sideways: float, turn: float, weight: float
) -> None:
    """Move the belief of a filter by a displacement in the robot's frame, in place.

    Parameters
    ----------
    block : ndarray
        The memory of the filter.
    forward, sideways, turn : float
        (dx, dy, α) [m, m, rad].
    weight : float
        Factor of the variances of the motion noise.
    """
    parts = parts_jit(block)
    values, size = parts.values, 3 + 2 * parts.numbers[LANDMARKS]
    for i in range(3):
        values[MOVED + i] = weight * values[MOTION + i]
    variance, linearisation = values[MOVED : MOVED + 3], int(values[0])
    predict(*parts[2:5], size, forward, sideways, turn, variance, linearisation)
    parts.numbers[STEPS] += 1


# --------------------------------------------------------------------------------------
# What the last scan has left in the memory.


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


class ScanRecord(NamedTuple):
    """Copies of the results of one scan."""

    scan_ids: IntArray  # the landmark of each reading
    rows: Array  # (2m, at least 3 + 2m + META_WIDTH), the stacked system
    ledger: IntArray  # (LEDGER_HEIGHT, readings), its columns counted in these rows

    @classmethod
    def copied(cls, parts: Parts) -> ScanRecord:
        """Copy the record of the last scan.

        Where the map is much larger than the scan, the copy has only the columns of
        the pose and of the landmarks read.
        """
        count, used = parts.numbers[SCANNED : IN_USE + 1].tolist()
        ids, ledger = parts.scan_ids[:count].copy(), parts.ledger[:, :count].copy()
        found = parts.rows[scan.FIRST : scan.FIRST + 2 * used]
        if found.shape[1] <= 4 * (3 + 2 * used + scan.META_WIDTH):
            return cls(ids, found.copy(), ledger)
        columns = ledger[scan.COLUMN, :used]
        landmarks = np.stack([columns, columns + 1], axis=1).ravel()
        chosen = np.concatenate([[0, 1, 2], landmarks, np.arange(-scan.META_WIDTH, 0)])
        ledger[scan.COLUMN, :used] = 3 + 2 * np.arange(used)
        return cls(ids, found[:, chosen], ledger)

    def joint_factor(self) -> Array:
        """Return L of S = L Lᵀ, shape (2m, 2m), lower triangular.

        Off its diagonal blocks L = H Aᵀ, since Q is diagonal.
        """
        rows, count = self.rows, len(self.rows)
        H = rows[:, scan.JACOBIAN : scan.JACOBIAN + 5]
        columns = np.repeat(self.ledger[scan.COLUMN, : count // 2], 2)
        every = np.arange(count)
        pose = H[:, :3] @ rows[:, :3].T
        x = H[every, 3, None] * rows[:, columns].T
        y = H[every, 4, None] * rows[:, columns + 1].T
        factor: Array = np.tril(pose + x + y)
        pair = (every - every % 2)[:, None] + (0, 1)
        factor[every[:, None], pair] = rows[:, scan.ROOT : scan.ROOT + 2]
        return factor


class ScanReport(UpdateReport):
    """The results of a scan, read from the filter's memory until it changes."""

    _parts: Parts

    def detach(self) -> None:
        """Copy the results, since the memory is about to change or to be replaced."""
        if not self.is_detached:
            found, own = self.__dict__, vars(ScanReport)
            for name in ("nis", "degrees_of_freedom", "_record"):
                if name not in found:  # without the lock of a cached property
                    found[name] = own[name].func(self)
            del found["_parts"]

    @property
    def is_detached(self) -> bool:
        """Whether the results are copies."""
        return "_parts" not in self.__dict__

    def __getstate__(self) -> dict[str, Any]:
        """Return the results."""
        self.detach()
        return self.__dict__

    def completed(self, **parts: Any) -> ScanReport:
        """Add parts that the filter did not know; return this report itself."""
        self.__dict__.update(parts)
        return self

    @cached_property
    def nis(self) -> float:
        """νᵀ S⁻¹ ν, χ² distributed when the filter is consistent."""
        return float(self._parts.values[NIS])

    @property
    def factor(self) -> Callable[[], Array]:
        """The function that returns L, shape (2m, 2m), L Lᵀ = S."""
        return self._record.joint_factor

    @cached_property
    def _record(self) -> ScanRecord:
        return ScanRecord.copied(self._parts)

    @cached_property
    def degrees_of_freedom(self) -> int:
        """Of the NIS: how many numbers the associated readings have."""
        parts = self._parts
        return int(parts.numbers[IN_USE]) * int(parts.values[scan.NUMBERS_READ])

    @property
    def associated_ids(self) -> tuple[int, ...]:
        """Mapped landmarks whose readings corrected the belief."""
        return self._with_outcome(scan.USED)

    @property
    def added_ids(self) -> tuple[int, ...]:
        """Landmarks that entered the map."""
        return self._with_outcome(scan.ADDED)

    @property
    def rejected_ids(self) -> tuple[int, ...]:
        """Mapped landmarks whose readings the chi-square gate rejected."""
        return self._with_outcome(scan.GATED)

    @property
    def skipped_ids(self) -> tuple[int, ...]:
        """Landmarks whose readings are too close to use."""
        return self._with_outcome(scan.SKIPPED)

    @cached_property
    def near_ids(self) -> tuple[int, ...]:
        """Mapped landmarks within 10 σ of the robot."""
        ids, ledger = self._entries
        return tuple(ids[ledger[scan.NEAR] != 0].tolist())

    @cached_property
    def innovation(self) -> Array:
        """ν, shape (m, 2), rows (bearing, range) [rad, m]."""
        return self._record.rows[:, scan.INNOVATION].reshape(-1, 2)

    def _with_outcome(self, value: int) -> tuple[int, ...]:
        ids, ledger = self._entries
        outcomes = ledger[scan.OUTCOME].tolist()
        if value not in outcomes:  # mostly so
            return ()
        pairs = zip(ids.tolist(), outcomes, strict=True)
        return tuple([i for i, outcome in pairs if outcome == value])

    @property
    def _entries(self) -> tuple[IntArray, IntArray]:
        """The landmark of each reading, and the ledger."""
        if self.is_detached:
            return self._record.scan_ids, self._record.ledger
        parts, count = self._parts, self._parts.numbers[SCANNED]  # not all the rows
        return parts.scan_ids[:count], parts.ledger[:, :count]
