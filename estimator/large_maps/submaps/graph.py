"""The graph of a run: closed submaps, the active submap, and their common landmarks.

`SubmapGraph` predicts and updates the `ActiveSubmap`, closes it by the `ClosingRule`,
and fuses it with the joined map of the closed ones (`fuse`).
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from math import hypot
from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_triangular

from .... import argument_checks
from ....arrays import Array, IntArray
from ...filters.ekf import EkfSlam
from ...interface import Belief
from ...models.bearing_range import wrap_angle
from ...models.rigid_motion import (
    ErrorFrame,
    as_covariance,
    compose,
    invariant_covariance,
    points_of,
    seen_from,
    state_of,
)
from ..multifrontal import AT_ONCE, pairs
from ..undo import Undo, attributes, undo_all
from .closed_submaps import NO_SLOTS, ClosedSubmaps, Region
from .factor import Gaussian, retract, times, with_uncertain_start
from .store import LandmarkIndex, Submap, link_name


class SubmapGraph:
    """All submaps of a run.

    Parameters
    ----------
    index : LandmarkIndex
        The mapped landmarks.
    chain : Chain
        Frame of the active submap.
    closed : ClosedSubmaps
    active : ActiveSubmap
    """

    def __init__(
        self,
        index: LandmarkIndex,
        chain: Chain,
        closed: ClosedSubmaps,
        active: ActiveSubmap,
    ) -> None:
        self.index, self.chain = index, chain
        self.closed, self.active = closed, active
        #: Whether the active submap is full, but could not be written.
        self.is_overdue = False

    @property
    def pose(self) -> Array:
        """(x, y, θ) of the robot in the world, without a join, shape (3,)."""
        x, y, heading = compose(self.chain.pose, self.active.pose)[0]
        x, y = np.add(self.chain.origin, (x, y))
        return np.array([x, y, wrap_angle(float(heading))])

    def belief(self, ids: tuple[int, ...], *, remember: bool) -> Belief:
        """Return the joined belief of some landmarks.

        Parameters
        ----------
        ids : tuple of int
            Mapped landmarks, in any order.
        remember : bool
            Whether to cache the marginal of the closed submaps.
        """
        wanted = self.index.slots_of(ids)
        closed = self._in_closed(np.union1d(wanted, self._active_slots))
        world = self.closed.marginal(closed, self.chain.joined, remember=remember)
        return self._fused(closed, world, ids)

    def local_belief(self) -> Belief:
        """Return the belief of the active submap, in the frame given by the chain."""
        world = Gaussian(self.chain.pose, self.chain.covariance)
        local = self.active.gaussian()
        fused = fuse(world, local, self.active.frame, (NO_SLOTS, NO_SLOTS))
        return self._belief(fused, self._active_slots, self.active_ids())

    def active_ids(self) -> tuple[int, ...]:
        """Return the landmarks of the active submap."""
        return tuple(i for i in self.active.names if i in self.index)

    def joined_region(self, reach: float) -> tuple[Belief, Region]:
        """Return the joined belief of the landmarks around the robot.

        Parameters
        ----------
        reach : float
            Distance from the robot that the belief must cover at least [m].
        """
        known = self.chain.joined
        start = self.closed.marginal(NO_SLOTS, known)
        robot = compose(start.mean, self.active.pose)[0]
        drift = float(np.sqrt(np.trace(start.covariance[:2, :2])))
        region = Region(robot[:2], reach, 3 * drift)
        mapped = self._in_closed(self.index.slots_of(tuple(self.index)))
        near, region = self.closed.near(mapped, self.index.count, region, known)
        closed = np.union1d(near, self._in_closed(self._active_slots))
        held = {*closed.tolist(), *self._active_slots.tolist()}
        ids = tuple(i for i, slot in self.index.items() if slot in held)
        belief = self._fused(closed, self.closed.marginal(closed, known), ids)
        centre, is_all = belief.pose[:2].copy(), len(near) == len(mapped)
        return belief, region._replace(centre=centre, is_all=is_all)

    def join(self) -> None:
        """Move the active submap to its frame in the joined map."""
        joined = self.closed.join(self.chain.joined)
        last = with_uncertain_start(joined.marginal(NO_SLOTS), *self.chain.start)
        self.chain.rebase(joined.frames, last.mean, last.covariance)
        self.closed.discard_frames()

    def close(self) -> None:
        """Close the active submap, and begin the next one at the robot.

        Raises
        ------
        OSError
            If the submap cannot be written; the belief is then unchanged.
        """
        mean, covariance, _ = self.active.gaussian()
        self.is_overdue = True
        submap = Submap(self._active_slots, mean, covariance)
        self.closed = self.closed.with_appended(submap)
        self.is_overdue = False
        self.chain.extend(mean[:3], self.active.pose_covariance)
        self.active.begin()

    def checkpoint(self) -> Undo:
        """Return what takes back later changes, but for those of the active submap."""
        return undo_all(
            self.index.checkpoint(),
            self.closed.checkpoint(),
            attributes(self, self.chain),
        )

    def remove(self, ids: list[int]) -> None:
        """Remove mapped landmarks; those of several submaps remain as links."""
        self.active.remove(ids, self.index, self.closed.slots)
        for i in ids:
            self.index.remove(i)

    def merge_pairs(self, pairs: Sequence[tuple[int, int]]) -> None:
        """Condition on pairs of landmarks being one, and remove the second ones."""
        closed = self.closed
        for kept, gone in pairs:
            closed = closed.with_merged(self.index[kept], self.index[gone])
        self.active.merge_pairs(pairs)
        self.closed = closed
        for _, gone in pairs:
            self.index.remove(gone)

    @property
    def _active_slots(self) -> IntArray:
        return self.index.slots_of(self.active.names)

    def _in_closed(self, slots: IntArray) -> IntArray:
        """Return the slots that closed submaps hold."""
        return slots[[slot in self.closed.slots for slot in slots.tolist()]]

    def _fused(self, closed: IntArray, world: Gaussian, ids: tuple[int, ...]) -> Belief:
        """Fuse the active submap with closed landmarks; return a part of the result."""
        slots, active = self._active_slots, self.active
        _, in_world, in_local = np.intersect1d(closed, slots, return_indices=True)
        fused = fuse(world, active.gaussian(), active.frame, (in_world, in_local))
        fused = with_uncertain_start(fused, *self.chain.start)
        order = np.concatenate([closed, np.delete(slots, in_local)])
        return self._belief(fused, order, ids)

    def _belief(self, map_: Gaussian, order: IntArray, ids: tuple[int, ...]) -> Belief:
        """Return a part of a map, in the coordinates of the world."""
        mean = seen_from(-self.chain.origin, map_.mean)
        map_ = map_._replace(mean=mean)
        return part_of(map_, order, self.index.slots_of(ids), ids)


# --------------------------------------------------------------------------------------
# Fusion of the active submap with the joined map of the closed ones.
#
# A landmark in both has one position, which is an exact measurement of zero difference.
# With the frame F = (p, θ) of the active submap and a landmark l in the world, and c
# the same landmark in the submap::
#
#     0 = R(θ)ᵀ (l − p) − c
#
# In the coordinates ξ of :mod:`.rigid_motion` its derivative is R(θ)ᵀ (ξ_l − ξ_p) − δc.
# It does not depend on the heading, so the measurement gains no information about the
# orientation of the whole map.


def fuse(
    world: Gaussian, local: Gaussian, frame: ErrorFrame, both: tuple[IntArray, IntArray]
) -> Gaussian:
    """Fuse the active submap with the map.

    Parameters
    ----------
    world : Gaussian
        The submap's frame and the map's landmarks, in the world.
    local : Gaussian
        The robot's pose and landmarks in the submap.  Its covariance belongs to the
        error in ``frame``, that of ``world`` to the additive error.
    frame : {"additive", "invariant"}
        Coordinates of the local error.
    both : tuple of two ndarrays
        Positions of the common landmarks in both.

    Returns
    -------
    Gaussian
        The robot's pose in the world, the map's landmarks, then the landmarks that only
        the submap holds.
    """
    mean, own, cut = world.mean, local.mean, len(world.mean)
    V = np.empty((0, cut + len(own)))
    if len(both[0]):
        A, innovation = _difference(mean, own, frame, both)
        seen = _in_invariant(world, np.append(np.arange(3), 3 + pairs(both[0])))
        AP = np.hstack([A[:, : len(seen)] @ seen, A[:, len(seen) :] @ local.covariance])
        used = np.r_[0:3, 3 + pairs(both[0]), cut : cut + len(own)]
        S = AP[:, used] @ A.T
        lower = _root((S + S.T) / 2)
        V = solve_triangular(
            lower, np.column_stack([AP, innovation]), lower=True, check_finite=False
        )
        V, step = V[:, :-1], V[:, :-1].T @ V[:, -1]
        mean = retract(mean, step[:cut], "invariant")
        own = retract(own, step[cut:], frame)
    return _composed(world, mean, local._replace(mean=own), V, (frame, both[1]))


def _in_invariant(world: Gaussian, rows: IntArray) -> Array:
    """Return some rows of the covariance in the coordinates ξ."""
    lever = state_of(1j * points_of(world.mean), 0.0)
    half = world.block(rows) - np.outer(lever[rows], world.block(np.array([2])))
    return np.asarray(half - np.outer(half[:, 2], lever))


def _root(S: Array) -> Array:
    try:
        return np.linalg.cholesky(S).astype(np.float64, copy=False)
    except np.linalg.LinAlgError:
        raise np.linalg.LinAlgError(
            "the active submap cannot be joined to the map, because the covariance of "
            "their differences is not positive definite: measurement_std is degenerate"
        ) from None


def _difference(
    mean: Array, own: Array, frame: ErrorFrame, common: tuple[IntArray, IntArray]
) -> tuple[Array, Array]:
    """Return the Jacobian by (ξ of start and landmarks, local error), and ν."""
    size = 2 * len(common[0])
    rows, out = np.arange(size), np.exp(-1j * mean[2])
    A = np.zeros((size, 3 + size + len(own)))
    A[:, :2] = -np.tile(np.eye(2), (len(common[0]), 1))
    A[rows, 3 + rows] = 1.0
    A = times(out, A)
    A[rows, size + 6 + pairs(common[1])] = -1.0
    c = points_of(own)[1 + common[1]]
    if frame == "invariant":
        A[:, size + 5] = -(1j * c).view(np.float64)
    points = points_of(mean)
    difference = out * (points[1 + common[0]] - points[0]) - c
    return A, -difference.view(np.float64)


def _composed(
    world: Gaussian,
    mean: Array,
    local: Gaussian,
    V: Array,
    of_local: tuple[ErrorFrame, IntArray],
) -> Gaussian:
    """Return robot, map and new landmarks in the world, with additive error.

    Parameters
    ----------
    world : Gaussian
        Before the fusion.
    mean : ndarray
        Of the world, after it.
    local : Gaussian
        The submap's mean after it, and its covariance before it, in ``frame``.
    V : ndarray, shape (r, ·)
        The joint covariance falls by Vᵀ V.
    of_local : (frame, known)
        Coordinates of the local error, and the submap's landmarks that the map holds.
    """
    (frame, known), own, cut = of_local, local.mean, len(mean)
    fresh = np.setdiff1d(np.arange((len(own) - 3) // 2), known)
    pose, by_start, by_pose = compose(mean[:3], own[:3])
    seen = np.exp(1j * mean[2]) * points_of(own)[1 + fresh]
    points = np.concatenate(
        [[complex(*pose[:2])], points_of(mean)[1:], complex(*mean[:2]) + seen]
    )
    # T takes the errors of start and submap to those of robot and new landmarks.
    T = np.zeros((3 + 2 * len(fresh), 3 + len(own)))
    T[:3, :3], T[:3, 3:6] = by_start, by_pose
    T[3:, :2] = np.tile(np.eye(2), (len(fresh), 1))
    T[3:, 2] = (1j * seen).view(np.float64)
    new = np.zeros((2 * len(fresh), len(own)))
    new[np.arange(2 * len(fresh)), 3 + pairs(fresh)] = 1.0
    T[3:, 3:] = times(np.exp(1j * mean[2]), new)
    # From ξ to the additive error: e = ξ + (J q; 0 at θ) ξ_θ.
    lever = state_of(1j * points_of(mean), 0.0)
    T[:, 2] += T[:, :3] @ lever[:3]
    if frame == "invariant":
        T[:, 5] += T[:, 3:] @ state_of(1j * points_of(own), 0.0)
    at = np.r_[0:3, cut : cut + len(own)]
    start = T[:, :3] @ _in_invariant(world, np.arange(3))
    rows = np.hstack([start, T[:, 3:] @ local.covariance]) - (T @ V[:, at].T) @ V
    covariance = _changed_map(world, 2 * len(points) + 1, _changes(world, lever, V))
    few = np.r_[0:3, cut : len(covariance)]
    covariance[few, 3:cut] = rows[:, 3:cut] + np.outer(rows[:, 2], lever[3:])
    covariance[3:cut, few] = covariance[few, 3:cut].T
    covariance[np.ix_(few, few)] = as_covariance(rows[:, at] @ T.T)
    is_known = covariance.diagonal() <= 0  # without variance, only rounding is left
    covariance[is_known], covariance[:, is_known] = 0.0, 0.0
    return Gaussian(state_of(points, float(pose[2])), covariance)


def _changes(world: Gaussian, lever: Array, V: Array) -> Array:
    """Return the rows u, d and W, with which the fusion changes the map.

    The covariance of its landmarks becomes ::

        P + d uᵀ + u dᵀ − Wᵀ W,    u = P_θ + d P_θθ / 2,    W = V + V_θ (J q)ᵀ

    The turn of the map about its origin adds d = J (q − q before) to the derivatives.
    """
    heading = world.block(np.array([2]))[0]
    d = lever - state_of(1j * points_of(world.mean), 0.0)
    u = heading + d * (heading[2] / 2)
    return np.vstack([u, d, V[:, : len(lever)] + np.outer(V[:, 2], lever)])


def _changed_map(world: Gaussian, size: int, W: Array) -> Array:
    """Return an array, shape (size, size), with the rows of `_changes` added.

    Only its entries between two of the map's landmarks are set.  The array may use the
    memory of a covariance with an order, which is then lost.
    """
    P, left = world.covariance, np.vstack([W[1], W[0], -W[2:]])
    if world.order is not None and size <= len(P):
        found = P.reshape(-1)[: size**2].reshape(size, size)
    else:
        found = np.empty((size, size))
    room = np.empty((AT_ONCE, W.shape[1]))
    for first in range(3, W.shape[1], AT_ONCE):
        own, so_far = slice(first, min(first + AT_ONCE, W.shape[1])), slice(3, first)
        here = slice(3, own.stop)
        rows = room[: own.stop - first, here]
        np.matmul(left[:, own].T, W[:, here], out=rows)
        world.add_to(rows, first)
        found[own, so_far] = rows[:, : first - 3]
        found[so_far, own] = rows[:, : first - 3].T
        found[own, own] = as_covariance(rows[:, first - 3 :])
    return found


def part_of(
    map_: Gaussian, order: IntArray, wanted: IntArray, ids: tuple[int, ...]
) -> Belief:
    """Return the marginal of the pose and some landmarks.

    Parameters
    ----------
    map_ : Gaussian
        Of n landmarks; the belief keeps its covariance.
    order : ndarray, shape (n,)
        Slots of these landmarks.
    wanted : ndarray, shape (v,)
        Slots of the wanted landmarks.
    ids : tuple of int
        Identities of the wanted landmarks.
    """
    sorter = np.argsort(order)
    places = sorter[np.searchsorted(order, wanted, sorter=sorter)]
    rows = np.concatenate([np.arange(3), 3 + pairs(places)])
    covariance = map_.covariance
    if not np.array_equal(rows, np.arange(len(covariance))):
        covariance = covariance[rows[:, None], rows]
    return Belief.owning(map_.mean[rows], covariance, ids, "invariant")


ORIGIN = (0.0, 0.0, 0.0)
SIZE = 50  # landmarks of a submap, where scans hold no more


class ActiveSubmap:
    """The active submap, with its landmarks and links.

    Parameters
    ----------
    slam : EkfSlam
        Its filter.
    """

    def __init__(self, slam: EkfSlam) -> None:
        self.filter = slam
        #: Coordinates of the error.
        self.frame = slam.frame

    def begin(self) -> None:
        """Begin a new submap, with the robot at the origin of the frame."""
        self.filter.reset(ORIGIN, ORIGIN)

    def __len__(self) -> int:
        return len(self.filter.map.slots)

    def __contains__(self, landmark_id: int) -> bool:
        return landmark_id in self.filter.map.slots

    @property
    def names(self) -> tuple[int, ...]:
        """Landmarks and links, in the order of the filter."""
        return self.filter.landmark_ids

    @property
    def pose(self) -> Array:
        """(x, y, θ) of the robot, shape (3,); the heading is not wrapped."""
        return self.filter.map.mean[:3]

    @property
    def pose_covariance(self) -> Array:
        """Covariance of the additive pose error, shape (3, 3)."""
        return self.filter.map.covariance[:3, :3].copy()

    def gaussian(self) -> Gaussian:
        """Return pose, landmarks and links, with the error in ``frame``."""
        mean, covariance, _ = self.filter.map.used
        if self.filter.frame == "invariant":
            return Gaussian(mean.copy(), invariant_covariance(mean, covariance))
        return Gaussian(mean.copy(), covariance.copy())

    def remove(
        self, ids: Collection[int], index: LandmarkIndex, shared: Collection[int]
    ) -> None:
        """Marginalise landmarks, except those that remain as links.

        Parameters
        ----------
        ids : collection of int
            Mapped landmarks, in this submap or not.
        index : LandmarkIndex
            The mapped landmarks.
        shared : collection of int
            Slots that other submaps hold.
        """
        here = [i for i in ids if i in self]
        links = {i: link_name(index[i]) for i in here if index[i] in shared}
        self.filter.map.rename(links)
        if alone := [i for i in here if i not in links]:
            self.filter.remove(alone)

    def merge_pairs(self, pairs: Sequence[tuple[int, int]]) -> None:
        """Merge pairs of landmarks that the submap holds; otherwise rename."""
        here = [(kept, gone) for kept, gone in pairs if gone in self]
        if both := [pair for pair in here if pair[0] in self]:
            self.filter.merge_pairs(both)
        self.filter.map.rename({gone: kept for kept, gone in here if gone in self})


class ClosingRule(NamedTuple):
    """Limits of a submap; infinite ones have no effect."""

    size: int | None  # number of landmarks; None: see `closes`
    heading: float  # standard deviation of the heading in the frame of the submap [rad]
    extent: float  # distance of the robot from the origin of the frame [m]

    @classmethod
    def checked(
        cls, size: int | None, heading: float | None, extent: float | None
    ) -> ClosingRule:
        """Return the rule of the options of :class:`SubmapSlam`, which it checks."""
        if size is not None:
            argument_checks.whole("submap_size", size, 1)
        limits = (("heading_limit", heading), ("extent_limit", extent))
        heading_limit, extent_limit = (
            np.inf if value is None else argument_checks.above(name, value, 0.0)
            for name, value in limits
        )
        return cls(size, heading_limit, extent_limit)

    def closes(self, active: ActiveSubmap, readings: int) -> bool:
        """Return whether the submap has reached a limit with this scan."""
        x, y, _ = active.pose.tolist()
        own_size = SIZE if readings <= SIZE else 2 * readings
        return (
            len(active) >= (self.size or own_size)
            or active.pose_covariance[2, 2] > self.heading**2
            or hypot(x, y) > self.extent
        )


class Chain:
    """The frame of the active submap, without a join.

    The frame is the composition of the last poses of all submaps since the start of the
    run or the last join.  Its covariance is consistent, but does not account for loops
    closed since then.  All frames, and the joined map, are relative to the position of
    the start: a rotation about a far origin would lose digits of the map.

    Parameters
    ----------
    pose, covariance : ndarray, shapes (3,) and (3, 3)
        Start of the run in the world.
    """

    def __init__(self, pose: Array, covariance: Array) -> None:
        #: Position of the start in the world, shape (2,) [m].
        self.origin = pose[:2].copy()
        self.start = (np.array([0.0, 0.0, pose[2]]), covariance.copy())
        self.pose, self.covariance = self.start
        #: Frames of the last join, shape (J + 1, 3).
        self.joined = self.pose[None].copy()

    def extend(self, pose: Array, covariance: Array) -> None:
        """Append a submap by its last pose, shape (3,), and that pose's covariance."""
        self.pose, by_start, by_pose = compose(self.pose, pose)
        moved = by_start @ self.covariance @ by_start.T
        self.covariance = moved + by_pose @ covariance @ by_pose.T

    def rebase(self, joined: Array, pose: Array, covariance: Array) -> None:
        """Replace the frames, and the last of them with its covariance."""
        self.joined = joined.copy()
        self.pose, self.covariance = pose.copy(), covariance.copy()

    def state_dict(self) -> dict[str, Array]:
        """Return copies of the whole state, as arrays."""
        pose, covariance = self.start
        return {
            "start": np.vstack([seen_from(-self.origin, pose), covariance]),
            "present": np.vstack([self.pose, self.covariance]),
            "joined": self.joined.copy(),
        }

    @classmethod
    def restored(cls, state: dict[str, Array]) -> Chain:
        """Return the chain that :meth:`state_dict` saved."""
        chain = cls(state["start"][0], state["start"][1:])
        chain.rebase(state["joined"], state["present"][0], state["present"][1:])
        return chain
