"""What keeps the links between pose and map few: relocate, prune, integrate out."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ...models.bearing_range import locate_landmark
from .conditional_pose import LinearScan, PoseGivenMap, correct, cut_links, relocate
from .linearisation import first_scan, linear_scan
from .local_information import LocalInformation

Array = NDArray[np.float64]
Int = NDArray[np.int64]
Flags = NDArray[np.bool_]

State = tuple[LocalInformation, PoseGivenMap]


def active(pose: PoseGivenMap) -> Flags:
    """Which local landmarks the pose is linked with, shape (k,)."""
    return np.asarray(pose.gain.any(axis=0).reshape(-1, 2).any(axis=1))


def correct_all(local: LocalInformation, pose: PoseGivenMap, scan: LinearScan) -> State:
    """Condition map and pose on all readings."""
    pose, reading = correct(pose, scan)
    return local.absorb(pose, reading)


def correct_and_relocate(
    base: str, state: State, scan: LinearScan, readings: Array
) -> State | None:
    """Correct with every other reading, forget the pose, take it from the others.

    The readings are parted in the order of their bearings, so that both parts look
    around.  The new pose is linearised where the correction left the old one.  None
    where the readings for it do not determine it.
    """
    local, pose = state
    order = np.lexsort(readings.T[::-1])
    for_pose = np.zeros(len(order), dtype=bool)
    for_pose[order[::2] if len(order) > 2 else order] = True
    if not for_pose.all():
        local, pose = correct_all(local, pose, scan.only(~for_pose))
    places, variance = scan.landmarks[for_pose], scan.variance[for_pose]
    pose = pose._replace(reference=pose.mean[:2].copy())
    rest = linear_scan(base, local, pose, places, readings[for_pose], variance)
    relocated = relocate(pose, rest)
    if relocated is None:
        return None
    pose, reading = relocated
    return local.absorb(pose, reading)


def add_landmarks(
    base: str,
    state: State,
    slots: Int,
    readings: Array,
    variance: Array,
) -> State:
    """Map landmarks seen first, where they were read, shape (n, 2)."""
    local, pose = state
    points = locate_landmark(pose.mean, readings).position
    local = local.extended(slots, points.ravel())
    pose = pose._replace(gain=np.pad(pose.gain, ((0, 0), (0, 2 * len(slots)))))
    places = np.arange(len(local.slots) - len(slots), len(local.slots))
    return correct_all(local, pose, first_scan(base, local, pose, places, variance))


def prune(
    local: LocalInformation, pose: PoseGivenMap, seen: Int, bound: float
) -> PoseGivenMap:
    """Cut the weakest links of the pose, landmarks seen just now holding longest."""
    linked = active(pose)
    excess = int(linked.sum()) - bound
    if excess <= 0:
        return pose
    strength = np.linalg.norm(pose.gain, axis=0).reshape(-1, 2).sum(axis=1)
    strength[seen] += strength.max()
    strength[~linked] = np.inf
    weak = np.zeros_like(linked)
    weak[np.argsort(strength, kind="stable")[: int(excess)]] = True
    return cut_links(pose, local.information, weak)


def integrate_out(local: LocalInformation, pose: PoseGivenMap, gone: Flags) -> State:
    """Take landmarks out of the belief, all of whose links are local.

    With 0 those taken out and r the rest::

        Λ_rr ← Λ_rr − Λ_r0 Λ_00⁻¹ Λ_0r,   K_r ← K_r − K_0 Λ_00⁻¹ Λ_0r,
        Ω ← Ω + K_0 Λ_00⁻¹ K_0ᵀ
    """
    out = np.repeat(gone, 2)
    K_0, cross = pose.gain[:, out], local.information[np.ix_(out, ~out)]
    solved = np.linalg.solve(
        local.information[np.ix_(out, out)], np.column_stack([cross, K_0.T])
    )
    change = cross.T @ solved[:, :-3]
    added = K_0 @ solved[:, -3:]
    around = local.surroundings
    place = np.cumsum(~out) - 1
    rest = replace(
        local,
        slots=local.slots[~gone],
        points=local.points[~out],
        first=local.first[~out],
        information=local.information[np.ix_(~out, ~out)] - (change + change.T) / 2,
        surroundings=around._replace(border=place[around.border]),
    )
    return rest, pose._replace(
        gain=pose.gain[:, ~out] - K_0 @ solved[:, :-3],
        covariance=pose.covariance + (added + added.T) / 2,
    )


def identify(
    local: LocalInformation, pose: PoseGivenMap, kept: int, gone: Flags
) -> State:
    """Condition on a landmark, all of whose links are local, being the one at ``kept``.

    With m = T m' + d, where T gives both the place kept, and d = μ_k − μ_g in the rows
    of the one that goes::

        Λ ← Tᵀ Λ T,   b = −Tᵀ Λ d,   K ← K T,   μ_p ← μ_p + K d
    """
    out = np.repeat(gone, 2)
    two = np.arange(2 * kept, 2 * kept + 2)
    T = np.eye(len(out))[:, ~out]
    T[out] = np.eye(len(out))[two][:, ~out]
    d = np.zeros(len(out))
    d[out] = local.points[two] - local.points[out]
    information = T.T @ local.information @ T
    around, place = local.surroundings, np.cumsum(~out) - 1
    rest = replace(
        local,
        slots=local.slots[~gone],
        points=local.points[~out],
        first=local.first[~out],
        information=(information + information.T) / 2,
        surroundings=around._replace(border=place[around.border]),
    )
    moved = pose._replace(mean=pose.mean + pose.gain @ d, gain=pose.gain @ T)
    return rest.settle(moved, -T.T @ (local.information @ d))
