"""Shards as two Parquet tables, for pandas, polars and DuckDB; every number exact.

``steps.parquet`` has one row per step and one for the start, T + 1 per episode: seed,
step, the action, the odometry and the collision before it (null at step 0), the true
pose, the readings as lists of M, and a filter's beliefs as lists in the order of the
arrays of `Trajectory`. ``episodes.parquet`` has one row per episode:
seed, controller, scenario (as TOML), start_estimate, and the landmarks as (x, y, x, …).
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from ...arrays import AnyArray, Array
from ...estimator.models.motions import find_motion
from ...estimator.models.sensors import find_sensor
from ...sim_configs import Scenario
from ...sim_configs.scenario_files import scenario_text
from .trajectory import (
    BELIEFS,
    Trajectory,
    array_of,
    belief_arrays,
    belief_rows,
    scenario_from_text,
)

LIBRARIES = ("pyarrow",)
HOLDS_BELIEFS = True

_STEPS, _EPISODES = "steps.parquet", "episodes.parquet"


def write(trajectories: Sequence[Trajectory], path: Path) -> None:
    """Write a shard; see `TrajectoryFormat`."""
    path.mkdir()
    _write_table(_episode_table(trajectories), path / _EPISODES, len(trajectories))
    steps = pa.concat_tables([_step_table(each) for each in trajectories])
    _write_table(steps, path / _STEPS, len(trajectories[0].poses))


def read(path: Path) -> Iterator[Trajectory]:
    """Yield the trajectories of a shard; see `TrajectoryFormat`."""
    steps = pq.ParquetFile(path / _STEPS)
    for group, episode in enumerate(pq.read_table(path / _EPISODES).to_pylist()):
        yield _trajectory(episode, steps.read_row_group(group))


def _write_table(table: Any, path: Path, rows_per_group: int) -> None:
    coding = {"compression": "zstd", "use_dictionary": False}
    pq.write_table(table, path, row_group_size=rows_per_group, **coding)


def _episode_table(trajectories: Sequence[Trajectory]) -> Any:
    return pa.table(
        {
            "seed": pa.array([each.seed for each in trajectories], pa.int64()),
            "controller": [each.controller for each in trajectories],
            "scenario": [scenario_text(each.scenario) for each in trajectories],
            "start_estimate": [each.start_estimate for each in trajectories],
            "landmarks": [array_of(each, "landmarks").ravel() for each in trajectories],
        }
    )


def _step_table(trajectory: Trajectory) -> Any:
    actions, odometry = array_of(trajectory, "actions"), trajectory.odometry
    measurements = array_of(trajectory, "measurements")
    moves, numbers = _model_columns(trajectory.scenario)
    x, y, heading = trajectory.poses.T
    count = len(trajectory.poses)
    columns = {
        "seed": np.full(count, trajectory.seed, dtype=np.int64),
        "step": np.arange(count, dtype=np.int32),
        "speed": _later(actions[:, 0]),
        "turn_rate": _later(actions[:, 1]),
        **{
            name: _later(column) for name, column in zip(moves, odometry.T, strict=True)
        },
        "collision": _later(array_of(trajectory, "collisions")),
        "x": x,
        "y": y,
        "heading": heading,
        "seen": _lists(array_of(trajectory, "mask")),
        **{name: _lists(measurements[..., k]) for k, name in enumerate(numbers)},
    }
    if trajectory.landmark_ids is not None:
        columns["landmark_ids"] = _lists(trajectory.landmark_ids)
    for name, rows in belief_rows(trajectory).items():
        columns[name] = _lists(rows)
    return pa.table(columns)


def _model_columns(scenario: Scenario) -> tuple[list[str], list[str]]:
    """Return the columns of odometry and of readings, by drive and sensor."""
    models = scenario.models
    moves, numbers = ["odometry_distance", "odometry_turn"], ["bearings", "ranges"]
    if "motion" in models:
        moves = [f"odometry_{name}" for name in find_motion(models["motion"]).columns]
    if "sensor" in models:
        numbers = [f"reading_{name}" for name in find_sensor(models["sensor"]).columns]
    return moves, numbers


def _later(values: AnyArray) -> Any:
    """Prepend null, for the start, to a column."""
    return pa.array([None, *values.tolist()], type=pa.from_numpy_dtype(values.dtype))


def _lists(rows: AnyArray) -> Any:
    """Return one list of fixed length per row."""
    flat = pa.array(np.ascontiguousarray(rows).ravel())
    return pa.FixedSizeListArray.from_arrays(flat, rows.shape[1])


def _trajectory(episode: dict[str, Any], steps: Any) -> Trajectory:
    def column(name: str) -> AnyArray:
        values: AnyArray = steps[name].combine_chunks().to_numpy(False)
        return values

    def rows(name: str) -> AnyArray:
        flat = steps[name].combine_chunks().flatten().to_numpy(zero_copy_only=False)
        table: AnyArray = flat.reshape(steps.num_rows, -1)
        return table

    def pairs(*names: str) -> Array:
        return np.column_stack([column(name)[1:] for name in names])

    hidden = "landmark_ids" in steps.column_names
    scenario = scenario_from_text(episode["scenario"])
    moves, numbers = _model_columns(scenario)
    measurements = np.zeros((*rows("seen").shape, 2))
    for k, name in enumerate(numbers):
        measurements[..., k] = rows(name)
    beliefs = {name: rows(name) for name in BELIEFS if name in steps.column_names}
    return Trajectory(
        scenario=scenario,
        controller=episode["controller"],
        seed=episode["seed"],
        start_estimate=np.array(episode["start_estimate"]),
        odometry=pairs(*moves),
        poses=np.column_stack([column(name) for name in ("x", "y", "heading")]),
        landmarks=np.array(episode["landmarks"]).reshape(-1, 2),
        actions=pairs("speed", "turn_rate"),
        measurements=measurements,
        mask=rows("seen"),
        collisions=column("collision")[1:].astype(np.bool_),
        landmark_ids=rows("landmark_ids") if hidden else None,
        **belief_arrays(beliefs),
    )
