"""File formats of trajectories, one module each, loaded on demand.

A shard of some episodes is one file or one folder. Every module has `write` and `read`,
and those of the other fields of `TrajectoryFormat` that differ from
their defaults.
"""

from collections.abc import Callable, Iterator, Mapping
from importlib import import_module
from pathlib import Path
from typing import NamedTuple

from ....sim_configs import Scenario
from ....sim_configs.field_types import unknown_choice
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


class TrajectoryFormat(NamedTuple):
    """What a module of this package defines."""

    write: Callable[..., None]
    """Writes a shard: (trajectories, path), and its options by name. The same
    trajectories give the same bytes."""
    read: Callable[[Path], Iterator[Trajectory]]
    """Yields the trajectories of a shard, one after the other."""
    check: Callable[[Scenario], None] = lambda scenario: None
    """Raises a ValueError for a scenario that the format cannot hold."""
    ENDING: str = ""
    """The ending of the names of its shards."""
    LIBRARIES: tuple[str, ...] = ()
    """The packages besides numpy that write it; their versions determine the bytes."""
    OPTIONS: Mapping[str, float] = {}
    """Names and defaults of the numbers > 0 that its `write` also takes."""
    HOLDS_BELIEFS: bool = False
    """Whether it writes and reads the beliefs of a filter too."""


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
    defined = {
        n: vars(module)[n] for n in TrajectoryFormat._fields if n in vars(module)
    }
    return TrajectoryFormat(**defined)
