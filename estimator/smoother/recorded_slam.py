"""A filter that records its drive, with the associations that it decided on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ...arrays import Array
from ..interface import Belief, MapView, SlamEstimator, UpdateReport, optional_members
from ..map_management.map_view import (
    mapped_ids,
    marginal,
    marginal_without_joining,
    view_map,
)
from .drive import Drive


class RecordedSlam:
    """A filter, and beside it the drive that it followed.

    The drive gets the readings that the filter used, of the landmarks that it decided
    on: with landmark management, those are its associations.  Landmarks that it merged
    are one in the drive, and those that it removed are not in it.

    Parameters
    ----------
    slam : SlamEstimator
        The filter, at its start.
    drive : Drive
        Without motions and scans; it has the noise to smooth with.

    Examples
    --------
    >>> from slamgym.estimator import make_estimator
    >>> from slamgym.estimator.smoother import smooth
    >>> noise = {"motion_std": (0.1, 0.1, 0.05), "measurement_std": (0.02, 0.1)}
    >>> slam = RecordedSlam(make_estimator("invariant", **noise), Drive(**noise))
    >>> _ = slam.update([(0.0, 5.0)], [7])
    >>> slam.predict((2.0, 0.0))
    >>> _ = slam.update([(0.0, 3.2)], [7])
    >>> smooth(slam.drive, start=slam.poses).landmarks.round(3)
    array([[5.067, 0.   ]])
    """

    def __init__(self, slam: SlamEstimator, drive: Drive) -> None:
        self._slam, self.drive = slam, drive
        self._poses = {0: drive.initial_pose}
        for name, member in optional_members(slam).items():
            setattr(self, name, member)

    @property
    def poses(self) -> Array:
        """The filter's estimate of each pose of the drive, shape (N, 3)."""
        return np.array([self._poses[pose] for pose in range(self.drive.poses)])

    def reset(self, pose: ArrayLike, pose_std: ArrayLike) -> None:
        """Refuse: a drive has one start."""
        raise ValueError("a recorded drive cannot be reset: record another one")

    def predict(self, odometry: ArrayLike, dt: float = 1.0) -> None:
        """Move by odometry (d, α) [m, rad], its motion noise counted √dt times."""
        self._slam.predict(odometry, dt)
        self.drive.predict(odometry, dt)

    def update(
        self, measurements: ArrayLike, landmark_ids: Sequence[int] | None = None
    ) -> UpdateReport:
        """Update the filter with one scan, and record the readings that it used."""
        report = self._slam.update(measurements, landmark_ids)
        decided = report.row_ids or (() if landmark_ids is None else landmark_ids)
        unused = {*report.rejected_ids, *report.skipped_ids}
        used = {
            row: i for row, i in enumerate(decided) if i is not None and i not in unused
        }
        readings = np.asarray(measurements, dtype=np.float64).reshape(-1, 2)
        self.drive.update(readings[list(used)], list(used.values()))
        for kept, gone in report.merged_ids:
            self.drive.merge(kept, gone)
        if report.removed_ids:
            self.drive.forget(report.removed_ids)
        belief = marginal_without_joining(self._slam, ())
        self._poses[self.drive.poses - 1] = belief.pose
        return report

    def end(self) -> None:
        """Make the place where the drive ended its last pose."""
        self.drive.end_motion()
        belief = marginal_without_joining(self._slam, ())
        self._poses[self.drive.poses - 1] = belief.pose

    def belief(self, landmark_ids: Sequence[int] | None = None) -> Belief:
        """Return the filter's belief."""
        if landmark_ids is None:
            return self._slam.belief()
        return marginal(self._slam, landmark_ids)

    def map_view(self) -> MapView:
        """Return pose and map of the filter, until the next step."""
        return view_map(self._slam)

    @property
    def landmark_ids(self) -> tuple[int, ...]:
        """The filter's landmarks, in the order of its belief."""
        return mapped_ids(self._slam)

    def state_dict(self) -> dict[str, Any]:
        """Return the filter's state; the drive is not part of it."""
        return self._slam.state_dict()

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Refuse: a drive cannot go back."""
        raise ValueError("a recorded drive cannot go back to an earlier state")

    def __repr__(self) -> str:
        return f"Recorded {self._slam!r}"
