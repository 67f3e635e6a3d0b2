"""Worlds of different scenarios with the interface of `WorldBatch`."""

from collections.abc import Sequence

import numpy as np

from ...arrays import Array, IntArray
from ...sim_configs import Scenario
from ..landmark_world import LandmarkWorldEnv, Observation


class MixedWorlds:
    """B single worlds of different scenarios, stepped one after the other.

    All have equally many landmarks. Either all hide identities or none.

    Parameters
    ----------
    scenarios : sequence of Scenario, length B
        The scenario of each world.

    Attributes
    ----------
    measurements, mask, odometry, poses, collisions, landmark_ids : ndarray
        As in `WorldBatch`, new arrays after every step.

    Examples
    --------
    >>> from slamgym.sim_configs import load_scenario
    >>> scenario = load_scenario("six_landmarks")
    >>> other = scenario.with_changes(start={"pose": [1.0, 0.0, 0.0]})
    >>> worlds = MixedWorlds([scenario, other])
    >>> worlds.reset([np.random.default_rng(seed) for seed in (0, 1)])
    >>> worlds.start_estimates[:, 0]
    array([0., 1.])
    """

    def __init__(self, scenarios: Sequence[Scenario]) -> None:
        self._worlds = [LandmarkWorldEnv(scenario) for scenario in scenarios]

    @property
    def landmarks(self) -> Array:
        """True positions, shape (B, N, 2) [m], a copy."""
        return np.array([world.landmarks for world in self._worlds])

    @property
    def start_estimates(self) -> Array:
        """Start poses for filters, shape (B, 3) [m, m, rad], a copy."""
        return np.array([world.start_estimate for world in self._worlds])

    def reset(self, generators: Sequence[np.random.Generator]) -> None:
        """Start an episode in every world; see `WorldBatch.reset`."""
        outputs = []
        for world, generator in zip(self._worlds, generators, strict=True):
            world.np_random = generator
            outputs.append(world.reset())
        self._stack(outputs)

    def step(self, actions: Array) -> None:
        """Drive and turn for one step; see `WorldBatch.step`."""
        outputs = []
        for world, action in zip(self._worlds, actions, strict=True):
            observation, *_, info = world.step(action)
            outputs.append((observation, info))
        self._stack(outputs)

    def _stack(self, outputs: list[tuple[Observation, dict[str, object]]]) -> None:
        """Stack the observations and infos of the worlds."""
        seen, infos = zip(*outputs, strict=True)
        self.measurements = np.array([each["landmarks"] for each in seen])
        self.mask = np.array([each["mask"] for each in seen])
        self.odometry = np.array([each["odometry"] for each in seen])
        self.poses = np.array([each["pose"] for each in infos])
        self.collisions = np.array([each["collision"] for each in infos])
        self.landmark_ids: IntArray | None = None
        if "landmark_ids" in infos[0]:
            self.landmark_ids = np.array([each["landmark_ids"] for each in infos])
