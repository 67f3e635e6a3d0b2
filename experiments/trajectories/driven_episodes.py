"""Drive many worlds side by side, and record them as trajectories."""

from collections.abc import Callable, Sequence

import numpy as np
from gymnasium.utils import seeding

from ...envs.controllers import make_vector_controller
from ...envs.vector import MixedWorlds, WorldBatch
from ...sim_configs import Scenario, drawn_scenario
from .trajectory import Trajectory

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
    scenarios = [
        drawn_scenario(scenario, np.random.default_rng([seed, _SCENARIO_STREAM]))
        for seed in seeds
    ]
    worlds = _worlds(scenario, scenarios)
    worlds.reset([seeding.np_random(seed)[0] for seed in seeds])
    rngs = [np.random.default_rng([seed, _CONTROLLER_STREAM]) for seed in seeds]
    drivers = make_vector_controller(controller, scenarios, rngs)
    record = _Record(worlds, scenario.steps)
    for step in range(scenario.steps):
        actions = drivers.act(worlds.poses, step)
        worlds.step(actions)
        record.take(step, actions)
        if progress is not None:
            progress(len(seeds))
    return [
        record.trajectory(place, scenarios[place], controller, seed)
        for place, seed in enumerate(seeds)
    ]


def _worlds(
    scenario: Scenario, scenarios: Sequence[Scenario]
) -> WorldBatch | MixedWorlds:
    if scenario.randomise is None:
        return WorldBatch(scenario, len(scenarios))
    return MixedWorlds(scenarios)


class _Record:
    """Record B worlds as arrays that are filled step by step."""

    def __init__(self, worlds: WorldBatch | MixedWorlds, steps: int) -> None:
        self._worlds = worlds
        count, rows = worlds.mask.shape
        self._landmarks = worlds.landmarks
        self._start_estimates = worlds.start_estimates
        self._actions = np.empty((count, steps, 2))
        self._odometry = np.empty((count, steps, 2))
        self._collisions = np.empty((count, steps), dtype=np.bool_)
        self._poses = np.empty((count, steps + 1, 3))
        self._measurements = np.empty((count, steps + 1, rows, 2))
        self._mask = np.empty((count, steps + 1, rows), dtype=np.bool_)
        self._landmark_ids = None
        if worlds.landmark_ids is not None:
            self._landmark_ids = np.empty((count, steps + 1, rows), dtype=np.int64)
        self._take_moment(0)

    def take(self, step: int, actions: np.ndarray) -> None:
        """Record an action and the state after it."""
        self._actions[:, step] = actions
        self._odometry[:, step] = self._worlds.odometry
        self._collisions[:, step] = self._worlds.collisions
        self._take_moment(step + 1)

    def _take_moment(self, moment: int) -> None:
        self._poses[:, moment] = self._worlds.poses
        self._measurements[:, moment] = self._worlds.measurements
        self._mask[:, moment] = self._worlds.mask
        ids = self._worlds.landmark_ids
        if self._landmark_ids is not None and ids is not None:
            self._landmark_ids[:, moment] = ids

    def trajectory(
        self, place: int, scenario: Scenario, controller: str, seed: int
    ) -> Trajectory:
        """Return the trajectory of one world."""
        ids = self._landmark_ids
        return Trajectory(
            scenario=scenario,
            controller=controller,
            seed=seed,
            start_estimate=self._start_estimates[place],
            odometry=self._odometry[place],
            poses=self._poses[place],
            landmarks=self._landmarks[place],
            actions=self._actions[place],
            measurements=self._measurements[place],
            mask=self._mask[place],
            collisions=self._collisions[place],
            landmark_ids=None if ids is None else ids[place],
        )
