"""Update of a sparse information map and the pose with one scan."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from ....arrays import Array, IntArray
from ...filters.ekf import reading_variances
from ...interface import UpdateReport
from .conditional_pose import ConditionalPose
from .local_information import LocalInformation
from .scan import ScanRules, Screened
from .sparsification import (
    State,
    add_landmarks,
    correct_all,
    correct_and_relocate,
    prune,
)


class Sparsity(NamedTuple):
    """Limit of the links of the pose."""

    bound: float
    """Γ, the largest number of active landmarks, or infinity."""
    prunes: bool
    """Whether to cut weak links instead of relocating the pose."""


class ScanResult(NamedTuple):
    """Belief and report after a scan."""

    local: LocalInformation
    pose: ConditionalPose
    report: UpdateReport
    added_slots: list[int]

    @property
    def largest_residual(self) -> float:
        """Largest correction that has not reached the fixed landmarks, in their σ."""
        return self.local.fixed.largest_residual(self.local.shift)


def process_scan(
    state: State,
    rules: ScanRules,
    sparsity: Sparsity,
    scan: tuple[Array, list[int]],
    slots: Mapping[int, int],
    free_slots: IntArray,
) -> ScanResult:
    """Return belief and report after a scan, without changing the old belief.

    Parameters
    ----------
    state : LocalInformation, ConditionalPose
        The belief.  All mapped landmarks of the scan must be local.
    scan : ndarray, shape (m, 2), and list of int
        Measurements and identities.
    slots : mapping
        Slots of the mapped landmarks by identity.
    free_slots : ndarray, shape (>= m,)
        Slots for new landmarks.
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
    exceeds = not sparsity.prunes and _exceeds_bound(
        pose, screened.scan.landmarks, len(new), sparsity
    )
    state = _absorb(rules.base, state, screened, readings[used], relocates=exceeds)
    local, pose = state
    seen, added = screened.scan.landmarks, free_slots[: len(new)]
    if len(new):
        variance = reading_variances(rules.rules, readings[new, 1])
        local, pose = add_landmarks(rules.base, state, added, readings[new], variance)
        count = len(local.slots)
        seen = np.append(seen, np.arange(count - len(new), count))
    if sparsity.prunes:
        pose = prune(local, pose, seen, sparsity.bound)
    close = np.sort(np.append(np.flatnonzero(~far), mapped[screened.skipped]))

    def of(rows: IntArray) -> tuple[int, ...]:
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
    return ScanResult(local, pose, report, added.tolist())


def _absorb(
    base: str, state: State, screened: Screened, readings: Array, *, relocates: bool
) -> State:
    """Correct, and relocate the pose if it would have too many links."""
    scan = screened.scan
    if not len(scan.landmarks):
        return state
    if relocates:
        relocated = correct_and_relocate(base, state, scan, readings)
        if relocated is not None:
            return relocated
    return correct_all(*state, scan)


def _exceeds_bound(
    pose: ConditionalPose, seen: IntArray, new: int, sparsity: Sparsity
) -> bool:
    """Return whether a scan makes too many landmarks active and can give a new pose.

    Two measurements suffice only if the scan exceeds the bound twofold, because none is
    then left to correct the old pose before it is discarded.
    """
    if not pose.covariance.any():
        return False  # a certain pose has no links
    linked = pose.is_linked
    linked[seen] = True
    count, enough = linked.sum() + new, 3
    if count > 2 * sparsity.bound:
        enough = 2
    return bool(count > sparsity.bound and len(seen) >= enough)
