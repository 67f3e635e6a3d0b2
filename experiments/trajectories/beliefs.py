"""What a filter believes during a drive, as arrays beside the truth.

Known identities give row i of the map to landmark i. Where they are hidden, landmark
management associates and rows follow the order of the filter's map.
"""

from dataclasses import replace
from typing import Any

import numpy as np

from ...arrays import AnyArray
from ...envs.spaces import count_rows
from ...estimator.interface import SlamEstimator, UpdateReport
from ...estimator.map_management.policy import LandmarkPolicy
from ...estimator.registry import find_estimator, read_label
from ...sim_configs import Scenario
from ..logs.events import NO_LANDMARK
from ..runs.filter_settings import FilterSettings, settings_for_scenario
from ..runs.log_replay import replay
from .formats.slamlog_files import to_slamlog
from .trajectory import Trajectory


def with_beliefs(trajectory: Trajectory, estimator: str) -> Trajectory:
    """Return a trajectory with the beliefs of a filter after every scan.

    The filter receives the start estimate, odometry and readings, and the noise of the
    trajectory's own scenario.

    Parameters
    ----------
    trajectory : Trajectory
        With landmarks, measurements and mask.
    estimator : str
        Registered name or "module:Class", with or without options in brackets. Where
        identities are hidden, a map holds at most M landmarks.

    Raises
    ------
    ValueError
        If the filter is unknown, refuses an option or a reading, or believes what is
        not finite.

    Examples
    --------
    >>> from slamgym.experiments.trajectories import drive_episodes
    >>> from slamgym.sim_configs import load_scenario
    >>> (drive,) = drive_episodes(load_scenario("six_landmarks"), "open_loop", [4])
    >>> with_beliefs(drive, "ekf").belief_landmark_covariances.shape
    (30, 6, 2, 2)
    """
    scenario = trajectory.scenario
    slam = belief_settings(scenario, estimator).make(trajectory.start_estimate)
    arrays: dict[str, Any] = _empty_beliefs(len(trajectory.poses), count_rows(scenario))

    def watch(step: int, slam: SlamEstimator, _: UpdateReport | None) -> None:
        _record(arrays, step, slam, by_id=scenario.sensor.identities)

    replay(to_slamlog(trajectory), slam, name=estimator, watch=watch)
    for name, array in arrays.items():
        if not np.isfinite(array).all():
            raise ValueError(
                f"the beliefs of '{estimator}' must be finite, got {name} of seed "
                f"{trajectory.seed} with other numbers"
            )
    return replace(trajectory, **arrays)


def belief_settings(scenario: Scenario, estimator: str) -> FilterSettings:
    """Set up the filter of a data set; its maps are bounded if identities are hidden.

    Raises
    ------
    ValueError
        If the estimator is unknown.
    """
    options: dict[str, Any] = {}
    if not scenario.sensor.identities:
        options["management"] = LandmarkPolicy(capacity=count_rows(scenario))
    find_estimator(read_label(estimator).name)
    return settings_for_scenario(scenario, estimator=estimator, options=options)


def _empty_beliefs(scans: int, rows: int) -> dict[str, AnyArray]:
    return {
        "belief_poses": np.zeros((scans, 3)),
        "belief_pose_covariances": np.zeros((scans, 3, 3)),
        "belief_landmarks": np.zeros((scans, rows, 2)),
        "belief_landmark_covariances": np.zeros((scans, rows, 2, 2)),
        "belief_landmark_ids": np.full((scans, rows), NO_LANDMARK, dtype=np.int64),
    }


def _record(
    arrays: dict[str, AnyArray], step: int, slam: SlamEstimator, *, by_id: bool
) -> None:
    """Write the belief after a step into the arrays."""
    belief, capacity = slam.belief(), arrays["belief_landmark_ids"].shape[1]
    ids = np.array(belief.landmark_ids, dtype=np.int64)
    if len(ids) > capacity:
        raise ValueError(
            f"a map of this data set holds at most {capacity} landmarks, got {len(ids)}"
        )
    rows = ids if by_id else np.arange(len(ids))
    arrays["belief_poses"][step] = belief.pose
    arrays["belief_pose_covariances"][step] = belief.pose_covariance
    arrays["belief_landmarks"][step, rows] = belief.landmarks
    arrays["belief_landmark_covariances"][step, rows] = belief.landmark_covariances
    arrays["belief_landmark_ids"][step, rows] = ids
