"""Drive many worlds side by side, and record them as trajectories: `drive_episodes`.

`with_beliefs` adds what a filter believes during a drive. Known identities give row i
of the map to landmark i. Where they are hidden, landmark management associates and rows
follow the order of the filter's map.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from gymnasium.utils import seeding

from ...arrays import AnyArray
from ...envs.controllers import make_vector_controller
from ...envs.spaces import count_rows
from ...envs.vector import WorldBatch
from ...estimator.interface import SlamEstimator, UpdateReport
from ...estimator.map_management.policy import LandmarkPolicy
from ...estimator.registry import find_estimator, read_label
from ...sim_configs import Scenario, drawn_scenario
from ..logs.slamlog import NO_LANDMARK
from ..run_and_replay.filter_settings import FilterSettings, settings_for_scenario
from ..run_and_replay.log_replay import replay
from ..run_and_replay.simulated_runs import empty_record, take
from ..run_and_replay.trace import is_finite
from .formats import to_slamlog
from .trajectory import Trajectory

_EACH_STEP = ("odometry", "collisions")
_EACH_SCAN = ("poses", "measurements", "mask", "landmark_ids")
_CONTROLLER_STREAM, _SCENARIO_STREAM = 1, 2  # beside the seed, so that all differ


def drive_episodes(
    scenario: Scenario,
    controller: str,
    seeds: Sequence[int],
    *,
    progress: Callable[[int], object] | None = None,
) -> list[Trajectory]:
    """Drive one episode per seed; the controller sees the true poses.

    Every episode depends on its own seed alone: world and controller are, bit for bit,
    those of ``slamgym run`` with this seed. If the scenario has ranges, the world is
    drawn from them first.

    Parameters
    ----------
    scenario : Scenario
        The world, with or without ranges.
    controller : str
        Name of the controller, see `make_controller`.
    seeds : sequence of int
        One per episode, at least one.
    progress : callable, optional
        Called with the number of steps just done, in all episodes together.

    Returns
    -------
    list of Trajectory
        One per seed.

    Raises
    ------
    ValueError
        If there are no seeds.

    Examples
    --------
    >>> from slamgym.sim_configs import load_scenario
    >>> drives = drive_episodes(load_scenario("six_landmarks"), "open_loop", [4, 5])
    >>> drives[1].measurements.shape
    (30, 6, 2)
    """
    if not len(seeds):
        raise ValueError(f"seeds must be one or more integers >= 0, got {seeds!r}")
    rngs = _random_generators(seeds, _SCENARIO_STREAM)
    scenarios = [drawn_scenario(scenario, rng) for rng in rngs]
    worlds = WorldBatch(scenario, len(scenarios), scenarios)
    worlds.reset([seeding.np_random(seed)[0] for seed in seeds])
    rngs = _random_generators(seeds, _CONTROLLER_STREAM)
    drivers = make_vector_controller(controller, scenarios, rngs)
    actions = np.empty((len(seeds), scenario.steps, 2))
    each_step = empty_record(worlds, _EACH_STEP, scenario.steps)
    each_scan = empty_record(worlds, _EACH_SCAN, scenario.steps + 1)
    take(each_scan, 0, worlds)
    for step in range(scenario.steps):
        actions[:, step] = drivers.act(worlds.poses, step)
        worlds.step(actions[:, step])
        take(each_step, step, worlds)
        take(each_scan, step + 1, worlds)
        if progress is not None:
            progress(len(seeds))
    record = {
        "landmarks": worlds.landmarks,
        "start_estimate": worlds.start_estimates,
        "actions": actions,
        **each_step,
        **each_scan,
    }
    return [
        Trajectory(
            scenario=scenarios[place],
            controller=controller,
            seed=seed,
            **{name: array[place] for name, array in record.items()},
        )
        for place, seed in enumerate(seeds)
    ]


def _random_generators(seeds: Sequence[int], stream: int) -> list[np.random.Generator]:
    return [np.random.default_rng([seed, stream]) for seed in seeds]


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

    try:
        replay(to_slamlog(trajectory), slam, name=estimator, watch=watch)
    except ValueError as error:
        raise type(error)(f"'{estimator}', seed {trajectory.seed}: {error}") from error
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
    if not is_finite(belief):
        raise np.linalg.LinAlgError(f"the belief is not finite after step {step}")
    rows = ids if by_id else np.arange(len(ids))
    arrays["belief_poses"][step] = belief.pose
    arrays["belief_pose_covariances"][step] = belief.pose_covariance
    arrays["belief_landmarks"][step, rows] = belief.landmarks
    arrays["belief_landmark_covariances"][step, rows] = belief.landmark_covariances
    arrays["belief_landmark_ids"][step, rows] = ids
