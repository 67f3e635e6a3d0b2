"""Scenarios on disk: presets, TOML files and their JSON schema.

`load_scenario` reads a preset or a file, and `save_scenario` writes one.
`drawn_scenario` draws the world of one episode from the ranges of a scenario.

Files of any kind are written by `replace_when_written`, whole or not at all.
"""

import json
import os
import platform
import re
import secrets
import tomllib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from ..arrays import Array
from ..suggestions import closest
from .field_types import ScenarioError
from .scenario import RANGES, Scenario

_FOLDER = Path(__file__).parent
_PRESETS = _FOLDER / "presets"
SCHEMA_FILE = _FOLDER / "scenario.schema.json"

#: Files and folders that this process is writing, to be removed if it must end.
unfinished: set[Path] = set()
#: Who writes a file, and a number, as in the name of an unfinished one.
WRITER = r"(\d{1,9})@(.+)-[0-9a-f]{8}"
_UNFINISHED = re.compile(rf"\..+\.{WRITER}\.\w+")


def list_presets() -> tuple[str, ...]:
    """Return the names of the scenarios in the package, in alphabetical order.

    Examples
    --------
    >>> "six_landmarks" in list_presets()
    True
    """
    return tuple(sorted(path.stem for path in _PRESETS.glob("*.toml")))


def load_scenario(source: Scenario | Mapping[str, object] | str | Path) -> Scenario:
    """Load a scenario from a preset, a file or a mapping.

    Parameters
    ----------
    source : Scenario, mapping, str or Path
        The name of a preset, the path of a ``.toml`` file, a mapping of plain values,
        or a scenario, which is returned unchanged.

    Returns
    -------
    Scenario

    Raises
    ------
    ScenarioError
        If there is no such preset or file, or if the scenario is invalid. The message
        has one line per mistake, each with the file's name.

    Examples
    --------
    >>> load_scenario("six_landmarks").landmarks.count
    6
    """
    if isinstance(source, Scenario):
        return source
    if isinstance(source, Mapping):
        return Scenario.from_table(source)
    if not isinstance(source, str | Path):
        raise ScenarioError(
            "scenario must be a preset's name, the path of a .toml file, a mapping or "
            f"a Scenario, got {source!r}"
        )
    if isinstance(source, Path) or source.endswith(".toml"):
        return _load_file(Path(source))
    if source not in list_presets():
        raise ScenarioError(
            f"scenario must be a preset ({', '.join(list_presets())}) or a .toml file, "
            f"got '{source}'{closest(source, list_presets())}"
        )
    return _load_file(_PRESETS / f"{source}.toml")


def save_scenario(scenario: Scenario, path: str | Path) -> None:
    """Write a scenario to a TOML file; `load_scenario` reads an equal one from it."""
    target = Path(path)
    with naming_file(target):
        target.write_text(scenario_text(scenario), encoding="utf-8")


def scenario_text(scenario: Scenario) -> str:
    """Format a scenario as TOML with every field, including the defaults.

    Examples
    --------
    >>> import tomllib
    >>> scenario = load_scenario("loop")
    >>> load_scenario(tomllib.loads(scenario_text(scenario))) == scenario
    True
    """
    table = scenario.model_dump(exclude_none=True)
    parts = {key: value for key, value in table.items() if isinstance(value, dict)}
    lines = [assignment(key, table[key]) for key in table if key not in parts]
    for name, part in parts.items():
        lines += ["", f"[{name}]", *(assignment(*item) for item in part.items())]
    return "\n".join([*lines, ""])


def scenario_schema() -> str:
    """Return the JSON schema of scenario files, by which editors complete and check."""
    schema = Scenario.model_json_schema()
    for part in schema["$defs"].values():
        tags = [key for key in ("layout", "sequence") if key in part["properties"]]
        part["required"] = tags + part.get("required", [])
    return json.dumps(schema, indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def _load_file(path: Path) -> Scenario:
    text = _text_of(path)
    if _DOTTED.search(text):  # tomllib takes minutes for a key of 50,000 parts
        raise ScenarioError(_too_deep(path))
    try:
        return Scenario.from_table(tomllib.loads(text))
    except tomllib.TOMLDecodeError as error:
        raise ScenarioError(_syntax_message(path, str(error))) from None
    except RecursionError:
        raise ScenarioError(_too_deep(path)) from None
    except ScenarioError as error:
        lines = str(error).splitlines()
        raise ScenarioError("\n".join(f"{path}: {line}" for line in lines)) from None
    except ValueError as error:  # a number of thousands of digits
        raise ScenarioError(f"{path}: {error}") from None


# a key, not numbers in a list; from the start of a word, else a long one takes hours
_DOTTED = re.compile(r"(?<![\w\"'-])(?:[\w\"'-]+[ \t]*\.[ \t]*){64}")


def _text_of(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except OSError as error:
        reason = error.strerror or error
        raise ScenarioError(f"cannot read the scenario '{path}': {reason}") from None
    except UnicodeDecodeError as error:
        raise ScenarioError(f"{path} must be UTF-8 text, got {error.reason}") from None


def _too_deep(path: Path) -> str:
    return f"{path} must nest tables at most 2 deep, but nests them beyond reading"


def _syntax_message(path: Path, message: str) -> str:
    """Move the line number from the end of tomllib's message to the front."""
    reason, _, place = message.rpartition(" (at ")
    line = re.match(r"line \d+", place)
    where = line[0] if line else place.removesuffix(")")
    return f"{path}, {where}: {reason}"


def assignment(key: str, value: object) -> str:
    """Format a value as a line of TOML."""
    return f"{key} = {toml_value(value)}"


def toml_value(value: Any) -> str:
    """Format a value as TOML."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, tuple):
        return f"[{', '.join(map(toml_value, value))}]"
    return repr(value)


# --------------------------------------------------------------------------------------
# The scenarios that episodes draw from the ranges of one.


def drawn_scenario(scenario: Scenario, rng: np.random.Generator) -> Scenario:
    """Draw the scenario of one episode.

    Every range has its own random number u, so no range affects the draw of another::

        factor = low (high / low)^u,    value = low + u (high - low),    u ~ U[0, 1)

    Parameters
    ----------
    scenario : Scenario
        With or without ``randomise``.
    rng : numpy.random.Generator
        Source of the random numbers.

    Returns
    -------
    Scenario
        Without ``randomise``. A scenario without ranges is returned unchanged. A map
        that is scaled or shifted becomes a layout of points.

    Examples
    --------
    >>> from slamgym.sim_configs import load_scenario
    >>> ranges = {"motion_std": [0.5, 2.0], "start_heading": [-3.0, 3.0]}
    >>> scenario = load_scenario("six_landmarks").with_changes(randomise=ranges)
    >>> drawn = drawn_scenario(scenario, np.random.default_rng(0))
    >>> [round(std / 0.1, 3) for std in drawn.motion.std]
    [3.023, 1.209, 1.209]
    >>> drawn == drawn_scenario(scenario, np.random.default_rng(0))
    True
    """
    if scenario.randomise is None:
        return scenario
    shares = dict(zip(RANGES, rng.random(len(RANGES)).tolist(), strict=True))
    directions = rng.uniform(-1.0, 1.0, (scenario.landmarks.count, 2))
    return scenario.drawn_at(shares, directions)


def refuse_ranges(scenario: Scenario) -> None:
    """Raise a `ScenarioError` if a scenario has ranges (``randomise``)."""
    if scenario.randomise is not None:
        raise ScenarioError(
            f"scenario '{scenario.name}' has ranges (randomise), and a log has the "
            "noise of one world: draw it with drawn_scenario, as slamgym generate does"
        )


def copied_draw(
    scenario: Scenario, shares: Mapping[str, float], directions: Array
) -> Scenario:
    """Return `Scenario.drawn_at` in a tenth of its time, without its checks."""
    assert scenario.randomise is not None
    changes = scenario.randomise.changes(scenario, shares, directions)
    if "layout" in changes.get("landmarks", {}):
        return scenario.with_changes(**changes)
    tables = {
        key: table and getattr(scenario, key).model_copy(update=table)
        for key, table in changes.items()
    }
    return scenario.model_copy(update=tables)


def widest_scenario(scenario: Scenario) -> Scenario:
    """Return a scenario at the high ends of its ranges; itself without any."""
    return scenario if scenario.randomise is None else scenario.at_share(1.0)


# --------------------------------------------------------------------------------------
# Files of any kind: replaced as a whole, and named in errors.


@contextmanager
def replace_when_written(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`, and move it there at the end of the block.

    An exception inside the block removes the temporary file and leaves an older file at
    `path` unchanged.

    Parameters
    ----------
    path : str or Path
        The final path; its folder must exist.

    Yields
    ------
    Path
        A hidden path in the same folder with the same suffix, for writing.

    Raises
    ------
    FileNotFoundError
        If the folder does not exist.
    OSError
        If the file cannot be written; it names `path`.
    """
    target = Path(path)
    if not target.parent.is_dir():
        raise FileNotFoundError(f"the folder of {target} does not exist")
    unique = f"{os.getpid()}@{platform.node()}-{secrets.token_hex(4)}"
    partial = target.with_name(f".{target.stem}.{unique}{target.suffix}")
    unfinished.add(partial)
    try:
        with naming_file(target, partial):
            yield partial
            partial.replace(target)
    finally:
        partial.unlink(missing_ok=True)
        unfinished.discard(partial)


def remove_unfinished(folder: Path) -> None:
    """Remove what killed processes of this machine have left of files in a folder."""
    for path in folder.glob(".*@*-*.*"):
        found = _UNFINISHED.fullmatch(path.name)
        if found and found[2] == platform.node() and os.name == "posix":
            try:
                os.kill(int(found[1]), 0)  # sends nothing
            except ProcessLookupError:
                path.unlink(missing_ok=True)
            except OSError:  # a process of another user
                continue


@contextmanager
def naming_file(path: Path, written: Path | None = None) -> Iterator[None]:
    """Name a file in errors of the system that name none, such as a size limit's.

    Parameters
    ----------
    path : Path
        The file to name.
    written : Path, optional
        A temporary file in its place, whose name errors do not repeat.
    """
    try:
        yield
    except OSError as error:
        named = error.filename
        if error.errno is None or (named and str(named) != str(written)):
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error
