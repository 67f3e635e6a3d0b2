"""What one scan does to a sparse information map and the pose."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...interface import UpdateReport
from .conditional_pose import PoseGivenMap
from .local_information import LocalInformation
from .scan import ScanRules, Screened
from .sparsification import (
    State,
    active,
    add_landmarks,
    correct_all,
    correct_and_relocate,
    prune,
)

Array = NDArray[np.float64]
Int = NDArray[np.int64]


class Sparsity(NamedTuple):
    """How the links of the pose are kept few."""

    bound: float
    """Γ, or infinity."""
    prunes: bool


class Outcome(NamedTuple):
    """Belief and report after a scan."""

    local: LocalInformation
    pose: PoseGivenMap
    report: UpdateReport
    added_slots: list[int]


def consider(
    state: State,
    rules: ScanRules,
    sparsity: Sparsity,
    scan: tuple[Array, list[int]],
    slots: Mapping[int, int],
    vacant: Int,
) -> Outcome:
    """Work out what a scan does, and change nothing.

    Parameters
    ----------
    state : LocalInformation, PoseGivenMap
        The belief, all mapped landmarks of the scan among the local ones.
    scan : ndarray, shape (m, 2), and list of int
        Readings and identities.
    slots : mapping
        Places of the mapped landmarks by identity.
    vacant : ndarray, shape (>= m,)
        Places to put new landmarks.
    """
    (local, pose), (readings, ids) = state, scan
    far = readings[:, 1] >= rules.rules.min_range
    known = np.array([i in slots for i in ids], dtype=bool)
    mapped, new = np.flatnonzero(far & known), np.flatnonzero(far & ~known)
    order = np.argsort(local.slots)
    wanted = np.array([slots[ids[k]] for k in mapped], dtype=np.int64)
    places = order[np.searchsorted(local.slots, wanted, sorter=order)]
    names = [ids[k] for k in mapped]
    screened = rules.screen(pose, local, places, readings[mapped], names)
    used = mapped[~(screened.skipped | screened.gated)]
    crowded = not sparsity.prunes and _is_crowded(
        pose, screened.scan.landmarks, len(new), sparsity
    )
    state = _absorb(rules.base, state, screened, readings[used], crowded=crowded)
    local, pose = state
    seen, added = screened.scan.landmarks, vacant[: len(new)]
    if len(new):
        variance = rules.variance(readings[new, 1])
        local, pose = add_landmarks(rules.base, state, added, readings[new], variance)
        count = len(local.slots)
        seen = np.append(seen, np.arange(count - len(new), count))
    if sparsity.prunes:
        pose = prune(local, pose, seen, sparsity.bound)
    close = np.sort(np.append(np.flatnonzero(~far), mapped[screened.skipped]))

    def of(rows: Int) -> tuple[int, ...]:
        return tuple(ids[k] for k in rows.tolist())

    report = UpdateReport(
        screened.nis,
        2 * len(used),
        associated_ids=of(used),
        added_ids=of(new),
        rejected_ids=of(mapped[screened.gated]),
        skipped_ids=of(close),
        near_ids=of(mapped[screened.near]),
        innovation=screened.scan.innovation,
        factor=screened.factor,
    )
    return Outcome(local, pose, report, added.tolist())


def _absorb(
    base: str, state: State, screened: Screened, readings: Array, *, crowded: bool
) -> State:
    """Correct, and relocate the pose where its links would become too many."""
    scan = screened.scan
    if not len(scan.landmarks):
        return state
    if crowded:
        relocated = correct_and_relocate(base, state, scan, readings)
        if relocated is not None:
            return relocated
    return correct_all(*state, scan)


def _is_crowded(pose: PoseGivenMap, seen: Int, new: int, sparsity: Sparsity) -> bool:
    """Whether a scan makes too many landmarks active, and may give a new pose.

    Two readings only do where the bound is exceeded twice: then none is left to link
    the pose with the landmarks active so far before it is forgotten.
    """
    if not pose.covariance.any():
        return False  # a pose that is certain links nothing
    linked = active(pose)
    linked[seen] = True
    count, enough = linked.sum() + new, 3
    if count > 2 * sparsity.bound:
        enough = 2
    return bool(count > sparsity.bound and len(seen) >= enough)
