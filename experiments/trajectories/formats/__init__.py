"""File formats of trajectories, one module each, loaded on demand.

A shard of some episodes is one file or one folder. Every module has

``ENDING``
    The ending of the names of its shards.
``LIBRARIES``
    The packages besides numpy that write it; their versions determine the bytes.
``check(scenario)``
    Raises a ValueError for a scenario that the format cannot hold.
``write(trajectories, path)``
    Writes a shard. The same trajectories give the same bytes.
``read(path)``
    Yields the trajectories of a shard, one after the other.
"""

from collections.abc import Iterator, Sequence
from importlib import import_module
from pathlib import Path
from typing import Protocol, cast

from ....sim_configs import Scenario
from ....sim_configs.scenario_errors import unknown_choice
from ..trajectory import Trajectory

FORMATS = {
    "slamlog": "slamlog_files",
    "npz": "npz",
    "parquet": "parquet",
    "minari": "minari_dataset",
    "tum": "tum",
    "g2o": "g2o",
}
"""Names of the formats and of their modules."""


class TrajectoryFormat(Protocol):
    """The interface of a module of this package."""

    ENDING: str
    LIBRARIES: tuple[str, ...]

    def check(self, scenario: Scenario) -> None:
        """Raise a ValueError for a scenario that the format cannot hold."""

    def write(self, trajectories: Sequence[Trajectory], path: Path) -> None:
        """Write a shard."""

    def read(self, path: Path) -> Iterator[Trajectory]:
        """Yield the trajectories of a shard."""
        ...


def trajectory_format(name: str) -> TrajectoryFormat:
    """Load a format by its name.

    Raises
    ------
    ValueError
        If there is no such format.
    ImportError
        If its package is not installed; the message shows how to install it.

    Examples
    --------
    >>> trajectory_format("npz").ENDING
    '.npz'
    >>> trajectory_format("npy")
    Traceback (most recent call last):
    ValueError: format must be one of slamlog, npz, parquet, minari, tum, g2o, got \
'npy'; did you mean 'npz'?
    """
    if name not in FORMATS:
        raise ValueError(unknown_choice("format", name, FORMATS))
    try:
        module = import_module(f".{FORMATS[name]}", __name__)
    except ModuleNotFoundError as error:
        raise ImportError(
            f"the format '{name}' needs the package {error.name}: "
            "pip install 'slamgym[trajectories]'"
        ) from None
    return cast(TrajectoryFormat, module)
