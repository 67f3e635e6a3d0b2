"""Shards as folders of text files, with metadata that the text formats lack.

In addition to the files of its episodes, a shard has ``episodes.jsonl`` with one line
per episode: its name, seed, controller, and scenario as TOML.
"""

import json
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from ....sim_configs.scenario_files import scenario_text
from ..trajectory import Trajectory, scenario_from_text

METADATA = "episodes.jsonl"


def write_metadata(
    trajectories: Sequence[Trajectory], folder: Path
) -> list[tuple[str, Trajectory]]:
    """Make the folder of a shard with its metadata, and name the episodes.

    Returns
    -------
    list of (str, Trajectory)
        Names such as ``"seed_00000007"``, prefixes of the names of the episode's files,
        and the trajectories.
    """
    folder.mkdir()
    named = [(f"seed_{each.seed:08d}", each) for each in trajectories]
    tables = [
        {
            "name": name,
            "seed": each.seed,
            "controller": each.controller,
            "scenario": scenario_text(each.scenario),
        }
        for name, each in named
    ]
    write_lines(folder / METADATA, [json.dumps(table) for table in tables])
    return named


def read_metadata(folder: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield for each episode its name, and its scenario, controller and seed."""
    for line in (folder / METADATA).read_text(encoding="utf-8").splitlines():
        table = json.loads(line)
        table["scenario"] = scenario_from_text(table["scenario"])
        yield table.pop("name"), table


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
