"""Shards as folders of text files, with metadata that the text formats lack.

In addition to the files of its episodes, a shard has ``episodes.jsonl`` with one line
per episode: its name, seed, controller, and scenario as TOML.
"""

import json
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from ....sim_configs import Scenario
from ....sim_configs.scenario_files import scenario_text
from ..trajectory import Trajectory, scenario_from_text

METADATA = "episodes.jsonl"


class EpisodeMetadata(NamedTuple):
    """The data of an episode that its text files do not hold."""

    name: str
    """Prefix of the names of the episode's files."""
    seed: int
    controller: str
    scenario: Scenario


def write_metadata(trajectories: Sequence[Trajectory], folder: Path) -> list[str]:
    """Write the metadata of a shard, and return the names of its episodes.

    Returns
    -------
    list of str
        Names such as ``"seed_00000007"``.
    """
    names = [f"seed_{each.seed:08d}" for each in trajectories]
    lines = [
        json.dumps(
            {
                "name": name,
                "seed": each.seed,
                "controller": each.controller,
                "scenario": scenario_text(each.scenario),
            }
        )
        for name, each in zip(names, trajectories, strict=True)
    ]
    text = "\n".join([*lines, ""])
    (folder / METADATA).write_text(text, encoding="utf-8", newline="\n")
    return names


def read_metadata(folder: Path) -> Iterator[EpisodeMetadata]:
    """Yield the metadata of each episode of a shard."""
    for line in (folder / METADATA).read_text(encoding="utf-8").splitlines():
        table = json.loads(line)
        scenario = scenario_from_text(table["scenario"])
        yield EpisodeMetadata(
            table["name"], table["seed"], table["controller"], scenario
        )


def write_lines(path: Path, lines: Sequence[str]) -> None:
    """Write lines as a UTF-8 text file, the same on every system."""
    path.write_text("\n".join([*lines, ""]), encoding="utf-8", newline="\n")


def numbers(values: Iterable[float]) -> str:
    """Write numbers separated by blanks, so that reading gives the same bits.

    Examples
    --------
    >>> numbers([0.1, 2])
    '0.1 2.0'
    """
    return " ".join(repr(float(value)) for value in values)
