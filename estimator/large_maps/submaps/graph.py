"""The graph of a run: closed submaps, the active submap, and their common landmarks.

`SubmapGraph` predicts and updates the `ActiveSubmap`, closes it by the `ClosingRule`,
and fuses it with the joined map of the closed ones (`fuse`).
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from math import hypot
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag, solve_triangular

from ....arrays import Array, IntArray
from ...filters.ekf import FRAMES, EkfSlam
from ...interface import Belief
from ...models.bearing_range import wrap_angle
from ...models.rigid_motion import (
    ErrorFrame,
    as_covariance,
    compose,
    invariant_covariance,
)
from ...support import argument_checks
from ...support.undo import Undo, attributes, undo_all
from ..multifrontal import pairs
from .closed_submaps import ClosedSubmaps, Region
from .factor import Gaussian, points_of, retract, state_of, times, with_uncertain_start
from .store import LandmarkIndex, Submap, link_name

NO_SLOTS: IntArray = np.empty(0, dtype=np.int64)


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
        self.is_overdue = False
        """Whether the active submap is full, but could not be written."""

    @property
    def pose(self) -> Array:
        """(x, y, θ) of the robot in the world, without a join, shape (3,)."""
        x, y, heading = compose(self.chain.pose, self.active.pose)[0]
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
        ids = self.active_ids()
        return part_of(fused, self._active_slots, self.index.slots_of(ids), ids)

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
        frame = with_uncertain_start(joined.marginal(NO_SLOTS), *self.chain.start)
        self.chain.rebase(joined.frames, *frame)
        self.closed.discard_frames()

    def close(self) -> None:
        """Close the active submap, and begin the next one at the robot.

        Raises
        ------
        OSError
            If the submap cannot be written; the belief is then unchanged.
        """
        mean, covariance = self.active.gaussian()
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
        return part_of(fused, order, self.index.slots_of(ids), ids)


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
    world: Gaussian,
    local: Gaussian,
    frame: ErrorFrame,
    common: tuple[IntArray, IntArray],
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
    common : tuple of two ndarrays
        Positions of the common landmarks in both.

    Returns
    -------
    Gaussian
        The robot's pose in the world, the map's landmarks, then the landmarks that only
        the submap holds.
    """
    mean, own = world.mean, local.mean
    prior = block_diag(invariant_covariance(mean, world.covariance), local.covariance)
    if len(common[0]):
        A, innovation = _difference(mean, own, frame, common)
        AP = A @ prior
        S = AP @ A.T
        lower = _root((S + S.T) / 2)
        V = solve_triangular(
            lower, np.column_stack([AP, innovation]), lower=True, check_finite=False
        )
        step = V[:, :-1].T @ V[:, -1]
        prior -= V[:, :-1].T @ V[:, :-1]
        mean = retract(mean, step[: len(mean)], "invariant")
        own = retract(own, step[len(mean) :], frame)
    return _composed(mean, own, prior, frame, common[1])


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
    """Return the Jacobian by (ξ, local error), and the innovation."""
    count = len(common[0])
    out = np.exp(-1j * mean[2])
    inside = 3 + pairs(common[0])
    beside = len(mean) + 3 + pairs(common[1])
    A = np.zeros((2 * count, len(mean) + len(own)))
    A[:, :2] = -np.tile(np.eye(2), (count, 1))
    A[np.arange(2 * count), inside] = 1.0
    A = times(out, A)
    A[np.arange(2 * count), beside] = -1.0
    c = points_of(own)[1 + common[1]]
    if frame == "invariant":
        A[:, len(mean) + 2] = -(1j * c).view(np.float64)
    points = points_of(mean)
    difference = out * (points[1 + common[0]] - points[0]) - c
    return A, -difference.view(np.float64)


def _composed(
    mean: Array, own: Array, covariance: Array, frame: ErrorFrame, known: IntArray
) -> Gaussian:
    """Return robot, map and new landmarks in the world, with additive error."""
    fresh = np.setdiff1d(np.arange((len(own) - 3) // 2), known)
    pose, by_start, by_pose = compose(mean[:3], own[:3])
    seen = np.exp(1j * mean[2]) * points_of(own)[1 + fresh]
    landmarks = points_of(mean)[1:]
    points = np.concatenate(
        [[complex(*pose[:2])], landmarks, complex(*mean[:2]) + seen]
    )
    cut = len(mean)
    T = np.zeros((cut + 2 * len(fresh), len(covariance)))
    T[:3, :3], T[:3, cut : cut + 3] = by_start, by_pose
    T[np.arange(3, cut), np.arange(3, cut)] = 1.0
    T[cut:, :2] = np.tile(np.eye(2), (len(fresh), 1))
    T[cut:, 2] = (1j * seen).view(np.float64)
    new = np.zeros((2 * len(fresh), len(own)))
    new[np.arange(2 * len(fresh)), 3 + pairs(fresh)] = 1.0
    T[cut:, cut:] = times(np.exp(1j * mean[2]), new)
    # From ξ to the additive error: e = ξ + (J q; 0 at θ) ξ_θ.
    T[:, 2] += T[:, :cut] @ state_of(1j * points_of(mean), 0.0)
    if frame == "invariant":
        T[:, cut + 2] += T[:, cut:] @ state_of(1j * points_of(own), 0.0)
    moved = as_covariance(T @ covariance @ T.T)
    return Gaussian(state_of(points, float(pose[2])), moved)


def part_of(
    map_: Gaussian, order: IntArray, wanted: IntArray, ids: tuple[int, ...]
) -> Belief:
    """Return the marginal of the pose and some landmarks.

    Parameters
    ----------
    map_ : Gaussian
        Of n landmarks.
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
    covariance = map_.covariance[rows[:, None], rows]
    return Belief(map_.mean[rows], covariance, ids, "invariant")


ORIGIN = (0.0, 0.0, 0.0)


class ActiveSubmap:
    """The active submap, with its landmarks and links.

    Parameters
    ----------
    slam : EkfSlam
        Its filter.
    """

    def __init__(self, slam: EkfSlam) -> None:
        self.filter = slam
        self.frame = FRAMES[slam.rules.frame]
        """Coordinates of the error."""

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
    def heading_variance(self) -> float:
        """Variance of the heading in the frame of the submap [rad²]."""
        return float(self.filter.map.covariance[2, 2])

    @property
    def pose_covariance(self) -> Array:
        """Covariance of the additive pose error, shape (3, 3)."""
        return self.filter.map.covariance[:3, :3].copy()

    def gaussian(self) -> Gaussian:
        """Return pose, landmarks and links, with the error in ``frame``."""
        gaussian = self.filter.map
        mean = gaussian.mean[: gaussian.size].copy()
        return Gaussian(mean, self.filter.belief().error_covariance())

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

    size: int  # number of landmarks
    heading: float  # standard deviation of the heading in the frame of the submap [rad]
    extent: float  # distance of the robot from the origin of the frame [m]

    @classmethod
    def checked(
        cls, size: int, heading: float | None, extent: float | None
    ) -> ClosingRule:
        """Return the rule of the options of :class:`SubmapSlam`, which it checks."""
        least = argument_checks.whole("submap_size", size, 1)
        limits = (("heading_limit", heading), ("extent_limit", extent))
        heading_limit, extent_limit = (
            np.inf if value is None else argument_checks.above(name, value, 0.0)
            for name, value in limits
        )
        return cls(least, heading_limit, extent_limit)

    def closes(self, active: ActiveSubmap) -> bool:
        """Return whether the submap has reached a limit."""
        x, y, _ = active.pose.tolist()
        return (
            len(active) >= self.size
            or active.heading_variance > self.heading**2
            or hypot(x, y) > self.extent
        )


class Chain:
    """The frame of the active submap in the world, without a join.

    The frame is the composition of the last poses of all submaps since the start of the
    run or the last join.  Its covariance is consistent, but does not account for loops
    closed since then.

    Parameters
    ----------
    pose, covariance : ndarray, shapes (3,) and (3, 3)
        Start of the run in the world.
    """

    def __init__(self, pose: Array, covariance: Array) -> None:
        self.start = (pose.copy(), covariance.copy())
        self.pose, self.covariance = self.start
        self.joined = pose[None].copy()
        """Frames of the last join, shape (J + 1, 3)."""

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
        return {
            "start": np.vstack(self.start),
            "present": np.vstack([self.pose, self.covariance]),
            "joined": self.joined.copy(),
        }

    @classmethod
    def restored(cls, state: dict[str, Array]) -> Chain:
        """Return the chain that :meth:`state_dict` saved."""
        chain = cls(state["start"][0], state["start"][1:])
        chain.rebase(state["joined"], state["present"][0], state["present"][1:])
        return chain
