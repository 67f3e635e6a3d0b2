"""Landmarks that one reading does not place: first placed from several poses.

A bearing or a range alone does not determine where a landmark is.  Its readings wait,
and the poses from which they were made stay in the state beside the landmarks, with all
their correlations [1]_.  Once the readings determine the landmark, `collect` adds it to
the map, and they correct the belief, each of them once, as one measurement together.

A past pose is two points of the map, its position p and q = p + (cos θ, sin θ).  The
error of q is e_q = e_p + J (q − p) e_θ.  Therefore every filter of the family keeps a
pose consistent like two landmarks, in either error frame.  Of a landmark l, with the
poses c, k readings satisfy::

    ν = H_c e_c + H_l e_l + v,    S = H_c P H_cᵀ + R,    W = S⁻¹
    M = (H_lᵀ W H_l)⁻¹,   G = M H_lᵀ W,   W' = W − W H_l G
    l ← l̂ + G ν,   P_ll = M,   P_xl = −P H_cᵀ Gᵀ
    x ← x + P H_cᵀ W' ν,   P ← P − P H_cᵀ W' H_c P

This is the limit of a Kalman update of a landmark without prior knowledge.

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
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any, NamedTuple

import numpy as np

from ...arrays import LARGEST, Array, BoolArray, IntArray
from ..kernels.kalman_gain import (
    AFTER_STDS,
    AT_ESTIMATE,
    FIRST_STD,
    INVARIANT,
    BeliefArrays,
    Rules,
)
from ..models.sensors import Sensor
from ..support import saved_states
from ..support.argument_checks import LOWEST_ID, RESERVED_IDS
from ..support.saved_states import NUMBERS, WHOLE, Table, with_prefix, without_prefix
from .conditioning import retracted
from .gaussian_map import GaussianMap

#: Past poses kept; beyond it, the one nearest to the pose before it goes.
MOST_POSES = 40
CERTAIN = 10.0  # distance of a placed landmark, in its standard deviations
BENT = 0.1  # second-order change of its readings, in theirs
UNLIKELY = 23.0  # 2 log 10⁵: excess of the cost of other places
DIRECTIONS, DISTANCES = 24, np.geomspace(0.5, 100.0, 12)  # first guesses, [m]
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


def collect(
    gaussian: GaussianMap, sensor: Sensor, rules: Rules, waiting: Waiting, new: Waiting
) -> tuple[Waiting, tuple[int, ...]]:
    """Take in readings of landmarks that are not mapped, and place those it can.

    Parameters
    ----------
    gaussian : GaussianMap
        The map after the update by the scan; it is changed.
    waiting, new : Waiting
        Readings of former scans, and of this one; the poses of these are not read.

    Returns
    -------
    waiting : Waiting
        The readings that wait from now on.
    placed : tuple of int
        Landmarks that have entered the map.
    """
    placed = []
    if len(new.ids):
        pose = _add_pose(gaussian, rules)
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
            if _place(gaussian, sensor, rules, waiting.where(mine), landmark):
                placed.append(landmark)
                waiting = waiting.where(~mine)
    return _forget_poses(gaussian, waiting), tuple(placed)


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
    n, last = len(mean), max(_poses(gaussian), default=-1)
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
        crowded = kept[1 + int(np.argmin(steps[:-1]))]
        gone.append(crowded)
        waiting = waiting.where(waiting.ids[:, 1] != crowded)
    if gone:
        gaussian.remove([point for pose in gone for point in _names(pose)])
    return waiting


class _Seen(NamedTuple):
    """Readings of one landmark from k past poses."""

    sensor: Sensor
    noise: tuple[float, ...]
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

    def stds(self, distances: Array) -> Array:
        """Return the standard deviations of the readings, shape (..., 2)."""
        std = self.sensor.std(self.noise, distances)
        return np.stack(np.broadcast_arrays(distances, *std)[1:], axis=-1)

    def fit(self, state: Array, P: Array, reference: Array, point: Array) -> _Fit:
        """Fit a place to the readings under the uncertainty of the poses."""
        k, size = len(self.readings), self.sensor.size
        rows = np.flatnonzero(np.arange(2 * k) % 2 < size)
        columns = self.columns.ravel()
        own = P[np.ix_(columns, columns)]
        for _ in range(4):
            expected = self.linearise(state, point)[0]
            _, blocks, Hl = self.linearise(reference, point)
            nu = self.sensor.difference(self.readings, expected).ravel()[rows]
            Hc = np.zeros((k, 2, k, 4))
            Hc[np.arange(k), :, np.arange(k)] = blocks
            Hc = Hc.reshape(2 * k, -1)[rows]
            apart = state[self.columns[:, :2]] - point
            std = self.stds(np.linalg.norm(apart, axis=1)).ravel()[rows]
            W = np.asarray(np.linalg.inv(Hc @ own @ Hc.T + np.diag(std**2)))
            Hl = Hl.reshape(2 * k, 2)[rows]
            M = np.asarray(np.linalg.inv(Hl.T @ W @ Hl))
            G = M @ Hl.T @ W
            best = _Fit(point, nu, Hc, W, M, G, Hl)
            point = point + G @ nu
        return best


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

    def left(self) -> Array:
        """Return W'."""
        rest = self.W - self.W @ self.Hl @ self.G
        return (rest + rest.T) / 2


def _place(
    gaussian: GaussianMap, sensor: Sensor, rules: Rules, mine: Waiting, landmark: int
) -> bool:
    """Add a landmark to the map if its readings determine it."""
    mean, P, reference = gaussian.used
    firsts = [3 + 2 * gaussian.slots[_names(k)[0]] for k in mine.ids[:, 1].tolist()]
    columns = np.array(firsts)[:, None] + np.arange(4)
    seen = _Seen(sensor, tuple(rules[FIRST_STD:AFTER_STDS]), mine.readings, columns)
    at = mean if rules.linearisation == AT_ESTIMATE else reference
    try:
        fits = [seen.fit(mean, P, at, point) for point in _guesses(seen, mean)]
    except np.linalg.LinAlgError:
        return False
    fits = sorted((fit for fit in fits if fit.is_sound), key=lambda fit: fit.cost)
    if not fits:
        return False
    best, poses = fits[0], mean[columns[:, :2]]
    nearest = np.linalg.norm(poses - best.point, axis=1).min()
    for other in fits[1:]:
        is_same = np.linalg.norm(other.point - best.point) < SAME * nearest
        if not is_same and other.cost < best.cost + UNLIKELY:
            return False
    grown = _conditioned(mean, P, best, columns.ravel(), rules)
    axes = _spread(grown.mean, grown.covariance)
    if not CERTAIN * np.linalg.norm(axes, axis=1).max() <= nearest:
        return False
    if seen.bend(mean, best.point, axes) > BENT:
        return False
    first = np.concatenate([reference, grown.mean[-2:]])
    _hold(gaussian, BeliefArrays(grown.mean, grown.covariance, first), (landmark,))
    return True


def _guesses(seen: _Seen, state: Array) -> list[Array]:
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
    least = cost.reshape(DIRECTIONS, -1).argmin(axis=1)
    chosen = np.arange(DIRECTIONS) * len(DISTANCES) + least
    points, nu, H, cost = (
        grid.reshape(-1, 2)[chosen],
        nu[chosen],
        H[chosen],
        cost[chosen],
    )
    damping = np.full(DIRECTIONS, 1e-2)
    for _ in range(15):
        N = H.transpose(0, 2, 1) @ H
        scale = damping * (N[:, 0, 0] + N[:, 1, 1]) + 1e-300
        N = N + scale[:, None, None] * np.eye(2)
        step = np.linalg.solve(N, H.transpose(0, 2, 1) @ nu[..., None])[..., 0]
        new_nu, new_H = seen.weighted(state, points + step)
        new_cost = (new_nu**2).sum(axis=1)
        better = new_cost < cost
        damping = np.where(better, damping / 5, damping * 5)
        points = np.where(better[:, None], points + step, points)
        nu = np.where(better[:, None], new_nu, nu)
        H = np.where(better[:, None, None], new_H, H)
        cost = np.where(better, new_cost, cost)
    found: list[Array] = []
    centre = state[seen.columns[:, :2]].mean(axis=0)
    for point in points[np.argsort(cost)]:
        near = SAME * np.linalg.norm(point - centre)
        if all(np.linalg.norm(point - other) > near for other in found):
            found.append(point)
    return found[:4]


def _conditioned(
    mean: Array, P: Array, fit: _Fit, columns: IntArray, rules: Rules
) -> BeliefArrays:
    """Return the belief with the landmark, after all of its readings."""
    cross = fit.Hc @ P[columns]
    left = fit.left()
    shift = np.concatenate([cross.T @ (left @ fit.nu), fit.G @ fit.nu])
    to_landmark = -cross.T @ fit.G.T
    P = np.block([[P - cross.T @ left @ cross, to_landmark], [to_landmark.T, fit.M]])
    P = (P + P.T) / 2
    mean = np.concatenate([mean, fit.point])
    if rules.frame == INVARIANT:
        mean, P = retracted(mean, P, shift)
    else:
        mean = mean + shift
    return BeliefArrays(mean, P, mean)


def _spread(mean: Array, P: Array) -> Array:
    """Return the last landmark's axes of one σ, rows (2, 2) [m], as the robot sees it.

    The error in the robot's frame is e_l − e_p − J δ e_θ.
    """
    dx, dy = mean[-2:] - mean[:2]
    own = np.array([0, 1, 2, -2, -1])
    H = np.array([[-1, 0, dy, 1, 0], [0, -1, -dx, 0, 1]])
    variances, axes = np.linalg.eigh(H @ P[np.ix_(own, own)] @ H.T)
    return np.asarray((axes * np.sqrt(np.maximum(variances, 0.0))).T)
