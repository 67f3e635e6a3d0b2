"""Estimate path and landmarks of a drive by a filter, to start an optimiser there."""

from typing import cast

import numpy as np

from ....arrays import Array
from ....estimator.filters.batch import BatchSlam
from ....estimator.filters.ekf import EkfSlam
from ...runs.filter_settings import settings_for_scenario
from ..trajectory import Trajectory, array_of
from .dead_reckoning import dead_reckoning

_ESTIMATOR = "invariant"


def filtered_path(trajectory: Trajectory) -> tuple[Array, dict[int, Array]]:
    """Return the online poses and the final landmarks of an invariant EKF.

    The errors of odometry alone grow without bounds, and an optimiser that starts there
    often ends in another minimum. Every loop that the filter closes bounds them.

    Returns
    -------
    poses : ndarray, shape (T + 1, 3)
        Poses (x, y, θ), given the readings up to each of them [m, m, rad]; odometry
        alone if the filter fails. The first is the start estimate.
    landmarks : dict of int to ndarray, shape (2,)
        Positions of the mapped landmarks [m].
    """
    mask = array_of(trajectory, "mask")
    start = trajectory.start_estimate
    settings = settings_for_scenario(trajectory.scenario, estimator=_ESTIMATOR)
    batch = BatchSlam(
        cast(EkfSlam, settings.make(start)),
        1,
        mask.shape[1],
        initial_poses=start[None],
        initial_pose_std=settings.initial_pose_std,
        threads=1,
    )
    odometry = np.vstack([np.zeros(2), trajectory.odometry])[None]
    durations = np.append(0.0, np.ones(trajectory.steps))
    measurements = array_of(trajectory, "measurements")[None]
    poses = batch.run(odometry, measurements, mask[None], durations).poses[0]
    belief = batch.belief(0)
    if not (np.isfinite(poses).all() and np.isfinite(belief.mean).all()):
        return dead_reckoning(start, trajectory.odometry), {}
    poses[0] = start
    pairs = zip(belief.landmark_ids, belief.landmarks, strict=True)
    return poses, dict(pairs)
