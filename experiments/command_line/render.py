"""``slamgym render``: an episode as a moving picture."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import gymnasium
import numpy as np
from numpy.typing import NDArray

from ...envs.controllers import Controller
from ...envs.landmark_world import LandmarkWorldEnv, Observation
from ...envs.rendering.renderer import write_video
from ...estimator.interface import SlamEstimator
from ...sim_configs import Scenario
from ..runs.filter_settings import FilterSettings
from .reporter import Reporter, Tick
from .scenario_options import driver
from .warm_up import warm_up

_DURATION = 12.0  # [s] of a film whose speed is not asked for
_SLOWEST, _FASTEST = 4.0, 30.0  # [frames/s]


def film_episode(
    scenario: Scenario,
    settings: FilterSettings | None,
    *,
    controller: str,
    seed: int,
    fps: float | None,
    out: Path,
    as_json: bool,
) -> None:
    """Drive an episode, and write one frame per step.

    Parameters
    ----------
    scenario : Scenario
        The world.
    settings : FilterSettings or None
        Of the estimator whose belief is drawn too; None draws the world alone.
    controller : str
        What drives.
    seed : int
        Fixes everything random.
    fps : float or None
        Frames per second; None: so many that the film lasts about 12 s.
    out : Path
        The .gif or .mp4 file.
    as_json : bool
        Whether to print what was done for programs.
    """
    reporter = Reporter(as_json=as_json)
    driving = driver(controller, scenario, seed)
    speed = fps or min(max(scenario.steps / _DURATION, _SLOWEST), _FASTEST)
    if settings is not None:
        warm_up(settings, reporter)
    with reporter.progress("filming") as tick:
        frames = _frames(scenario, settings, driving, seed, tick)
        write_video(frames, out, fps=speed)
    frames_written = scenario.steps + 1
    reporter.show(f"Wrote {out}: {frames_written} frames, {speed:.3g} per second")
    reporter.finish({"out": str(out), "frames": frames_written, "fps": speed})


def _frames(
    scenario: Scenario,
    settings: FilterSettings | None,
    driving: Controller,
    seed: int,
    tick: Tick,
) -> Iterator[NDArray[np.uint8]]:
    env = gymnasium.make(
        "slamgym/LandmarkWorld-v0",
        scenario=scenario,
        render_mode="rgb_array",
        disable_env_checker=True,
    )
    world = cast(LandmarkWorldEnv, env.unwrapped)
    observation, info = env.reset(seed=seed)
    estimator = None if settings is None else settings.make(world.start_estimate)
    yield _frame(world, observation, estimator)
    for step in range(scenario.steps):
        action = driving.act(info["pose"], step)
        observation, _, _, _, info = env.step(action)
        if estimator is not None:
            estimator.predict(observation["odometry"])
        yield _frame(world, observation, estimator)
        tick(step + 1, scenario.steps)
    env.close()


def _frame(
    world: LandmarkWorldEnv, observation: Observation, estimator: SlamEstimator | None
) -> NDArray[np.uint8]:
    """Let the estimator take in the scan, and draw world and belief."""
    if estimator is not None:
        seen = observation["mask"]
        tells_ids = world.scenario.sensor.identities
        ids: list[int] | None = np.flatnonzero(seen).tolist() if tells_ids else None
        estimator.update(observation["landmarks"][seen], ids)
        world.show_belief(estimator.belief())
    frame: Any = world.render()
    return cast("NDArray[np.uint8]", frame)
