"""The graph of a run: closed submaps, the active submap, and their common landmarks."""

from collections.abc import Sequence

import numpy as np

from ....arrays import Array, IntArray
from ...interface import Belief
from ...models.bearing_range import wrap_angle
from ...models.rigid_motion import compose
from ...support.undo import Undo, attributes, undo_all
from .active_submap import ActiveSubmap
from .chain import Chain
from .closed_submaps import ClosedSubmaps
from .fusion import fuse, part_of
from .gaussian import Gaussian, with_uncertain_start
from .landmark_index import LandmarkIndex
from .neighbourhood import Region
from .store import Submap

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
