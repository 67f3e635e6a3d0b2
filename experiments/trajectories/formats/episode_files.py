"""Shards as folders of text files, with the notes that the texts have no place for.

Beside the files of its episodes a shard has ``episodes.jsonl``: one line per episode
with its name, seed, controller and scenario, the latter as TOML.
"""

import json
import tomllib
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from ....sim_configs import Scenario, load_scenario
from ....sim_configs.scenario_files import scenario_text
from ..trajectory import Trajectory

NOTES = "episodes.jsonl"


class EpisodeNotes(NamedTuple):
    """What a text file does not tell."""

    name: str
    """First part of the names of the episode's files."""
    seed: int
    controller: str
    scenario: Scenario


def write_notes(trajectories: Sequence[Trajectory], folder: Path) -> list[str]:
    """Write the notes of a shard, and choose the names of its episodes.

    Returns
    -------
    list of str
        Such as ``"seed_00000007"``.
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
    (folder / NOTES).write_text(text, encoding="utf-8", newline="\n")
    return names


def read_notes(folder: Path) -> Iterator[EpisodeNotes]:
    """Yield the notes of each episode of a shard."""
    for line in (folder / NOTES).read_text(encoding="utf-8").splitlines():
        table = json.loads(line)
        scenario = load_scenario(tomllib.loads(table["scenario"]))
        yield EpisodeNotes(table["name"], table["seed"], table["controller"], scenario)


def write_lines(path: Path, lines: Sequence[str]) -> None:
    """Write lines as a UTF-8 text file, the same on every system."""
    path.write_text("\n".join([*lines, ""]), encoding="utf-8", newline="\n")


def numbers(values: Iterable[float]) -> str:
    """Write numbers with blanks between, so that reading gives the same bits.

    Examples
    --------
    >>> numbers([0.1, 2])
    '0.1 2.0'
    """
    return " ".join(repr(float(value)) for value in values)
