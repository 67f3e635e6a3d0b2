"""Many runs of one scenario as arrays: what a batch of filters is fed."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple, cast

import gymnasium
import numpy as np
from numpy.typing import NDArray

from ..envs.landmark_world import LandmarkWorldEnv
from ..sim_configs import Scenario, action_sequence, load_scenario

Array = NDArray[np.float64]


class SimulatedRuns(NamedTuple):
    """B runs of T = steps + 1 scans, the first before any motion; L landmarks."""

    odometry: Array
    """(d, α) before each scan, shape (B, T, 2) [m, rad]; zeros before the first."""
    measurements: Array
    """Rows (β, r), shape (B, T, L, 2) [rad, m]."""
    visible: NDArray[np.bool_]
    """Which readings there are, shape (B, T, L)."""
    true_poses: Array
    """(x, y, θ), shape (B, T, 3) [m, m, rad]."""
    landmarks: Array
    """True positions, shape (B, L, 2) [m]."""
    initial_poses: Array
    """Poses that filters start from, shape (B, 3)."""

    @property
    def dt(self) -> Array:
        """Duration that the motion noise of each step counts, shape (T,)."""
        durations = np.ones(self.odometry.shape[1])
        durations[0] = 0.0
        return durations


def simulate_runs(
    scenario: Scenario | Mapping[str, object] | str | Path, runs: int, seed: int
) -> SimulatedRuns:
    """Drive the scenario's own controls in ``runs`` worlds, run i seeded seed + i.

    Parameters
    ----------
    scenario : Scenario, mapping, str or Path
        The world, its identities known.
    runs, seed : int
        Number of runs, and the seed of the first; run i depends on seed + i alone.

    Raises
    ------
    ValueError
        Where ``runs`` is below 1 or the scenario hides identities.
    """
    world = load_scenario(scenario)
    if runs < 1:
        raise ValueError(f"runs must be >= 1, got {runs}")
    if not world.sensor.identities:
        raise ValueError(f"scenario '{world.name}' must not hide identities")
    env = gymnasium.make(
        "slamgym/LandmarkWorld-v0", scenario=world, disable_env_checker=True
    ).unwrapped
    actions = action_sequence(world)
    each = [
        _one_run(cast(LandmarkWorldEnv, env), actions, seed + i) for i in range(runs)
    ]
    return SimulatedRuns(*(np.array(column) for column in zip(*each, strict=True)))


def _one_run(env: LandmarkWorldEnv, actions: Array, seed: int) -> tuple[Any, ...]:
    steps = [env.reset(seed=seed)]
    for action in actions:
        observation, _, _, _, info = env.step(action)
        steps.append((observation, info))
    return (
        [observation["odometry"] for observation, _ in steps],
        [observation["landmarks"] for observation, _ in steps],
        [observation["mask"] for observation, _ in steps],
        [info["pose"] for _, info in steps],
        env.landmarks,
        env.start_estimate,
    )
