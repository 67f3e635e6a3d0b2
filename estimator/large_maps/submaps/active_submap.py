"""The submap in use: an ordinary filter in a frame of its own."""

from collections.abc import Collection, Sequence

from ....arrays import Array
from ...filters.ekf import FRAMES, EkfSlam
from .gaussian import Gaussian
from .landmark_index import LandmarkIndex, link_name

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
