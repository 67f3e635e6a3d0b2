"""The memory of one filter, and the two steps that kernels take in it.

The memory is a single block, which Python passes as one argument.  `update_map` takes
in one scan, and `move_pose` one odometry reading.
"""

from typing import NamedTuple

import numpy as np

from ...arrays import Array, IntArray
from ...jit import jit, njit_internal
from ..support.memory_limit import aligned_zeros
from .kalman_gain import (
    ADDED,
    FIRST,
    ITERATIONS,
    LARGE,
    LEDGER_HEIGHT,
    META_WIDTH,
    OUTCOME,
    SLOT,
    Rules,
)
from .prediction import predict
from .scan_update import DONE, update_belief

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
STARTS = 13  # where each part begins, and the end
NUMBERS = 24

# Values in floating point; the rules come first.
MOTION = len(Rules._fields)  # (σx², σy², σα²) per step
MOVED = MOTION + 3  # the same for the last motion
NIS = MOVED + 3  # of the last scan
VALUES = 24


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
    iterated = values[ITERATIONS] > 1
    capacity, readings = (-(-size // 8) * 8 for size in (capacity, readings))
    height = FIRST + (2 if iterated else 1) * (2 * readings + 2)
    before, table = min(capacity, LARGE + 6), 1 << capacity.bit_length()
    sizes = [VALUES, capacity, capacity**2, capacity, height * (capacity + META_WIDTH)]
    sizes += [before**2, capacity, table, readings, LEDGER_HEIGHT * readings]
    starts = NUMBERS + np.cumsum([0, *sizes])
    block = aligned_zeros(int(starts[-1]))
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
        block[at[4] : at[5]].reshape((height, n + META_WIDTH)),
        block[at[5] : at[6]].reshape((before, before)),
        block[at[6] : at[7]].view(np.int64),
        block[at[7] : at[8]].view(np.int64),
        block[at[8] : at[9]].view(np.int64),
        block[at[9] : at[10]].view(np.int64).reshape((LEDGER_HEIGHT, -1)),
    )


parts_jit = njit_internal(parts_of)


@jit
def update_map(block: Array, readings: Array, ids: IntArray) -> int:
    """Update the belief of a filter with one scan, in place.

    Parameters
    ----------
    block : ndarray
        The memory of the filter, see :class:`Parts`.  On return it also
        holds the record of the scan.
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
    numbers, slots = parts.numbers, parts.ledger[SLOT]
    for k in range(count):
        for j in range(k):
            if ids[j] == ids[k]:
                return REPEATED
    mapped = numbers[LANDMARKS]
    if count > len(parts.scan_ids):
        return NO_ROOM
    if mapped + find_slots(parts, ids) > (numbers[CAPACITY] - 4) // 2:
        return NO_ROOM
    status, used, nis = update_belief(
        parts.mean,
        parts.covariance,
        parts.reference,
        3 + 2 * mapped,
        readings,
        count,
        parts.ledger,
        parts.rows,
        parts.before,
        parts.values,
    )
    if status == DONE:
        for k in range(count):
            parts.scan_ids[k] = ids[k]
            if parts.ledger[OUTCOME, k] == ADDED:
                parts.ids[slots[k]] = ids[k]
                numbers[LANDMARKS] += 1
        numbers[SCANNED], numbers[IN_USE], parts.values[NIS] = count, used, nis
        numbers[STEPS] += 1
    return int(status)


@njit_internal
def find_slots(parts: Parts, ids: IntArray) -> int:
    """Write the slots of landmarks to the ledger, -1 for new ones; count these.

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
        parts.ledger[SLOT, k] = table[at] - 1
        new += table[at] == 0
    return new


@njit_internal
def hash_of(landmark_id: int) -> int:
    """Mix the bits of an identity (Fibonacci hashing of both halves)."""
    low, high = landmark_id & 0xFFFFFFFF, (landmark_id >> 32) & 0xFFFFFFFF
    return (low * 0x278DDE6D + high * 0x1F123BB5) >> 20


@jit
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
    predict(
        parts.mean,
        parts.covariance,
        parts.reference,
        size,
        forward,
        sideways,
        turn,
        values[MOVED : MOVED + 3],
        int(values[0]),
    )
    parts.numbers[STEPS] += 1
