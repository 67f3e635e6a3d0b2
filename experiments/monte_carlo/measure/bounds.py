"""The bound on the errors of any filter in simulated runs, and their actual noise."""

import numpy as np

from ....arrays import Array, BoolArray
from ....envs.robot import wall_distances
from ....evaluation.error_bound import PosteriorBound, posterior_bound
from ....evaluation.noise_findings import noise_sums
from ....sim_configs import Scenario
from ...runs.simulated_runs import SimulatedRuns

_MANY = 6  # deviations that a displacement hardly exceeds


def bound_runs(scenario: Scenario, runs: SimulatedRuns) -> PosteriorBound:
    """Return the bound along each run's true path, with the noise of the world.

    Where the world hides identities, it is that of a filter which knows them. The
    covariances are left out: they take as much memory as the filters.
    """
    identified = runs.identified()
    dt = np.tile(runs.dt, (len(runs.odometry), 1))
    if not scenario.motion.noise_at_rest:
        dt *= runs.odometry.any(axis=2)
    bound = posterior_bound(
        runs.true_poses,
        identified.landmarks_of_rows,
        identified.visible,
        dt,
        motion_std=scenario.motion.std,
        measurement_std=scenario.sensor.std,
        start_std=scenario.start.std,
        range_std_per_metre=scenario.sensor.range_std_per_metre,
    )
    return bound._replace(covariances=())


def noise_of_runs(scenario: Scenario, assumed: Scenario, runs: SimulatedRuns) -> Array:
    """Return sums over the noise of each run, in deviations that `assumed` has.

    Clutter does not count, nor motion at rest where no noise is assumed, nor motion
    that begins near a wall: walls stop the longest displacements.
    """
    identified = runs.identified()
    noisy = ~_near_walls(scenario, runs.true_poses)
    if not assumed.motion.noise_at_rest:
        noisy &= runs.odometry.any(axis=2)
    return noise_sums(
        runs.true_poses,
        identified.landmarks_of_rows,
        runs.odometry,
        identified.measurements,
        identified.visible,
        motion_std=assumed.motion.std,
        measurement_std=assumed.sensor.std,
        range_std_per_metre=assumed.sensor.range_std_per_metre,
        noise_in=assumed.motion.noise_in,
        noisy_steps=noisy,
    )


def _near_walls(scenario: Scenario, poses: Array) -> BoolArray:
    """Return the steps, shape (B, T), that begin where a wall may end them."""
    near = np.zeros(poses.shape[:2], dtype=np.bool_)
    if not scenario.walls:
        return near
    ends = np.array(scenario.walls)
    start, end = ends[:, 0] + 1j * ends[:, 1], ends[:, 2] + 1j * ends[:, 3]
    at = poses[:, :-1, 0] + 1j * poses[:, :-1, 1]
    robot, std = scenario.robot, max(scenario.motion.std[:2])
    reach = robot.radius + robot.max_speed * scenario.dt + _MANY * std
    near[:, 1:] = wall_distances(at, start, end - start).min(axis=-1) < reach
    return near
