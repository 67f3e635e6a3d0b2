"""A run in submaps: the closed ones and the present one, and what they say together."""

import numpy as np
from numpy.typing import NDArray

from ...interface import Belief
from .active_submap import PresentSubmap
from .chain import Chain
from .closed_submaps import ClosedSubmaps
from .factor import compose
from .fusion import fuse, part_of
from .joining import Gaussian, with_uncertain_start
from .landmark_index import Slots
from .neighbourhood import Extent
from .store import Submap

Array = NDArray[np.float64]
Int = NDArray[np.int64]

NONE: Int = np.empty(0, dtype=np.int64)


class SubmapRun:
    """All that a run in submaps consists of.

    Parameters
    ----------
    slots : Slots
        Who is in the map.
    chain : Chain
        Where the present submap begins.
    closed : ClosedSubmaps
    present : PresentSubmap
    """

    def __init__(
        self, slots: Slots, chain: Chain, closed: ClosedSubmaps, present: PresentSubmap
    ) -> None:
        self.slots, self.chain = slots, chain
        self.closed, self.present = closed, present
        self.is_overdue = False
        """Whether the present submap should be closed, but could not be written."""

    def belief(self, ids: tuple[int, ...], *, remember: bool) -> Belief:
        """Return the joined belief of some landmarks.

        Parameters
        ----------
        ids : tuple of int
            Mapped landmarks, in any order.
        remember : bool
            Whether to keep what the closed submaps say of them until one is added.
        """
        wanted = self.slots.of(ids)
        closed = self._of_closed(np.union1d(wanted, self._present_slots))
        ask = self.closed.everything if remember else self.closed.marginal
        return self._fused(closed, ask(closed, self.chain.joined), ids)

    def local_belief(self) -> Belief:
        """Return the belief of the present submap, as the chain places it."""
        world = Gaussian(self.chain.pose, self.chain.covariance)
        fused = fuse(world, self.present.gaussian(), self.present.frame, (NONE, NONE))
        ids = tuple(i for i in self.present.names if i in self.slots)
        return part_of(fused, self._present_slots, self.slots.of(ids), ids)

    def survey(self, reach: float) -> tuple[Belief, Extent]:
        """Return the joined belief of the landmarks around the robot.

        Parameters
        ----------
        reach : float
            How far from the robot landmarks are to be found in it at least [m].
        """
        known = self.chain.joined
        start = self.closed.marginal(NONE, known)
        robot = compose(start.mean, self.present.pose)[0]
        drift = float(np.sqrt(np.trace(start.covariance[:2, :2])))
        extent = Extent(robot[:2], reach, 3 * drift)
        mapped = self._of_closed(self.slots.of(tuple(self.slots)))
        near, extent = self.closed.near(mapped, self.slots.count, extent, known)
        closed = np.union1d(near, self._of_closed(self._present_slots))
        held = {*closed.tolist(), *self._present_slots.tolist()}
        ids = tuple(i for i, slot in self.slots.items() if slot in held)
        belief = self._fused(closed, self.closed.marginal(closed, known), ids)
        centre, is_all = belief.pose[:2].copy(), len(near) == len(mapped)
        return belief, extent._replace(centre=centre, is_all=is_all)

    def join(self) -> None:
        """Place the present submap where the joined map has it."""
        joined = self.closed.join(self.chain.joined)
        where = with_uncertain_start(joined.marginal(NONE), *self.chain.start)
        self.chain.rebase(joined.frames, *where)
        self.closed.forget_frames()

    def close(self) -> None:
        """Close the present submap; the next begins at the robot.

        Raises
        ------
        OSError
            Where it cannot be written; the belief is then as before.
        """
        mean, covariance = self.present.gaussian()
        self.is_overdue = True
        self.closed.append(Submap(self._present_slots, mean, covariance))
        self.is_overdue = False
        self.chain.extend(mean[:3], self.present.pose_covariance)
        self.present.begin()

    def remove(self, ids: list[int]) -> None:
        """Forget mapped landmarks; what several submaps hold goes on to tie them."""
        self.present.remove(ids, self.slots, self.closed.slots)
        for i in ids:
            self.slots.remove(i)

    def merge(self, kept: int, gone: int) -> None:
        """Condition on two mapped landmarks being one, and forget the second."""
        closed = self.closed.with_merged(self.slots[kept], self.slots[gone])
        self.present.merge(kept, gone)
        self.closed = closed
        self.slots.remove(gone)

    @property
    def _present_slots(self) -> Int:
        return self.slots.of(self.present.names)

    def _of_closed(self, slots: Int) -> Int:
        """Return those slots that closed submaps hold."""
        return slots[[slot in self.closed.slots for slot in slots.tolist()]]

    def _fused(self, closed: Int, world: Gaussian, ids: tuple[int, ...]) -> Belief:
        """Join the present submap to closed landmarks; return a part of the result."""
        slots, present = self._present_slots, self.present
        _, in_world, in_local = np.intersect1d(closed, slots, return_indices=True)
        common = (in_world, in_local)
        fused = fuse(world, present.gaussian(), present.frame, common)
        fused = with_uncertain_start(fused, *self.chain.start)
        order = np.concatenate([closed, np.delete(slots, in_local)])
        return part_of(fused, order, self.slots.of(ids), ids)
