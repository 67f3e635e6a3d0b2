"""Shards as npz files of numpy: every array of E episodes stacked, exact.

The arrays are those of `Trajectory` with an additional first axis E: ``start_estimate``
has the shape (E, 3). ``seed``, ``controller`` and ``scenario`` (as TOML) are (E,).
"""

import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from ....sim_configs.scenario_files import scenario_text
from ..trajectory import (
    ARRAYS,
    BELIEFS,
    Trajectory,
    array_of,
    arrays_to_write,
    scenario_from_text,
)

ENDING = ".npz"
HOLDS_BELIEFS = True

_NO_DATE = (1980, 1, 1, 0, 0, 0)  # a constant: equal arrays give equal bytes


def write(trajectories: Sequence[Trajectory], path: Path) -> None:
    """Write a shard, uncompressed; see `TrajectoryFormat`."""
    columns = {
        "scenario": np.array([scenario_text(each.scenario) for each in trajectories]),
        "controller": np.array([each.controller for each in trajectories]),
        "seed": np.array([each.seed for each in trajectories]),
    }
    with zipfile.ZipFile(path, "w") as archive:
        for name, column in columns.items():
            _add(archive, name, column)
        for name in arrays_to_write(trajectories):
            stacked = np.stack([array_of(each, name) for each in trajectories])
            _add(archive, name, stacked)


def read(path: Path) -> Iterator[Trajectory]:
    """Yield the trajectories of a shard; see `TrajectoryFormat`."""
    with np.load(path, allow_pickle=False) as archive:
        columns = {name: archive[name] for name in archive.files}
    arrays = [name for name in (*ARRAYS, *BELIEFS) if name in columns]
    for k in range(len(columns["seed"])):
        yield Trajectory(
            scenario=scenario_from_text(str(columns["scenario"][k])),
            controller=str(columns["controller"][k]),
            seed=int(columns["seed"][k]),
            **{name: columns[name][k] for name in arrays},
        )


def _add(archive: zipfile.ZipFile, name: str, array: np.ndarray) -> None:
    member = zipfile.ZipInfo(f"{name}.npy", date_time=_NO_DATE)
    with archive.open(member, "w", force_zip64=True) as stream:
        np.lib.format.write_array(stream, array, allow_pickle=False)
