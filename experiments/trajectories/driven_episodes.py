"""Drive many worlds side by side, and record them as trajectories."""

from collections.abc import Callable, Sequence

import numpy as np
from gymnasium.utils import seeding

from ...envs.controllers import make_vector_controller
from ...envs.vector import MixedWorlds, WorldBatch
from ...sim_configs import Scenario, drawn_scenario
from ..runs.simulated_runs import empty_record, take
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
    drawn from them first, and worlds are stepped one by one, about six times slower.

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
    worlds = _worlds(scenario, scenarios)
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


def _worlds(
    scenario: Scenario, scenarios: Sequence[Scenario]
) -> WorldBatch | MixedWorlds:
    if scenario.randomise is None:
        return WorldBatch(scenario, len(scenarios))
    return MixedWorlds(scenarios)
