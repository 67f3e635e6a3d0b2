"""``slamgym render``: film an episode."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...sim_configs import Scenario
from ..progress_bar import Tick
from .commands import command
from .options import REQUIRED, Options, ScenarioName, declared, refuse_broken, takes

if TYPE_CHECKING:
    from ...envs.controllers import Controller
    from ...envs.landmark_world import LandmarkWorldEnv, Observation
    from ...estimator.interface import SlamEstimator
    from ..run_and_replay.filter_settings import FilterSettings

_DURATION = 12.0  # [s] of a film by default
_SLOWEST, _FASTEST = 4.0, 30.0  # [frames/s]


@dataclass(frozen=True, kw_only=True)
class RenderOptions(Options):
    """The options of ``slamgym render``.

    Attributes
    ----------
    out
        The .gif or .mp4 file to write.
    estimator
        The filter whose belief is drawn, or "none".
    fps
        Frames (steps) per second.
    """

    out: Path = declared(REQUIRED, "FILE")
    estimator: str = declared("invariant", "--estimator -e NAME", "invariant")
    fps: float | None = declared(None, "N", "so that it lasts 12 s")


@command
@takes("out estimator option_texts seed steps controller set_ fps as_json")
def render(scenario: ScenarioName, *, given: RenderOptions) -> None:
    """Film an episode as .gif or .mp4.

    Film a drive through a scenario: the robot, its readings, the walls, and the
    belief of a filter with its 3σ ellipses.

    Examples
    --------
    slamgym render loop --out loop.gif
    slamgym render corridor --out corridor.mp4 --fps 20 --controller waypoints
    """
    from ...envs.rendering import check_video, write_video
    from ..run_and_replay.filter_settings import settings_for_scenario
    from .run_files import warm_up

    world = given.scenario(scenario)
    chosen, settings = given.filter_options(), None
    if given.estimator != "none":
        refuse_broken(given.estimator, chosen)
        settings = settings_for_scenario(
            world, estimator=given.estimator, options=chosen
        )
    reporter = given.reporter()
    driver = given.driver(world)
    speed = given.fps or min(max(world.steps / _DURATION, _SLOWEST), _FASTEST)
    check_video(given.out, speed)
    if settings is not None:
        warm_up(settings, reporter)
    with reporter.progress("filming") as tick:
        frames = _frames(world, settings, driver, given.seed, tick)
        write_video(frames, given.out, fps=speed)
    count = world.steps + 1
    reporter.show(f"Wrote {given.out}: {count} frames, {speed:.3g} per second")
    reporter.finish({"out": str(given.out), "frames": count, "fps": speed})


def _frames(
    scenario: Scenario,
    settings: "FilterSettings | None",
    driver: "Controller",
    seed: int,
    tick: Tick,
) -> Iterator[Any]:
    """Yield the frames of an episode, arrays (height, width, 3) of uint8."""
    import gymnasium

    env: Any = gymnasium.make(
        "slamgym/LandmarkWorld-v0",
        scenario=scenario,
        render_mode="rgb_array",
        disable_env_checker=True,
    )
    world: LandmarkWorldEnv = env.unwrapped
    observation, info = env.reset(seed=seed)
    estimator = None if settings is None else settings.make(world.start_estimate)
    yield _frame(world, observation, estimator)
    for step in range(scenario.steps):
        observation, _, _, _, info = env.step(driver.act(info["pose"], step))
        if estimator is not None:
            estimator.predict(observation["odometry"])
        yield _frame(world, observation, estimator)
        tick(step + 1, scenario.steps)
    env.close()


def _frame(
    world: "LandmarkWorldEnv",
    observation: "Observation",
    estimator: "SlamEstimator | None",
) -> Any:
    """Update the estimator with the scan, and draw world and belief."""
    if estimator is not None:
        seen = observation["mask"]
        ids = seen.nonzero()[0].tolist() if world.scenario.sensor.identities else None
        estimator.update(observation["landmarks"][seen], ids)
        world.show_belief(estimator.belief())
    return world.render()
