"""Action and observation spaces of a scenario's world; all bounds are finite."""

import math

import numpy as np
from gymnasium import spaces

from ..sim_configs import Scenario
from ..sim_configs.layouts import possible_positions
from ..sim_configs.scenario_files import widest_scenario
from .sensors.heavy_tails import MANY_STD, largest_noise


def action_space(scenario: Scenario) -> spaces.Box:
    """Return the space of actions (v, ω) within the robot's limits [m/s, rad/s]."""
    limits = np.array(
        [scenario.robot.max_speed, scenario.robot.max_turn_rate], dtype=np.float32
    )
    return spaces.Box(-limits, limits, dtype=np.float32)


def observation_space(scenario: Scenario) -> spaces.Dict:
    """Return the space of readings, mask and odometry; see `LandmarkWorldEnv`.

    Examples
    --------
    >>> from slamgym.sim_configs import load_scenario
    >>> list(observation_space(load_scenario("six_landmarks")))
    ['landmarks', 'mask', 'odometry']
    """
    rows, family = count_rows(scenario), scenario
    scenario = widest_scenario(family)
    highest = np.tile(
        [np.pi, _longest_reading(scenario, _displacement(family))], (rows, 1)
    )
    lowest = np.tile([-np.pi, 0.0], (rows, 1))
    odometry = np.array(_largest_odometry(scenario))
    return spaces.Dict(
        {
            "landmarks": spaces.Box(lowest, highest, dtype=np.float64),
            "mask": spaces.Box(0, 1, (rows,), dtype=np.bool_),
            "odometry": spaces.Box(-odometry, odometry, dtype=np.float64),
        }
    )


def count_rows(scenario: Scenario) -> int:
    """Return the rows of an observation: N, or N + max_clutter without identities."""
    hidden = not scenario.sensor.identities
    return scenario.landmarks.count + hidden * scenario.sensor.max_clutter


def _largest_odometry(scenario: Scenario) -> tuple[float, float]:
    robot, motion, faults = scenario.robot, scenario.motion, scenario.present_faults
    errs = largest_noise(faults.motion_dof) * (motion.noise_in == "odometry")
    gain = max(1.0, 1.0 + faults.odometry_scale)
    return (
        gain * robot.max_speed * scenario.dt + errs * motion.std[0],
        robot.max_turn_rate * scenario.dt
        + abs(faults.odometry_turn)
        + errs * motion.std[2],
    )


def _displacement(family: Scenario) -> float:
    """Bound how much ranges move the start from the widest one, and a landmark [m]."""
    ranges = family.randomise
    if ranges is None:
        return 0.0
    x, y = ranges.start_x or (0.0, 0.0), ranges.start_y or (0.0, 0.0)
    return math.hypot(x[1] - x[0], y[1] - y[0]) + math.sqrt(2) * ranges.landmark_shift


def _longest_reading(scenario: Scenario, displacement: float) -> float:
    sensor = scenario.sensor
    reach = sensor.max_range
    if math.isinf(reach):
        reach = _farthest_landmark(scenario) + displacement
    faults = scenario.present_faults
    largest = largest_noise(faults.sensor_dof)
    noise = largest * (sensor.std[1] + sensor.range_std_per_metre * reach)
    return reach + noise + max(0.0, faults.range_bias)


def _farthest_landmark(scenario: Scenario) -> float:
    """Bound the distance from the robot to any landmark during an episode [m]."""
    start, motion = scenario.start, scenario.motion
    away = possible_positions(scenario.landmarks) - start.pose[:2]
    step = scenario.robot.max_speed * scenario.dt
    if motion.noise_in == "motion":
        largest = largest_noise(scenario.present_faults.motion_dof)
        step += largest * math.hypot(*motion.std[:2])
    drawn = MANY_STD * math.hypot(*start.std[:2])
    return float(np.hypot(*away.T).max()) + drawn + scenario.steps * step
