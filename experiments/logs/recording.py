"""Drive a robot through a simulated world, and record its readings as a log."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, cast

import gymnasium
import numpy as np

from ...arrays import Array
from ...envs.controllers import Controller
from ...envs.landmark_world import LandmarkWorldEnv, Observation
from ...sim_configs import Scenario, load_scenario
from ...sim_configs.scenario_files import refuse_ranges
from .events import OdometryRow, Scan
from .slamlog import SlamLog, numbers


def record_episode(
    scenario: Scenario | Mapping[str, object] | str | Path,
    controller: Controller,
    seed: int,
    *,
    progress: Callable[[int, int], object] | None = None,
) -> SlamLog:
    """Drive one episode, and record its readings and the truth.

    The controller sees the true pose. Time counts steps: the first scan is at t = 0,
    every odometry row has dt = 1, the noise of one step.

    Parameters
    ----------
    scenario : Scenario, mapping, str or Path
        The world, as in :func:`slamgym.sim_configs.load_scenario`.
    controller : Controller
        Drives the robot, see `envs.controllers`.
    seed : int
        Fixes everything random in the world.
    progress : callable, optional
        Called with (steps done, steps) after every step.

    Returns
    -------
    SlamLog
        The log; it starts at the initial pose of filters. The header holds the noise as
        ``motion_std``, ``measurement_std`` and ``start_sigma``, where
        :func:`~slamgym.experiments.runs.settings_for` finds it. If the scenario hides
        identities, scans have true ids instead of ids.

    Examples
    --------
    >>> from slamgym.envs.controllers import OpenLoop
    >>> from slamgym.sim_configs import action_sequence, load_scenario
    >>> scenario = load_scenario("six_landmarks").with_changes(steps=2)
    >>> driver = OpenLoop(action_sequence(scenario), scenario.robot)
    >>> log = record_episode(scenario, driver, seed=0)
    >>> [type(event).__name__ for event in log.events]
    ['Scan', 'OdometryRow', 'Scan', 'OdometryRow', 'Scan']
    """
    world = load_scenario(scenario)
    refuse_ranges(world)
    env = gymnasium.make(
        "slamgym/LandmarkWorld-v0", scenario=world, disable_env_checker=True
    )
    observation, info = env.reset(seed=seed)
    events: list[OdometryRow | Scan] = [*_scan(0.0, observation, info)]
    poses = [info["pose"]]
    for step in range(world.steps):
        action = controller.act(info["pose"], step)
        observation, _, _, _, info = env.step(action)
        distance, turn = observation["odometry"].tolist()
        t = float(step + 1)
        events.append(OdometryRow(t, distance, turn, dt=1.0))
        events += _scan(t, observation, info)
        poses.append(info["pose"])
        if progress is not None:
            progress(step + 1, world.steps)
    log = _log(world, seed, env, events, np.array(poses))
    env.close()
    return log


def _scan(t: float, observation: Observation, info: dict[str, Any]) -> list[Scan]:
    """Return the scan of one step, if anything was seen."""
    seen = observation["mask"]
    if not seen.any():
        return []
    readings = observation["landmarks"][seen]
    if "landmark_ids" in info:  # the world hides identities
        return [Scan(t, readings, true_ids=info["landmark_ids"][seen])]
    return [Scan(t, readings, np.flatnonzero(seen))]


def _log(
    scenario: Scenario,
    seed: int,
    env: gymnasium.Env[Any, Any],
    events: list[OdometryRow | Scan],
    poses: Array,
) -> SlamLog:
    world = cast(LandmarkWorldEnv, env.unwrapped)
    times = np.arange(len(poses), dtype=np.float64)
    return SlamLog(
        name=scenario.name,
        header=log_header(scenario, seed),
        start=world.start_estimate,
        landmark_ids=np.arange(len(world.landmarks)),
        landmarks=world.landmarks,
        events=tuple(events),
        ground_truth=np.column_stack([times, poses]),
    )


def log_header(scenario: Scenario, seed: int) -> dict[str, str]:
    """Say where a recorded log comes from, and what noise is in it.

    Examples
    --------
    >>> log_header(load_scenario("six_landmarks"), seed=0)["motion_std"]
    '0.25,0.1,0.1'
    """
    sensor, motion = scenario.sensor, scenario.motion
    header = {
        "source": "slamgym, simulated",
        "scenario": scenario.name,
        "seed": str(seed),
        "time": f"steps of {scenario.dt!r} s",
        "motion_std": numbers(*motion.std),
        "measurement_std": numbers(*sensor.std),
        "start_sigma": numbers(*scenario.start.std),
    }
    if sensor.range_std_per_metre:
        header["range_std_per_metre"] = repr(sensor.range_std_per_metre)
    if not sensor.identities:
        header["identities"] = "false"
    header["noise_at_rest"] = str(motion.noise_at_rest).lower()
    return header
