"""Action and observation spaces of a scenario's world; all bounds are finite."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike

from ..arrays import AnyArray, Array, BoolArray, IntArray
from ..jit import jit_in_place
from ..sim_configs import Scenario
from ..sim_configs.landmarks_and_controls import possible_positions
from ..sim_configs.scenario_files import widest_scenario
from .noise_streams import MANY_STD, largest_noise


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
    longest = _longest_reading(scenario, _displacement(family))
    lowest, highest = (np.tile(ends, (rows, 1)) for ends in _ends(scenario, longest))
    odometry = np.array(_largest_odometry(scenario))
    return spaces.Dict(
        landmarks=spaces.Box(lowest, highest, dtype=np.float64),
        mask=spaces.Box(0, 1, (rows,), dtype=np.bool_),
        odometry=spaces.Box(-odometry, odometry, dtype=np.float64),
    )


def _ends(scenario: Scenario, longest: float) -> tuple[Array, Array]:
    """Return the least and the largest reading; a void second number is 0 of [0, 1]."""
    match scenario.sensor.kind:
        case "position":
            return np.array([-longest, -longest]), np.array([longest, longest])
        case "bearing":
            return np.array([-np.pi, 0.0]), np.array([np.pi, 1.0])
        case "range":
            return np.zeros(2), np.array([longest, 1.0])
        case kind if ":" in kind:  # a sensor of the user's own
            return np.full(2, -np.inf), np.full(2, np.inf)
    return np.array([-np.pi, 0.0]), np.array([np.pi, longest])


def count_rows(scenario: Scenario) -> int:
    """Return the rows of an observation: N, or N + max_clutter without identities."""
    hidden = not scenario.sensor.identities
    return scenario.landmarks.count + hidden * scenario.sensor.max_clutter


def _largest_odometry(scenario: Scenario) -> tuple[float, float]:
    robot, motion, faults = scenario.robot, scenario.motion, scenario.present_faults
    errs = largest_noise(faults.motion_dof) * (motion.noise_in == "odometry")
    gain = max(1.0, 1.0 + faults.odometry_scale)
    distance = gain * robot.max_speed * scenario.dt + errs * motion.std[0]
    turn = robot.max_turn_rate * scenario.dt + abs(faults.odometry_turn)
    turn += errs * motion.std[2]
    match robot.drive:
        case "differential":
            assert robot.track_width is not None
            return (distance + turn * robot.track_width / 2,) * 2
        case "bicycle":
            return distance, math.pi / 2
    return distance, turn


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
    std = sensor.std[1] if sensor.kind == "bearing_range" else max(sensor.std)
    noise = largest * (std + sensor.range_std_per_metre * reach)
    return reach + noise + max(0.0, faults.range_bias)


def _farthest_landmark(scenario: Scenario) -> float:
    """Bound the distance from the robot to any landmark during an episode [m]."""
    start, motion = scenario.start, scenario.motion
    away = possible_positions(scenario.landmarks) - start.pose[:2]
    robot = scenario.robot
    lever = math.hypot(*(robot.reference or (0.0, 0.0)))
    step = (robot.max_speed + robot.max_turn_rate * lever) * scenario.dt
    if motion.noise_in == "motion":
        largest = largest_noise(scenario.present_faults.motion_dof)
        step += largest * math.hypot(*motion.std[:2])
    drawn = MANY_STD * math.hypot(*start.std[:2])
    return float(np.hypot(*away.T).max()) + drawn + scenario.steps * step


_REAL_NUMBERS = "efd" + np.typecodes["AllInteger"]


def clipped_action(action: ArrayLike, limits: Sequence[float]) -> tuple[float, float]:
    """Clip one action (v, ω) to ± limits [m/s, rad/s].

    Raises
    ------
    ValueError
        If the action is not two finite numbers.

    Examples
    --------
    >>> clipped_action([3, -0.5], limits=(1.0, 1.0))
    (1.0, -0.5)
    """
    speed, turn_rate = _real_numbers(action, (2,), _refusal).tolist()
    fastest, quickest = limits
    if not (-fastest <= speed <= fastest and -quickest <= turn_rate <= quickest):
        if not (math.isfinite(speed) and math.isfinite(turn_rate)):
            raise _refusal(action)
        speed = min(max(speed, -fastest), fastest)
        turn_rate = min(max(turn_rate, -quickest), quickest)
    return speed, turn_rate


def commands_of(
    actions: ArrayLike, limits: Array, dt: float, moving: BoolArray, steps: IntArray
) -> Array:
    """Return the commands (d, α) of B actions (v, ω), clipped to ± limits, in dt.

    Parameters
    ----------
    actions : array_like, shape (B, 2)
        Rows (v, ω) [m/s, rad/s].
    limits : ndarray, shape (2,)
        Largest |v| and |ω|.
    dt : float
        Duration of a step [s].
    moving : bool ndarray, shape (B,)
        Worlds whose actions count; the commands of the others are zeros.
    steps : int64 ndarray, shape (B,)
        Steps of the worlds so far; those that move receive one more.

    Raises
    ------
    ValueError
        If `actions` is not B rows of two real numbers. If a number is not finite, the
        message names the first such world. No step is counted.

    Examples
    --------
    >>> both = np.ones(2, dtype=bool), np.zeros(2, dtype=np.int64)
    >>> commands_of([[1, 0], [2, float("nan")]], np.ones(2), 0.1, *both)
    Traceback (most recent call last):
        ...
    ValueError: every action must be 2 finite numbers (v [m/s], ω [rad/s]), got [2.0, nan] for world 1
    """  # noqa: E501 (an error of one line)
    refusal = partial(_refusal_of_many, len(moving))
    given = _real_numbers(actions, (len(moving), 2), refusal)
    array = given.astype(np.float64, order="C")  # another order would compile anew
    world = _begin_step(array, limits, dt, moving, steps)
    if world >= 0:
        raise ValueError(
            "every action must be 2 finite numbers (v [m/s], ω [rad/s]), "
            f"got {array[world].tolist()} for world {world}"
        )
    return array


@jit_in_place
def _begin_step(
    actions: Array, limits: Array, dt: float, moving: BoolArray, steps: IntArray
) -> int:
    """Turn actions into commands, and count steps; see `commands_of`.

    Returns -1, or the first world whose action is not finite; nothing has changed then.
    """
    for b in range(len(actions)):
        v, w = actions[b]
        if moving[b] and not (math.isfinite(v) and math.isfinite(w)):
            return b
    for b in range(len(actions)):
        for i in range(2):
            value = actions[b, i]
            if abs(value) > limits[i]:
                value = math.copysign(limits[i], value)
            actions[b, i] = value * dt if moving[b] else 0.0
        steps[b] += moving[b]
    return -1


def _real_numbers(
    value: ArrayLike, shape: tuple[int, ...], refusal: Callable[..., ValueError]
) -> AnyArray:
    try:
        array = np.asarray(value)
    except ValueError:  # ragged
        raise refusal(value, repr(value)) from None
    if array.shape != shape:
        raise refusal(value, f"shape {array.shape}")
    if isinstance(value, np.ma.MaskedArray):  # what lies under a mask means nothing
        raise refusal(value, "a masked array")
    if array.dtype.char not in _REAL_NUMBERS:
        raise refusal(value, f"{array.dtype}")
    return array


def _refusal(action: ArrayLike, _got: str = "") -> ValueError:
    return ValueError(
        f"action must be 2 finite numbers (v [m/s], ω [rad/s]), got {action!r}"
    )


def _refusal_of_many(count: int, _actions: ArrayLike, got: str) -> ValueError:
    return ValueError(
        f"actions must be real numbers of shape ({count}, 2), one row "
        f"(v [m/s], ω [rad/s]) per world, got {got}"
    )
