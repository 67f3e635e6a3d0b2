"""The submap that the robot is in: an ordinary filter in a frame of its own."""

from collections.abc import Collection, Mapping

import numpy as np
from numpy.typing import NDArray

from ...filters.ekf import FRAMES, EkfSlam
from ...map_management.map_editor import edit_map
from .gaussian import Gaussian
from .landmark_index import LandmarkIndex, link_name

Array = NDArray[np.float64]
Int = NDArray[np.int64]

ORIGIN = (0.0, 0.0, 0.0)


class ActiveSubmap:
    """The present submap, whose landmarks may be removed and merged.

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
        """Begin anew: the robot at the origin of the frame, which is certain."""
        self.filter.reset(ORIGIN, ORIGIN)

    def __len__(self) -> int:
        return len(self.filter._slots)

    def __contains__(self, landmark_id: int) -> bool:
        return landmark_id in self.filter._slots

    @property
    def names(self) -> tuple[int, ...]:
        """Its landmarks and links, in its order."""
        return tuple(self.filter._slots)

    @property
    def pose(self) -> Array:
        """Of the robot, shape (3,); its heading is not wrapped."""
        return self.filter._mean[:3]  # no public way to it costs as little

    @property
    def heading_variance(self) -> float:
        """In the frame of the submap [rad²]."""
        return float(self.filter._covariance[2, 2])

    @property
    def pose_covariance(self) -> Array:
        """Of the additive error, shape (3, 3)."""
        return self.filter._covariance[:3, :3].copy()

    def gaussian(self) -> Gaussian:
        """Return pose, landmarks and links, in the coordinates of the error."""
        mean: Array = self.filter.state_dict()["mean"]
        return Gaussian(mean, self.filter.belief().error_covariance())

    def remove(
        self, ids: Collection[int], slots: LandmarkIndex, tied: Collection[int]
    ) -> None:
        """Marginalise landmarks, but for those that stay as links.

        Parameters
        ----------
        ids : collection of int
            Mapped landmarks, whether it holds them or not.
        slots : LandmarkIndex
            Of these.
        tied : collection of int
            Slots that other submaps hold too.
        """
        here = [i for i in ids if i in self]
        links = {i: link_name(slots[i]) for i in here if slots[i] in tied}
        self._rename(links)
        if alone := [i for i in here if i not in links]:
            edit_map(self.filter).remove(alone)

    def merge(self, kept: int, gone: int) -> None:
        """Condition on two landmarks being one, where it holds both; or rename one."""
        if kept in self and gone in self:
            edit_map(self.filter).merge(kept, gone)
        elif gone in self:
            self._rename({gone: kept})

    def _rename(self, names: Mapping[int, int]) -> None:
        slots = self.filter._slots
        self.filter._slots = {names.get(i, i): slot for i, slot in slots.items()}
