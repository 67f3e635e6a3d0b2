"""Shards as data sets of Minari in its Arrow format, for offline learning; exact.

Observations, actions and truncations are those of the environment. The true pose, the
collision, the hidden landmark ids and a filter's beliefs are infos; the collision has
one column because Minari cannot combine infos without columns. The options of each
episode hold the landmarks, the start estimate, and the scenario as TOML. Actions are
float64, wider than the environment's action space, so that they keep every bit.
"""

import json
import tomllib
import warnings
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, cast

import minari
import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from minari.data_collector import EpisodeBuffer

from ...envs.spaces import action_space, observation_space
from ...sim_configs import Scenario
from ...sim_configs.scenario_files import scenario_text
from ..environment_variables import environment
from .trajectory import (
    Trajectory,
    array_of,
    belief_arrays,
    belief_rows,
    scenario_from_text,
)

ENDING = "-v0"
HOLDS_BELIEFS = True
LIBRARIES = ("minari", "pyarrow")

_ROOT = "MINARI_DATASETS_PATH"


def write(trajectories: Sequence[Trajectory], path: Path) -> None:
    """Write a shard; its folder's name is the id of the data set."""
    scenario = trajectories[0].scenario
    with _datasets_in(path.parent), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about optional fields
        minari.create_dataset_from_buffers(
            dataset_id=path.name,
            buffer=[_buffer(each) for each in trajectories],
            env=_spec(scenario),
            action_space=_wide(action_space(scenario)),
            observation_space=_common_space([each.scenario for each in trajectories]),
            algorithm_name=trajectories[0].controller,
            author="slamgym",
            description=f"Drives through the scenario '{scenario.name}'",
            data_format="arrow",
        )


def read(path: Path) -> Iterator[Trajectory]:
    """Yield the trajectories of a shard; see `TrajectoryFormat`."""
    data = minari.MinariDataset(path / "data")
    abouts = data.storage.get_episode_metadata(range(len(data)))
    for episode, about in zip(data.iterate_episodes(), abouts, strict=True):
        yield _trajectory(episode, about)


def _datasets_in(folder: Path) -> AbstractContextManager[None]:
    """Make Minari keep its data sets in a folder during the block."""
    return environment(_ROOT, str(folder.resolve()))  # Minari joins a relative path


def _spec(scenario: Scenario) -> EnvSpec:
    table = json.loads(json.dumps(tomllib.loads(scenario_text(scenario))))
    return EnvSpec(
        "slamgym/LandmarkWorld-v0",
        entry_point="slamgym.envs.landmark_world:LandmarkWorldEnv",
        kwargs={"scenario": table},
    )


def _common_space(scenarios: Sequence[Scenario]) -> spaces.Dict:
    """Return the space whose bounds hold in all scenarios."""
    each = [observation_space(scenario) for scenario in set(scenarios)]

    def box(name: str) -> spaces.Box:
        boxes = [cast(spaces.Box, space[name]) for space in each]
        low = np.min([box.low for box in boxes], axis=0)
        high = np.max([box.high for box in boxes], axis=0)
        return spaces.Box(low, high, dtype=np.float64)

    return spaces.Dict(
        landmarks=box("landmarks"), mask=each[0]["mask"], odometry=box("odometry")
    )


def _wide(box: spaces.Box) -> spaces.Box:
    return spaces.Box(
        box.low.astype(np.float64), box.high.astype(np.float64), dtype=np.float64
    )


def _buffer(trajectory: Trajectory) -> EpisodeBuffer:
    steps = trajectory.steps
    infos: dict[str, Any] = {
        "pose": trajectory.poses,
        "collision": np.append(False, array_of(trajectory, "collisions"))[:, None],
    }
    if trajectory.landmark_ids is not None:
        infos["landmark_ids"] = trajectory.landmark_ids
    infos |= belief_rows(trajectory)
    return EpisodeBuffer(
        seed=trajectory.seed,
        options={
            "controller": trajectory.controller,
            "scenario": scenario_text(trajectory.scenario),
            "start_estimate": trajectory.start_estimate.tolist(),
            "landmarks": array_of(trajectory, "landmarks").tolist(),
        },
        observations={
            "landmarks": array_of(trajectory, "measurements"),
            "mask": array_of(trajectory, "mask"),
            "odometry": np.vstack([np.zeros(2), trajectory.odometry]),
        },
        actions=array_of(trajectory, "actions"),
        rewards=[0.0] * steps,
        terminations=[False] * steps,
        truncations=[False] * (steps - 1) + [True],
        infos=infos,
    )


def _trajectory(episode: Any, about: dict[str, Any]) -> Trajectory:
    options, seen = about["options"], episode.observations
    return Trajectory(
        scenario=scenario_from_text(options["scenario"]),
        controller=options["controller"],
        seed=about["seed"],
        start_estimate=np.array(options["start_estimate"]),
        odometry=seen["odometry"][1:],
        poses=episode.infos["pose"],
        landmarks=np.array(options["landmarks"]),
        actions=episode.actions,
        measurements=seen["landmarks"],
        mask=seen["mask"],
        collisions=episode.infos["collision"][1:, 0],
        landmark_ids=episode.infos.get("landmark_ids"),
        **belief_arrays(episode.infos),
    )
