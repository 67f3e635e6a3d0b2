"""Update of a sparse information map and the pose with one scan: `process_scan`.

It screens the readings, linearises them, corrects map and pose, adds landmarks, and
limits the links of the pose.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from math import inf
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import lapack, solve_triangular

from .... import argument_checks
from ....arrays import Array, BoolArray, IntArray
from ...filters import ekf
from ...interface import UpdateReport
from ...models.bearing_range import locate_landmark, predict_measurement, wrap_angle
from ...models.motions import UNICYCLE, MotionNoise
from ...models.sensors import only_bearing_range
from .local_information import (
    ConditionalPose,
    LinearScan,
    LocalInformation,
    correct,
    cut_links,
    marginalise_pose,
    relocate,
)


def process_scan(
    state: State,
    rules: ScanRules,
    scan: tuple[Array, list[int]],
    slots: Mapping[int, int],
    free_slots: IntArray,
) -> tuple[State, UpdateReport]:
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
        Slots for new landmarks, which take the first ones.
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
    seen = screened.scan.landmarks
    exceeds = not rules.prunes and _exceeds_bound(pose, seen, len(new), rules.bound)
    state = _absorb(rules.base, state, screened, readings[used], relocates=exceeds)
    local, pose = state
    if len(new):
        variance = ekf.reading_variances(rules.rules, readings[new, 1], rules.sensor)
        added = free_slots[: len(new)]
        local, pose = add_landmarks(rules.base, state, added, readings[new], variance)
        count = len(local.slots)
        seen = np.append(seen, np.arange(count - len(new), count))
    if rules.prunes:
        pose = prune(local, pose, seen, rules.bound)
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
    return (local, pose), report


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
    pose: ConditionalPose, seen: IntArray, new: int, bound: float
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
    if count > 2 * bound:
        enough = 2
    return bool(count > bound and len(seen) >= enough)


class Screened(NamedTuple):
    """n measurements of mapped landmarks; m are used."""

    skipped: BoolArray  # landmark expected below the minimum range, shape (n,)
    gated: BoolArray  # rejected by the gate, shape (n,)
    near: BoolArray  # robot within 10 σ of the landmark, shape (n,)
    scan: LinearScan  # the m used measurements, linearised at the prior
    nis: float
    factor: Array  # L, shape (2m, 2m), L Lᵀ = S


class ScanRules:
    """Noise, acceptance rules and limit of links, checked."""

    def __init__(
        self,
        motion_std: ArrayLike,
        measurement_std: ArrayLike,
        *,
        base: str,
        active_bound: int | None,
        sparsify: str,
        **settings: Any,
    ) -> None:
        self.base = argument_checks.one_of("base", base, tuple(BASES))
        known = {"sensor", "gate_probability", "noise_at_rest", "min_range", "motion"}
        if unknown := set(settings) - known:
            raise TypeError(f"SparseInformationSlam has no option {min(unknown)!r}")
        noise = np.array(motion_std), np.array(measurement_std)
        #: Makes the filter of the same belief in dense form.
        self.dense = partial(BASES[base], *noise, **settings)
        dense = self.dense()
        self.rules, self.sensor = dense.rules, dense.sensor
        at_rest = settings.get("noise_at_rest", True)
        motion = settings.get("motion", UNICYCLE)
        self.motion_noise = MotionNoise.checked(motion_std, at_rest, motion)
        std = only_bearing_range(dense.sensor, "sparse_information").stds(noise[1], 1.0)
        if min(std) <= 0:
            raise ValueError(
                "measurement_std must be 2 finite numbers > 0, because an exact "
                f"measurement has infinite information, got {measurement_std!r}"
            )
        #: Γ, the largest number of active landmarks, or infinity.
        self.bound: float = inf
        if active_bound is not None:
            self.bound = argument_checks.whole("active_bound", active_bound, 2)
        kinds = ("relocate", "prune")
        #: Whether to cut weak links instead of relocating the pose.
        self.prunes = argument_checks.one_of("sparsify", sparsify, kinds) == "prune"

    def screen(
        self,
        pose: ConditionalPose,
        local: LocalInformation,
        places: IntArray,
        readings: Array,
        ids: list[int],
    ) -> Screened:
        """Linearise measurements of local landmarks and select those to use.

        S = H Σ Hᵀ + N, with Σ = (Λ_LL − C)⁻¹ and H, N from :func:`marginalise_pose`.
        """
        expected = np.hypot(*(local.points.reshape(-1, 2)[places] - pose.mean[:2]).T)
        skipped = expected < self.rules.min_range
        kept = ~skipped
        places, readings = places[kept], readings[kept]
        at = readings[:, 1] if self.rules.noise_as_read else expected[kept]
        variance = ekf.reading_variances(self.rules, at, self.sensor)
        scan = linearise_scan(self.base, local, pose, places, readings, variance)
        S = _innovation_covariance(pose, local, scan)
        blocks = np.array(
            [S[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] for k in range(len(places))]
        ).reshape(-1, 2, 2)
        solved = np.linalg.solve(blocks, scan.innovation[..., None])[..., 0]
        refused = (scan.innovation * solved).sum(axis=1) > self.rules.gate
        gated, near = np.zeros_like(skipped), np.zeros_like(skipped)
        gated[kept], near[kept] = refused, _is_near(scan, blocks, expected[kept])
        used = np.repeat(~refused, 2)
        used_ids = [i for i, k in zip(ids, kept & ~gated, strict=True) if k]
        factor, nis = np.empty((0, 0)), 0.0
        scan = scan.subset(~refused)
        if used_ids:
            factor = _factor(S[np.ix_(used, used)], used_ids)
            white = solve_triangular(factor, scan.innovation.ravel(), lower=True)
            nis = float(white @ white)
        return Screened(skipped, gated, near, scan, nis, factor)


def _innovation_covariance(
    pose: ConditionalPose, local: LocalInformation, scan: LinearScan
) -> Array:
    if not len(scan.landmarks):
        return np.empty((0, 0))
    H, N = marginalise_pose(pose, scan)
    spread = solve_triangular(local.solver()[0], H.T, lower=True, check_finite=False)
    return np.asarray(spread.T @ spread + N)


def _is_near(scan: LinearScan, blocks: Array, distance: Array) -> BoolArray:
    """Return whether the robot is within 10 σ of each landmark, as :class:`EkfSlam`.

    A landmark's covariance in the robot frame is H_l⁻¹ (S − Q) H_l⁻ᵀ.
    """
    noise = np.einsum("ni,ij->nij", scan.variance, np.eye(2))
    back = np.linalg.inv(scan.jacobian_landmark)
    place = back @ (blocks - noise) @ back.transpose(0, 2, 1)
    spread = np.linalg.eigvalsh(place)[:, -1] if len(place) else np.empty(0)
    return np.asarray(distance**2 < 100 * spread)


def _factor(S: Array, ids: list[int]) -> Array:
    factor, failed = lapack.dpotrf(S, lower=1, clean=1)
    if failed:
        raise argument_checks.not_positive_definite(ids[(failed - 1) // 2])
    return np.asarray(factor)


# --------------------------------------------------------------------------------------
# Linearisation points of the measurements of a sparse information map.
#
# Symbols
# -------
# x̄    linearisation point of the position, fixed until the pose moves [m]
# l̄    first estimate of a landmark [m]
# δ̄ = l̄ − x̄,  J = [0 −1; 1 0]
#
# A rotation of robot and landmark by δθ about the robot moves the landmark by J δ̄ δθ.
# Measurements do not observe this rotation if H_l J δ̄ + H_θ = 0.  If all measurements
# of a landmark use the same l̄, the information of the whole map does not observe it
# either.

ESTIMATE, FIRST, CONSTRAINED = "ekf", "first_estimates", "observability_constrained"
BASES: dict[str, type[ekf.EkfSlam]] = {
    ESTIMATE: ekf.EkfSlam,
    FIRST: ekf.FirstEstimatesEkfSlam,
    CONSTRAINED: ekf.ObservabilityConstrainedEkfSlam,
}


def linearise_scan(
    base: str,
    local: LocalInformation,
    pose: ConditionalPose,
    places: IntArray,
    readings: Array,
    variance: Array,
) -> LinearScan:
    """Linearise measurements of local landmarks, with innovations at the mean.

    "ekf": H at the mean.  "first_estimates": H at (x̄, l̄).
    "observability_constrained": H at the mean, projected off the rotation.

    Parameters
    ----------
    base : str
    local : LocalInformation
    pose : ConditionalPose
    places : ndarray, shape (n,)
        Positions of the landmarks in the local map.
    readings, variance : ndarray, shape (n, 2)
    """
    points = local.points.reshape(-1, 2)[places]
    expected = predict_measurement(pose.mean, points)
    innovation = readings - expected.measurement
    innovation[:, 0] = wrap_angle(innovation[:, 0])
    H_p, H_l = expected.jacobian_pose, expected.jacobian_landmark
    first = local.first.reshape(-1, 2)[places]
    if base == FIRST:
        fixed = predict_measurement(np.append(pose.reference, 0.0), first)
        H_p, H_l = fixed.jacobian_pose, fixed.jacobian_landmark
    elif base == CONSTRAINED:
        H_p, H_l = _without_rotation(H_p, H_l, first - pose.reference)
    return LinearScan(innovation, H_p, H_l, variance, places)


def _without_rotation(H_p: Array, H_l: Array, apart: Array) -> tuple[Array, Array]:
    """Project Jacobians off the rotation, H ← H − (H w) wᵀ / wᵀw, for δ̄, shape (n, 2).

    w = (−J δ̄/2, 1, J δ̄/2) rotates robot and landmark about their midpoint.  It is
    orthogonal to both translations, which H does not observe in any case.
    """
    half = _quarter_turn(apart) / 2
    w = np.column_stack([-half, np.ones(len(half)), half])
    H = np.concatenate([H_p, H_l], axis=2)
    observed = np.einsum("nij,nj->ni", H, w) / (w**2).sum(axis=1)[:, None]
    H -= observed[:, :, None] * w[:, None, :]
    return H[..., :3], H[..., 3:]


def linearise_new_landmarks(
    base: str,
    local: LocalInformation,
    pose: ConditionalPose,
    places: IntArray,
    variance: Array,
) -> LinearScan:
    """Linearise the first measurements of landmarks, at the initial estimates.

    H_l is evaluated at the initial estimate; except for "ekf", H_θ = −H_l J δ̄.
    """
    points = local.points.reshape(-1, 2)[places]
    expected = predict_measurement(pose.mean, points)
    H_p, H_l = expected.jacobian_pose, expected.jacobian_landmark
    if base != ESTIMATE:
        turned = _quarter_turn(local.first.reshape(-1, 2)[places] - pose.reference)
        H_p = H_p.copy()
        H_p[:, :, 2] = -np.einsum("nij,nj->ni", H_l, turned)
    return LinearScan(np.zeros_like(points), H_p, H_l, variance, places)


def _quarter_turn(vectors: Array) -> Array:
    """Return J v, shape (n, 2)."""
    return np.column_stack([-vectors[:, 1], vectors[:, 0]])


# --------------------------------------------------------------------------------------
# Changes of the belief, with the steps that limit the links of the pose.

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
