"""Landmarks that one reading does not place: first placed from several poses.

A bearing or a range alone does not determine where a landmark is.  Its readings wait,
and the poses from which they were made stay in the state beside the landmarks, with all
their correlations [1]_.  Once the readings determine the landmark, `WaitingMap` adds it
to the map, and they correct the belief, each of them once, as one measurement together.

A past pose is two points of the map, its position p and q = p + (cos θ, sin θ).  The
error of q is e_q = e_p + J (q − p) e_θ.  Therefore every filter of the family keeps a
pose consistent like two landmarks, in either error frame.  Of a landmark l, with the
poses c, k readings satisfy::

    ν = H_c e_c + H_l e_l + v,    S = H_c P H_cᵀ + R,    W = S⁻¹
    M = (H_lᵀ W H_l)⁻¹,   G = M H_lᵀ W,   W' = W − W H_l G
    l ← l̂ + G ν,   P_ll = M,   P_xl = −P H_cᵀ Gᵀ
    x ← x + P H_cᵀ W' ν,   P ← P − P H_cᵀ W' H_c P

This is the limit of a Kalman update of a landmark without prior knowledge.  Filters
that linearise more than once repeat it at the corrected poses and place until these
settle [4]_: over many steps, the heading drifts by more than a reading's noise.

A landmark is placed when linearisation holds [2]_ and its place is not ambiguous.  Its
standard deviation, relative to the robot, is below a tenth of its distance from every
pose that read it, and changes their readings by less than a tenth of their noise in
second order.  Every other place, as the mirror image of ranges from a straight path
[3]_, is less likely by a factor of 10⁵.

References
----------
.. [1] J. Leonard, R. Rikoski, P. Newman, M. Bosse, Mapping partially observable
   features from multiple uncertain vantage points, IJRR 21(10-11), 2002.
.. [2] T. Bailey, Constrained initialisation for bearing-only SLAM, ICRA 2003.
.. [3] E. Olson, J. Leonard, S. Teller, Robust range-only beacon localization, IEEE
   Journal of Oceanic Engineering 31(4), 2006.
.. [4] B. Bell, F. Cathey, The iterated Kalman filter update as a Gauss-Newton
   method, IEEE Transactions on Automatic Control 38(2), 1993.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

import numpy as np

from ...argument_checks import LOWEST_ID, RESERVED_IDS, refuse_reserved
from ...arrays import LARGEST, Array, BoolArray, IntArray
from ..beliefs import Belief, MapView, UpdateReport
from ..guards import saved_states
from ..guards.saved_states import NUMBERS, WHOLE, Table, with_prefix, without_prefix
from ..interface import returned_on_error
from ..kernels.scan_update import (
    AT_ESTIMATE,
    DONE,
    INVARIANT,
    OUTCOME,
    WAITING,
    BeliefArrays,
    Rules,
)
from ..models.rigid_motion import ErrorFrame, seen_from
from ..models.sensors import Sensor
from .gaussian_map import MOTION, GaussianMap, UpdateKernel
from .pose_readings import moves_of, retracted

#: Largest number of past poses. Beyond it, the pose nearest to its predecessor is
#: removed, or the oldest of several equally near ones.
MOST_POSES = 40
ALIKE = 1e-3  # relative difference of distances that count as equal
CERTAIN = 10.0  # distance of a placed landmark, in its standard deviations
BENT = 0.1  # second-order change of its readings, in theirs
UNLIKELY = 23.0  # 2 log 10⁵: excess of the cost of other places
DIRECTIONS, DISTANCES = 24, np.geomspace(0.5, 100.0, 12)  # first guesses, [m]
MOST_STEPS = 20  # of Gauss and Newton
SETTLED = 1e-4  # change in their last step, relative to the distance
SAME = 0.02  # places this near, relative to their distance, are one


class Waiting(NamedTuple):
    """The readings that wait."""

    #: Landmark and past pose of each, shape (w, 2).
    ids: IntArray = np.zeros((0, 2), dtype=np.int64)
    #: Shape (w, 2).
    readings: Array = np.zeros((0, 2))

    def where(self, chosen: BoolArray) -> Waiting:
        """Return some of the readings."""
        return Waiting(self.ids[chosen], self.readings[chosen])


#: What saved readings must be.
WAITING_STATE: Table = {"ids": (WHOLE, "w", 2), "readings": (NUMBERS, "w", 2)}


class WaitingMap(GaussianMap):
    """A map with the readings that wait, and the past poses that they need.

    Parameters
    ----------
    values : sequence of float
        As in :class:`.GaussianMap`.
    sensor : Sensor
        The sensor of the readings.
    """

    waiting: Waiting
    _report: UpdateReport | None  # of the last scan, unless the memory holds it
    _anew: ClassVar = {"_report": None}

    def __init__(self, values: Sequence[float], sensor: Sensor) -> None:
        super().__init__(values)
        self._sensor, self.waiting = sensor, Waiting()

    @property
    def rules(self) -> Rules:
        """The rules of the filter."""
        return Rules(*self.parts.values[:MOTION].tolist())

    @property
    def landmark_slots(self) -> dict[int, int]:
        """Place of each landmark in the state, without the points of past poses."""
        return {i: slot for i, slot in self.slots.items() if is_landmark(i)}

    def reset(self, pose: Array, pose_covariance: Array) -> None:
        """Start with an empty map at a pose (3,), and no readings."""
        super().reset(pose, pose_covariance)
        self.waiting = Waiting()

    def take_in(self, update: UpdateKernel, readings: Array, ids: IntArray) -> int:
        """Update with readings of mapped landmarks; let those of others wait."""
        refuse_reserved(ids.tolist())
        with returned_on_error(self):
            status = super().take_in(update, readings, ids)
            if status == DONE:
                report = super().report()
                left = self.parts.ledger[OUTCOME, : len(ids)] == WAITING
                new = Waiting(np.column_stack([ids, ids])[left], readings[left])
                placed = self._collect(new)
                self._report = report.replace(added_ids=placed)
        return status

    def report(self) -> UpdateReport:
        """Return the report of the last scan, with the landmarks placed after it."""
        return self._report or super().report()

    def last_report(self) -> UpdateReport:
        """Return the report of the last scan or reading of the pose once more."""
        return self._report or super().last_report()

    def _collect(self, new: Waiting) -> tuple[int, ...]:
        """Take in readings of landmarks that are not mapped, and place those it can.

        The poses of these readings are not read.  Returns the landmarks that have
        entered the map.
        """
        placed, waiting, sensor = [], self.waiting, self._sensor
        if len(new.ids):
            pose = _add_pose(self, self.rules)
            ids = np.column_stack([new.ids[:, 0], np.full(len(new.ids), pose)])
            waiting = Waiting(
                np.concatenate([waiting.ids, ids]),
                np.concatenate([waiting.readings, new.readings]),
            )
            for landmark in ids[:, 0].tolist():
                mine = waiting.ids[:, 0] == landmark
                count = int(mine.sum())
                is_due = count <= 6 or pose % 3 == 0  # each trial costs a millisecond
                if count * sensor.size < 3 or not is_due:
                    continue
                if _place(self, sensor, self.rules, waiting.where(mine), landmark):
                    placed.append(landmark)
                    waiting = waiting.where(~mine)
        self.waiting = _forget_poses(self, waiting)
        return tuple(placed)

    def view(self) -> MapView:
        """Return a copy of pose and landmarks."""
        belief = self.belief()
        return MapView(belief.mean, belief.covariance, belief.landmark_ids)

    def belief(
        self, frame: ErrorFrame = "additive", ids: Sequence[int] | None = None
    ) -> Belief:
        """Return a snapshot of pose and landmarks, or of some landmarks."""
        return super().belief(frame, tuple(self.landmark_slots) if ids is None else ids)

    def state_dict(self) -> dict[str, Any]:
        """Return copies of the belief and of the readings that wait."""
        own = with_prefix("waiting", self.waiting._asdict(), "_")
        return super().state_dict() | own

    def checked(self, state: Mapping[str, Any], **of: str) -> dict[str, Any]:
        """Return a saved state, or refuse it."""
        checked = super().checked(state, **of)
        return checked | read_waiting(state, checked["landmark_ids"])

    def restore(self, state: Mapping[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned, without checks."""
        super().restore(state)
        self.waiting = Waiting(state["waiting_ids"], state["waiting_readings"])


def is_landmark(landmark_id: int) -> bool:
    """Return whether an identity in the map is a landmark, not part of a pose."""
    return landmark_id >= LOWEST_ID + RESERVED_IDS


def read_waiting(state: Mapping[str, Any], mapped: Collection[int]) -> dict[str, Any]:
    """Return saved readings that wait, checked; none where the state has none.

    Raises
    ------
    ValueError
        If one names a past pose that is not in the map.
    """
    if "waiting_ids" not in state:
        return with_prefix("waiting", Waiting()._asdict(), "_")
    own = without_prefix(state, "waiting", "_")
    checked = saved_states.read(own, WAITING_STATE, "waiting_")
    for pose in checked["ids"][:, 1].tolist():
        if not set(_names(pose)) <= set(mapped):
            raise ValueError(
                f"state['waiting_ids'] must name poses in the map, got {pose}"
            )
    return with_prefix("waiting", checked, "_")


def _names(pose: int) -> tuple[int, int]:
    """Return the identities of the two points of a past pose."""
    return LOWEST_ID + 2 * pose, LOWEST_ID + 2 * pose + 1


def _poses(gaussian: GaussianMap) -> list[int]:
    """Return the past poses in the map, in the order of its slots."""
    points = [i - LOWEST_ID for i in gaussian.slots if not is_landmark(i)]
    return [i // 2 for i in points[::2]]


def _add_pose(gaussian: GaussianMap, rules: Rules) -> int:
    """Append the present pose to the map; return its number."""
    mean, P, reference = gaussian.used
    n, last = len(mean), [-1, *_poses(gaussian)][-1]  # the newest one
    at = mean if rules.linearisation == AT_ESTIMATE else reference
    extend = np.zeros((n + 4, n))
    extend[:n] = np.eye(n)
    extend[[n, n + 1, n + 2, n + 3], [0, 1, 0, 1]] = 1.0
    extend[[n + 2, n + 3], 2] = -np.sin(at[2]), np.cos(at[2])
    rows = extend[n:] @ P
    own = rows @ extend[n:].T
    P = np.block([[P, rows.T], [rows, (own + own.T) / 2]])
    grown = [
        np.concatenate([x, x[:2], x[:2] + np.array((np.cos(x[2]), np.sin(x[2])))])
        for x in (mean, reference)
    ]
    pose = (last + 1) % (RESERVED_IDS // 2)
    _hold(gaussian, BeliefArrays(grown[0], P, grown[1]), _names(pose))
    return pose


def _hold(gaussian: GaussianMap, belief: BeliefArrays, new: tuple[int, ...]) -> None:
    """Continue with a belief that has more points."""
    ids = [*gaussian.slots, *new]
    more = len(ids) if len(ids) > gaussian.room else gaussian.room - len(ids)
    gaussian.hold(belief, ids, block=gaussian.blank(len(ids), more))


def _forget_poses(gaussian: GaussianMap, waiting: Waiting) -> Waiting:
    """Marginalise the past poses that no reading needs, or that are too many."""
    poses = _poses(gaussian)
    needed = set(waiting.ids[:, 1].tolist())
    gone = [pose for pose in poses if pose not in needed]
    kept = [pose for pose in poses if pose in needed]
    if len(kept) > MOST_POSES:
        at = [3 + 2 * gaussian.slots[_names(pose)[0]] for pose in kept]
        points = np.array([gaussian.mean[c : c + 4] for c in at])
        steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
        nearest = steps[:-1] <= (1 + ALIKE) * steps[:-1].min()
        crowded = kept[1 + int(np.argmax(nearest))]
        gone.append(crowded)
        waiting = waiting.where(waiting.ids[:, 1] != crowded)
    if gone:
        gaussian.remove([point for pose in gone for point in _names(pose)])
    return waiting


class SeenLandmark(NamedTuple):
    """Readings of one landmark from k past poses."""

    sensor: Sensor
    measurement_std: tuple[float, float]
    readings: Array  # (k, 2)
    columns: IntArray  # (k, 4) of the two points of each pose in the state

    def linearise(self, state: Array, point: Array) -> tuple[Array, Array, Array]:
        """Return h (k, 2), H_c (k, 2, 4) and H_l (k, 2, 2) of a place (2,)."""
        first, ahead, cross, across, length = self._seen_from(state, point)
        D = self.sensor.slopes(ahead, cross)
        Hl = D @ np.stack([first, across], axis=1)
        turned = D @ np.stack([cross, -ahead], axis=1)[:, :, None]
        Hq = turned * (across / length[:, None])[:, None]
        Hc = np.concatenate([-Hl - Hq, Hq], axis=2)
        return self.sensor.read(ahead, cross), Hc, Hl

    def _seen_from(self, state: Array, points: Array) -> tuple[Array, ...]:
        """Return the axes of each pose, and points (..., 2) in its frame."""
        p, q = state[self.columns[:, :2]], state[self.columns[:, 2:]]
        length = np.linalg.norm(q - p, axis=1)
        first = (q - p) / length[:, None]
        across = np.stack([-first[:, 1], first[:, 0]], axis=1)
        apart = points[..., None, :] - p
        ahead, cross = (apart * first).sum(axis=-1), (apart * across).sum(axis=-1)
        return first, ahead, cross, across, length

    def weighted(self, state: Array, points: Array) -> tuple[Array, Array]:
        """Return ν / σ of places (s, 2), shape (s, 2k), and its slopes (s, 2k, 2)."""
        first, ahead, cross, across, _ = self._seen_from(state, points)
        std = self.stds(np.hypot(ahead, cross))
        nu = self.sensor.difference(self.readings, self.sensor.read(ahead, cross))
        D = self.sensor.slopes(ahead.ravel(), cross.ravel()).reshape(*std.shape, 2)
        H = D @ np.stack([first, across], axis=1)
        shape = len(points), -1
        return (nu / std).reshape(shape), (H / std[..., None]).reshape(*shape, 2)

    def bend(self, state: Array, point: Array, axes: Array) -> float:
        """Return the largest second-order change of a reading at one σ, by its noise.

        ::

            ½ |h(l + e) + h(l − e) − 2 h(l)| / σ
        """
        h = [
            self.sensor.read(*self._seen_from(state, points)[1:3])
            for points in (point + axes, point - axes, point[None])
        ]
        bends = self.sensor.difference(h[0], h[2]) + self.sensor.difference(h[1], h[2])
        distances = np.linalg.norm(state[self.columns[:, :2]] - point, axis=1)
        return float(np.abs(bends / (2 * self.stds(distances))).max())

    def from_known_poses(self, state: Array, point: Array) -> tuple[Array, float]:
        """Return axes of one σ of a place, if poses were known, and its distance.

        No filter can be more certain of the place, seen from the robot.
        """
        H = self.weighted(state, point[None])[1][0]
        information, axes = np.linalg.eigh(H.T @ H)
        with np.errstate(divide="ignore"):
            spread = axes / np.sqrt(np.maximum(information, 0.0))
        return spread.T, self.nearest(state, point)

    def nearest(self, state: Array, point: Array) -> float:
        """Return the distance of a place from the nearest of the poses."""
        return float(np.linalg.norm(state[self.columns[:, :2]] - point, axis=1).min())

    def stds(self, distances: Array) -> Array:
        """Return the standard deviations of the readings, shape (..., 2)."""
        return self.sensor.stds(self.measurement_std, distances)

    def fit(
        self, mean: Array, P: Array, reference: Array | None, point: Array, turns: bool
    ) -> _Fit | None:
        """Fit a place to the readings under the uncertainty of the poses.

        Gauss-Newton steps move the place for the poses of the mean, which a filter
        linearises at its reference; or, without a reference, place and poses together.
        None where they do not settle.
        """
        k, size = len(self.readings), self.sensor.size
        rows = np.flatnonzero(np.arange(2 * k) % 2 < size)
        chosen = np.append(self.columns, 2)
        own = P[np.ix_(chosen, chosen)]
        state, shift, joint = mean, np.zeros(len(mean) + 2), reference is None
        for _ in range(MOST_STEPS if joint else 4):
            turn = shift[2] if turns else 0.0
            origin = _rotated(point, -turn)
            at = state if reference is None else reference
            expected = self.linearise(state, point)[0]
            _, blocks, Hl = self.linearise(at, point)
            Hc = np.zeros((k, 2, 4 * k + 1))
            Hc[:, :, :-1].reshape(k, 2, k, 4)[np.arange(k), :, np.arange(k)] = blocks
            Hc, Hl = Hc.reshape(2 * k, -1)[rows], Hl.reshape(2 * k, 2)[rows]
            nu = self.sensor.difference(self.readings, expected).ravel()[rows]
            if joint:  # readings do not change as all points turn about the origin
                if turns:
                    around = _across(mean[self.columns].reshape(-1, 2)).ravel()
                    Hc[:, -1] = -(Hc[:, :-1] @ around + Hl @ _across(origin))
                nu = nu + Hc @ shift[chosen] + Hl @ (turn * _across(origin))
            apart = state[self.columns[:, :2]] - point
            std = self.stds(np.linalg.norm(apart, axis=1)).ravel()[rows]
            W = np.asarray(np.linalg.inv(Hc @ own @ Hc.T + np.diag(std**2)))
            M = np.asarray(np.linalg.inv(Hl.T @ W @ Hl))
            best = _Fit(origin, nu, Hc, W, M, M @ Hl.T @ W, Hl)
            if joint:
                shift = best.shift(P[chosen])
                before = np.append(state[self.columns], point)
                state = _moved(np.append(mean, origin), shift, turns)
                state, point = state[:-2], state[-2:]
                change = np.abs(np.append(state[self.columns], point) - before).max()
                if change < SETTLED * np.linalg.norm(apart, axis=1).min():
                    return best
            else:
                point = point + best.G @ nu
        return None if joint else best


class _Fit(NamedTuple):
    """A place, and the matrices of the equations above."""

    point: Array
    nu: Array
    Hc: Array
    W: Array
    M: Array
    G: Array
    Hl: Array

    @property
    def is_sound(self) -> bool:
        """Whether the place is one, not infinity where readings are parallel."""
        is_finite = np.isfinite(self.cost) and np.abs(self.point).max() <= LARGEST
        return bool(is_finite and np.linalg.eigvalsh(self.M)[0] > 0)

    @property
    def cost(self) -> float:
        """νᵀ W' ν, χ² of the readings at the best place."""
        return float(self.nu @ self.left() @ self.nu)

    def shift(self, P: Array) -> Array:
        """Return the correction of state and place, from the rows of P for H_c."""
        moved = (self.Hc @ P).T @ (self.left() @ self.nu)
        return np.concatenate([moved, self.G @ self.nu])

    def left(self) -> Array:
        """Return W'."""
        rest = self.W - self.W @ self.Hl @ self.G
        return (rest + rest.T) / 2


def _place(
    gaussian: GaussianMap, sensor: Sensor, rules: Rules, mine: Waiting, landmark: int
) -> bool:
    """Add a landmark to the map if its readings determine it.

    The fit is relative to the robot. Far from the world's origin, a rotation about the
    origin would lose digits of the points.
    """
    world, P, reference = gaussian.used
    here = world[:2].copy()
    mean = seen_from(here, world)
    firsts = [3 + 2 * gaussian.slots[_names(k)[0]] for k in mine.ids[:, 1].tolist()]
    columns = np.array(firsts)[:, None] + np.arange(4)
    std = rules.first_std, rules.second_std
    seen = SeenLandmark(sensor, std, mine.readings, columns)
    at_estimate = rules.linearisation == AT_ESTIMATE
    at = mean if at_estimate else seen_from(here, reference)
    try:
        best = _best_fit(seen, mean, P, at, rules)
    except np.linalg.LinAlgError:
        best = None
    if best is None:
        return False
    columns = np.append(columns, 2)
    way, P = _conditioned(P, best, columns, rules.frame == INVARIANT)
    mean = np.append(mean, best.point) + way
    point, axes = mean[-2:], _spread(mean, P)
    if _is_vague(axes, seen.nearest(mean, point)):
        return False
    if seen.bend(mean, point, axes) > BENT:
        return False
    world = np.append(world, best.point + here) + way
    first = np.append(reference, world[-2:])
    _hold(gaussian, BeliefArrays(world, P, first), (landmark,))
    return True


def _best_fit(
    seen: SeenLandmark, mean: Array, P: Array, reference: Array, rules: Rules
) -> _Fit | None:
    """Fit the only place that the readings allow; None where there are more or none."""
    turns, points = rules.frame == INVARIANT, _guesses(seen, mean)
    if all(_is_vague(*seen.from_known_poses(mean, point)) for point in points):
        return None
    fits = [seen.fit(mean, P, reference, point, turns) for point in points]
    sound = [fit for fit in fits if fit is not None and fit.is_sound]
    if not sound:
        return None
    best, *others = sorted(sound, key=lambda fit: fit.cost)
    near = SAME * seen.nearest(mean, best.point)
    for other in others:
        is_same = np.linalg.norm(other.point - best.point) < near
        if not is_same and other.cost < best.cost + UNLIKELY:
            return None
    if rules.iterations == 1:
        return best
    joint = seen.fit(mean, P, None, best.point, turns)
    return joint if joint is not None and joint.is_sound else None


def _is_vague(axes: Array, distance: float) -> bool:
    """Return whether a place is too uncertain for its distance; axes are 1 σ long."""
    return not CERTAIN * np.linalg.norm(axes, axis=1).max() <= distance


def _guesses(seen: SeenLandmark, state: Array) -> list[Array]:
    """Return different places at which the squared errors of the readings are least.

    From the best distance in each direction, Levenberg's method descends to a minimum
    for given poses.
    """
    turn = 2 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    rays = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    grid = rays[:, None] * DISTANCES[:, None]
    grid = grid + state[seen.columns[:, :2]].mean(axis=0)
    nu, H = seen.weighted(state, grid.reshape(-1, 2))
    cost = (nu**2).sum(axis=1)
    cost_along = cost.reshape(DIRECTIONS, -1)
    least = cost_along.min(axis=1)
    dips = (least <= np.roll(least, 1)) & (least <= np.roll(least, -1))
    chosen = np.arange(DIRECTIONS) * len(DISTANCES) + cost_along.argmin(axis=1)
    chosen = chosen[dips]
    points, nu, H, cost = (
        grid.reshape(-1, 2)[chosen],
        nu[chosen],
        H[chosen],
        cost[chosen],
    )
    damping = np.full(len(chosen), 1e-2)
    for _ in range(15):
        N = H.transpose(0, 2, 1) @ H
        scale = damping * (N[:, 0, 0] + N[:, 1, 1]) + 1e-300
        N = N + scale[:, None, None] * np.eye(2)
        step = np.linalg.solve(N, H.transpose(0, 2, 1) @ nu[..., None])[..., 0]
        new_nu, new_H = seen.weighted(state, points + step)
        new_cost = (new_nu**2).sum(axis=1)
        better = new_cost < cost
        gain = np.max(np.where(better, (cost - new_cost) / (1e-9 + cost), 0.0))
        damping = np.where(better, damping / 5, damping * 5)
        points = np.where(better[:, None], points + step, points)
        nu = np.where(better[:, None], new_nu, nu)
        H = np.where(better[:, None, None], new_H, H)
        cost = np.where(better, new_cost, cost)
        if better.any() and gain < 1e-6:
            break
    found: list[Array] = []
    centre = state[seen.columns[:, :2]].mean(axis=0)
    for point in points[np.argsort(cost)]:
        near = SAME * np.linalg.norm(point - centre)
        if all(np.linalg.norm(point - other) > near for other in found):
            found.append(point)
    return found[:4]


def _conditioned(
    P: Array, fit: _Fit, columns: IntArray, turns: bool
) -> tuple[Array, Array]:
    """Return the correction of state and landmark by all readings, and covariances."""
    cross, shift = fit.Hc @ P[columns], fit.shift(P[columns])
    to_landmark = -cross.T @ fit.G.T
    P = np.block(
        [[P - cross.T @ fit.left() @ cross, to_landmark], [to_landmark.T, fit.M]]
    )
    P = (P + P.T) / 2
    return retracted(np.zeros(len(P)), P, shift) if turns else (shift, P)


def _moved(mean: Array, shift: Array, turns: bool) -> Array:
    """Return the state after a correction, in the frame of the filter."""
    return np.asarray(mean + (moves_of(shift) if turns else shift))


def _across(points: Array) -> Array:
    """Return J of points (..., 2), turned by 90°."""
    return np.stack([-points[..., 1], points[..., 0]], axis=-1)


def _rotated(point: Array, turn: float) -> Array:
    return np.asarray(point * np.cos(turn) + _across(point) * np.sin(turn))


def _spread(mean: Array, P: Array) -> Array:
    """Return the last landmark's axes of one σ, rows (2, 2) [m], as the robot sees it.

    The error in the robot's frame is e_l − e_p − J δ e_θ.
    """
    dx, dy = mean[-2:] - mean[:2]
    own = np.array([0, 1, 2, -2, -1])
    H = np.array([[-1, 0, dy, 1, 0], [0, -1, -dx, 0, 1]])
    variances, axes = np.linalg.eigh(H @ P[np.ix_(own, own)] @ H.T)
    return np.asarray((axes * np.sqrt(np.maximum(variances, 0.0))).T)
