"""Changes of the belief, with the steps that limit the links of the pose."""

import numpy as np

from ....arrays import Array, BoolArray, IntArray
from ...models.bearing_range import locate_landmark
from .conditional_pose import ConditionalPose, LinearScan, correct, cut_links, relocate
from .linearisation import linearise_new_landmarks, linearise_scan
from .local_information import LocalInformation

State = tuple[LocalInformation, ConditionalPose]


def correct_all(
    local: LocalInformation, pose: ConditionalPose, scan: LinearScan
) -> State:
    """Condition map and pose on all measurements."""
    pose, measurement = correct(pose, scan)
    return local.absorb(pose, measurement)


def correct_and_relocate(
    base: str, state: State, scan: LinearScan, readings: Array
) -> State | None:
    """Correct with every other measurement; take the pose anew from the others.

    The measurements are split in the order of their bearings, so that both halves
    cover all directions.  The new pose is linearised at the corrected old one.  The
    function returns None if its measurements do not determine it.
    """
    local, pose = state
    order = np.lexsort(readings.T[::-1])
    for_pose = np.zeros(len(order), dtype=bool)
    for_pose[order[::2] if len(order) > 2 else order] = True
    if not for_pose.all():
        local, pose = correct_all(local, pose, scan.subset(~for_pose))
    places, variance = scan.landmarks[for_pose], scan.variance[for_pose]
    pose = pose._replace(reference=pose.mean[:2].copy())
    rest = linearise_scan(base, local, pose, places, readings[for_pose], variance)
    relocated = relocate(pose, rest)
    if relocated is None:
        return None
    return local.absorb(*relocated)


def add_landmarks(
    base: str, state: State, slots: IntArray, readings: Array, variance: Array
) -> State:
    """Initialise new landmarks from their first measurements, shape (n, 2)."""
    local, pose = state
    points = locate_landmark(pose.mean, readings).position
    local = local.extended(slots, points.ravel())
    pose = pose._replace(gain=np.pad(pose.gain, ((0, 0), (0, 2 * len(slots)))))
    places = np.arange(len(local.slots) - len(slots), len(local.slots))
    scan = linearise_new_landmarks(base, local, pose, places, variance)
    return correct_all(local, pose, scan)


def prune(
    local: LocalInformation, pose: ConditionalPose, seen: IntArray, bound: float
) -> ConditionalPose:
    """Cut the weakest links of the pose; links to just measured landmarks go last."""
    linked = pose.is_linked
    excess = int(linked.sum()) - bound
    if excess <= 0:
        return pose
    strength = np.linalg.norm(pose.gain, axis=0).reshape(-1, 2).sum(axis=1)
    strength[seen] += strength.max()
    strength[~linked] = np.inf
    weak = np.zeros_like(linked)
    weak[np.argsort(strength, kind="stable")[: int(excess)]] = True
    return cut_links(pose, local.information, weak)


def marginalise(
    local: LocalInformation, pose: ConditionalPose, gone: BoolArray
) -> State:
    """Marginalise landmarks whose links are all local.

    With 0 the marginalised landmarks and r the rest::

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
    information = local.information[np.ix_(~out, ~out)] - (change + change.T) / 2
    return local.without(gone, information), pose._replace(
        gain=pose.gain[:, ~out] - K_0 @ solved[:, :-3],
        covariance=pose.covariance + (added + added.T) / 2,
    )


def merge_landmarks(
    local: LocalInformation, pose: ConditionalPose, kept: int, gone: BoolArray
) -> State:
    """Condition on two landmarks being the same; drop the second.

    All links of the second landmark are local.  With m = T m' + d, where T copies the
    kept landmark to both and d = μ_k − μ_g in the rows of the dropped one::

        Λ ← Tᵀ Λ T,   b = −Tᵀ Λ d,   K ← K T,   μ_p ← μ_p + K d

    Parameters
    ----------
    local : LocalInformation
    pose : ConditionalPose
    kept : int
        Position of the first landmark in the local map.
    gone : ndarray of bool, shape (k,)
        True for the second landmark.
    """
    out = np.repeat(gone, 2)
    two = np.arange(2 * kept, 2 * kept + 2)
    T = np.eye(len(out))[:, ~out]
    T[out] = np.eye(len(out))[two][:, ~out]
    d = np.zeros(len(out))
    d[out] = local.points[two] - local.points[out]
    information = T.T @ local.information @ T
    rest = local.without(gone, (information + information.T) / 2)
    moved = pose._replace(mean=pose.mean + pose.gain @ d, gain=pose.gain @ T)
    return rest.settle(moved, -T.T @ (local.information @ d))
