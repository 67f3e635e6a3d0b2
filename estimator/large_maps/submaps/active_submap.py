"""The submap that the robot is in: an ordinary filter in a frame of its own."""

from collections.abc import Collection

import numpy as np
from numpy.typing import NDArray

from ...filters.ekf import FRAMES, EkfSlam
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
        return len(self.filter.map.slots)

    def __contains__(self, landmark_id: int) -> bool:
        return landmark_id in self.filter.map.slots

    @property
    def names(self) -> tuple[int, ...]:
        """Its landmarks and links, in its order."""
        return self.filter.landmark_ids

    @property
    def pose(self) -> Array:
        """Of the robot, shape (3,); its heading is not wrapped."""
        return self.filter.map.mean[:3]

    @property
    def heading_variance(self) -> float:
        """In the frame of the submap [rad²]."""
        return float(self.filter.map.covariance[2, 2])

    @property
    def pose_covariance(self) -> Array:
        """Of the additive error, shape (3, 3)."""
        return self.filter.map.covariance[:3, :3].copy()

    def gaussian(self) -> Gaussian:
        """Return pose, landmarks and links, in the coordinates of the error."""
        gaussian = self.filter.map
        mean = gaussian.mean[: gaussian.size].copy()
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
        self.filter.map.rename(links)
        if alone := [i for i in here if i not in links]:
            self.filter.remove(alone)

    def merge(self, kept: int, gone: int) -> None:
        """Condition on two landmarks being one, where it holds both; or rename one."""
        if kept in self and gone in self:
            self.filter.merge(kept, gone)
        elif gone in self:
            self.filter.map.rename({gone: kept})
