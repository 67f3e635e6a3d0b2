"""Drive a robot through a simulated world, and record its readings as a log.

`record_episode` records one. `steps_of` splits a log into the steps of a filter: a
motion, then the scan at its end.

Symbols
-------
u = (d, α)   odometry: drive d, then turn α [m, rad]
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, cast

import gymnasium
import numpy as np

from ...arrays import Array, IntArray
from ...envs.controllers import Controller
from ...envs.landmark_world import LandmarkWorldEnv, Observation
from ...estimator.models.motions import find_motion
from ...estimator.models.sensors import find_sensor
from ...sim_configs import Scenario, load_scenario
from ...sim_configs.scenario_files import refuse_ranges
from .slamlog import Event, OdometryRow, PoseRow, Scan, SlamLog, numbers


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
        :func:`~slamgym.experiments.settings_for` finds it. If the scenario hides
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
    simulated = cast(LandmarkWorldEnv, env.unwrapped)
    start, landmarks = simulated.start_estimate, simulated.landmarks
    events: list[Event] = [*_scan(0.0, observation, info), *_fix(0.0, world, info)]
    poses = [info["pose"]]
    for step in range(world.steps):
        observation, _, _, _, info = env.step(controller.act(info["pose"], step))
        distance, turn = observation["odometry"].tolist()
        t = float(step + 1)
        events.append(OdometryRow(t, distance, turn, dt=1.0))
        events += [*_scan(t, observation, info), *_fix(t, world, info)]
        poses.append(info["pose"])
        if progress is not None:
            progress(step + 1, world.steps)
    env.close()
    return log_of_episode(world, seed, start, landmarks, events, np.array(poses))


def _scan(t: float, observation: Observation, info: dict[str, Any]) -> list[Scan]:
    """Return the scan of one step, if anything was seen."""
    seen = observation["mask"]
    if not seen.any():
        return []
    readings = observation["landmarks"][seen]
    if "landmark_ids" in info:  # the world hides identities
        return [Scan(t, readings, true_ids=info["landmark_ids"][seen])]
    return [Scan(t, readings, np.flatnonzero(seen))]


def _fix(t: float, scenario: Scenario, info: dict[str, Any]) -> list[PoseRow]:
    """Return the reading of GPS and compass in one step, if there is one."""
    x, y, heading = np.nan, np.nan, np.nan
    if info.get("gps_mask", False):
        x, y = info["gps"].tolist()
    if info.get("compass_mask", False):
        heading = float(info["compass"])
    if np.isnan([x, y, heading]).all():
        return []
    gps, compass = scenario.gps, scenario.compass
    std = gps.std if gps else np.nan, compass.std if compass else np.nan
    return [PoseRow(t, (x, y, heading), std)]


def log_of_episode(
    scenario: Scenario,
    seed: int,
    start: Array,
    landmarks: Array,
    events: Sequence[Event],
    poses: Array,
) -> SlamLog:
    """Return the log of a simulated episode, whose time counts steps.

    Parameters
    ----------
    scenario : Scenario
        The world.
    seed : int
        Its seed.
    start : ndarray, shape (3,)
        Initial pose of filters [m, m, rad].
    landmarks : ndarray, shape (n, 2)
        True positions [m].
    events : sequence of Event
        Odometry and readings.
    poses : ndarray, shape (steps + 1, 3)
        True poses [m, m, rad].
    """
    times = np.arange(len(poses), dtype=np.float64)
    return SlamLog(
        name=scenario.name,
        header=log_header(scenario, seed),
        motion=scenario.models.get("motion", "turn-last"),
        start=start,
        landmark_ids=np.arange(len(landmarks)),
        landmarks=landmarks,
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
    models = scenario.models
    if "sensor" in models:
        header["sensor"] = models["sensor"]
        header["measurement_columns"] = ",".join(find_sensor(models["sensor"]).columns)
    if "motion" in models:
        header["odometry_columns"] = ",".join(find_motion(models["motion"]).columns)
    return header


class Step(NamedTuple):
    """The motion between two times of a log, and the scan at the second one."""

    #: Time of the end [s, or steps].
    t: float
    #: The motion; empty before the first scan, or between scans at rest.
    motions: tuple[OdometryRow, ...]
    #: The scan at the end.
    scan: Scan | None
    #: The readings of the pose after it.
    fixes: tuple[PoseRow, ...] = ()


class Prediction(NamedTuple):
    """One call of an estimator's ``predict``."""

    #: (d, α) [m, rad].
    odometry: tuple[float, float]
    #: Duration for the motion noise.
    dt: float


def steps_of(log: SlamLog) -> Iterator[Step]:
    """Split a log into steps; step 0 is the start, before any motion.

    Odometry rows that end at the same time, such as a turn and a drive, are one
    motion. A scan belongs to the motion that ends at its time; a scan at another time
    is a step without motion.  So is a reading of the pose.

    Parameters
    ----------
    log : SlamLog
        Any log.

    Yields
    ------
    Step
        At least one.

    Examples
    --------
    >>> rows = (OdometryRow(1.0, 0.0, 0.3, 0.0), OdometryRow(1.0, 2.0, 0.0, 1.0))
    >>> [len(step.motions) for step in steps_of(SlamLog("drive", events=rows))]
    [0, 2]
    """
    step = Step(_start_time(log), (), None)
    is_start = True
    for event in log.events:
        if isinstance(event, OdometryRow):
            if is_start or step.scan or step.fixes or step.t != event.t:
                yield step
                step = Step(event.t, (), None)
            step = step._replace(motions=(*step.motions, event))
            is_start = False
        else:
            is_scan = isinstance(event, Scan)
            if step.t != event.t or (is_scan and (step.scan or step.fixes)):
                yield step
                step, is_start = Step(event.t, (), None), False
            if isinstance(event, Scan):
                step = step._replace(scan=event)
            else:
                step = step._replace(fixes=(*step.fixes, event))
    yield step


def predictions(row: OdometryRow, motion: str) -> tuple[Prediction, ...]:
    """Convert an odometry row to calls of a filter that has the log's drive.

    A midpoint row, an arc driven along the heading θ + α/2, is exactly two moves of a
    unicycle.

    Parameters
    ----------
    row : OdometryRow
        The row.
    motion : str
        Motion model of the log: ``"turn-last"``, ``"midpoint"`` or a drive.

    Examples
    --------
    >>> for u, dt in predictions(OdometryRow(1.0, 2.0, 0.4, 1.0), "midpoint"):
    ...     print(u, dt)
    (0.0, 0.2) 0.0
    (2.0, 0.2) 1.0
    """
    if motion != "midpoint":
        return (Prediction((row.d, row.alpha), row.dt),)
    half = row.alpha / 2
    return Prediction((0.0, half), 0.0), Prediction((row.d, half), row.dt)


def predictions_until(log: SlamLog) -> IntArray:
    """Return how many predictions there are until the end of each step, (K + 1,)."""
    counts = [
        sum(len(predictions(row, log.motion)) for row in step.motions)
        for step in steps_of(log)
    ]
    return np.cumsum(counts, dtype=np.int64)


def _start_time(log: SlamLog) -> float:
    """Return the start time: of the first scan, or before the first motion."""
    if not log.events:
        return 0.0
    first = log.events[0]
    if not isinstance(first, OdometryRow):
        return first.t
    duration = 0.0
    for event in log.events:
        if not isinstance(event, OdometryRow) or event.t != first.t:
            break
        duration += event.dt
    return first.t - duration
