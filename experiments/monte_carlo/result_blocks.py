"""The results of a Monte Carlo as they come: blocks of runs, in memory or in a folder.

A folder holds ``job.json``, what is computed, and ``blocks/runs-*.npz``, each written
whole or not at all, so that a job may be killed at any time and goes on after its last
whole block.  Blocks of one job made on several machines may be put into one folder.
"""

import hashlib
import json
import warnings
import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ... import __version__
from ...envs.atomic_file import replace_when_written
from ...sim_configs import Scenario
from ...sim_configs.scenario_files import scenario_text
from .estimator_choices import EstimatorChoice
from .run_measures import VARIABLES, Block

FORMAT = "slamgym monte carlo 1"
JOB = "job.json"


class Span(NamedTuple):
    """Consecutive runs."""

    first: int
    stop: int

    @property
    def size(self) -> int:
        """How many."""
        return self.stop - self.first


class Job(NamedTuple):
    """What is computed, but for the number of runs."""

    scenario: Scenario
    assumed: Scenario
    """Whose noise the estimators are told."""
    estimators: tuple[EstimatorChoice, ...]
    seed: int
    block_size: int

    def identity(self) -> dict[str, Any]:
        """Describe the job in plain values; equal jobs have equal ones."""
        return {
            "format": FORMAT,
            "scenario": scenario_text(self.scenario),
            "assumed": scenario_text(self.assumed),
            "estimators": {
                choice.label: {"name": choice.name, "options": dict(choice.options)}
                for choice in self.estimators
            },
            "code": {"slamgym": __version__}
            | {
                choice.label: digest
                for choice in self.estimators
                if (digest := choice.code())
            },
            "seed": self.seed,
            "block_size": self.block_size,
        }

    def digest(self) -> str:
        """Identify the job in its blocks."""
        return _digest(self.identity())

    def spans(self, runs: Span) -> list[Span]:
        """Divide runs into blocks, the last one perhaps shorter."""
        size = self.block_size
        starts = range(runs.first, runs.stop, size)
        return [Span(first, min(first + size, runs.stop)) for first in starts]


class BlockFolder:
    """The blocks of one job.

    Parameters
    ----------
    job : Job
        The job.
    path : Path, optional
        The folder; without one, blocks are kept in memory.
    fresh : bool
        Whether to remove what an earlier job, this one or another, left there.

    Raises
    ------
    ValueError
        If the folder holds another job, or what slamgym did not write.
    OSError
        If it cannot be written.
    """

    def __init__(self, job: Job, path: Path | None, *, fresh: bool = False) -> None:
        self._job = job
        self._path = path
        self._kept: dict[int, list[Block]] = {}
        if path is not None:
            _claim(path, job, fresh)

    def missing(self, runs: Span) -> list[Span]:
        """List the blocks that are still to be computed; warn of a broken one."""
        return [span for span in self._job.spans(runs) if not self._has(span)]

    def add(self, span: Span, blocks: list[Block]) -> None:
        """Keep a block, one part for each estimator."""
        if self._path is None:
            self._kept[span.first] = blocks
            return
        arrays = {
            f"{number}/{name}": array
            for number, block in enumerate(blocks)
            for name, array in block.items()
        }
        file = self._file(span)
        try:
            with replace_when_written(file) as partial:
                np.savez(partial, allow_pickle=False, job=self._job.digest(), **arrays)
        except OSError as error:
            whole = len(list(file.parent.glob("runs-*.npz")))
            raise OSError(
                f"{file} cannot be written: {error.strerror or error}; "
                f"{whole} whole blocks stay there, to go on from"
            ) from error
        for shorter in self._files_from(span.first):
            if shorter != file:
                shorter.unlink()

    def blocks(self, runs: Span) -> Iterator[tuple[Span, list[Block]]]:
        """Give back all blocks in order, one at a time."""
        for span in self._job.spans(runs):
            if self._path is None:
                yield span, self._kept.pop(span.first)
            else:
                yield span, self._read(span)

    def _has(self, span: Span) -> bool:
        if self._path is None:
            return False
        for file in self._files_from(span.first):
            problem = _problem(file, self._job.digest())
            if problem:
                aside = file.replace(file.with_suffix(".broken"))
                warnings.warn(
                    f"{file} {problem}; it is put aside as {aside.name}, and its "
                    "runs are done again",
                    stacklevel=4,
                )
            elif _stop_of(file) >= span.stop:
                return True
        return False

    def _read(self, span: Span) -> list[Block]:
        file = self._files_from(span.first)[-1]  # the longest
        with np.load(file, allow_pickle=False) as arrays:
            return [
                {name: arrays[f"{number}/{name}"][: span.size] for name in VARIABLES}
                for number in range(len(self._job.estimators))
            ]

    def _file(self, span: Span) -> Path:
        assert self._path is not None
        return self._path / "blocks" / f"runs-{span.first:07d}-{span.stop:07d}.npz"

    def _files_from(self, first: int) -> list[Path]:
        assert self._path is not None
        return sorted((self._path / "blocks").glob(f"runs-{first:07d}-*.npz"))


def merge_blocks(sources: Sequence[str | Path], target: str | Path) -> None:
    """Copy the blocks of one job from several folders into one.

    ``monte_carlo`` with ``out=target`` then has only the rest to compute.

    Parameters
    ----------
    sources : sequence of str or Path
        Folders that ``monte_carlo`` has written, at least one.
    target : str or Path
        A new folder, or one of the same job.

    Raises
    ------
    ValueError
        If a folder holds another job than the first, or a damaged block.
    """
    folders = [Path(source) for source in sources]
    if not folders:
        raise ValueError("sources must be at least one folder, got none")
    place, identity = Path(target), _identity_in(folders[0])
    for source in folders:
        _refuse_other(source, _identity_in(source), identity)
    if place.exists() and any(place.iterdir()):
        _refuse_other(place, _identity_in(place), identity)
    _make_ours(place, identity)
    for file in (f for source in folders for f in _blocks_in(source)):
        problem = _problem(file, _digest(identity))
        if problem:
            raise ValueError(f"{file} {problem}")
        copy = place / "blocks" / file.name
        if not copy.exists():
            with replace_when_written(copy) as partial:
                partial.write_bytes(file.read_bytes())


def _digest(identity: dict[str, Any]) -> str:
    text = json.dumps(identity, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def _blocks_in(path: Path) -> list[Path]:
    return sorted((path / "blocks").glob("runs-*.npz"))


def _claim(path: Path, job: Job, fresh: bool) -> None:
    """Make a folder the job's own, or see that it is."""
    if path.exists() and not path.is_dir():
        raise ValueError(f"out must be a folder, got the file {path}")
    if path.exists() and any(path.iterdir()):
        found = _identity_in(path)
        if fresh:
            for block in _blocks_in(path):
                block.unlink()
        else:
            _refuse_other(path, found, job.identity())
    _make_ours(path, job.identity())


def _make_ours(path: Path, identity: dict[str, Any]) -> None:
    text = json.dumps(identity, indent=2, ensure_ascii=False)
    try:
        (path / "blocks").mkdir(parents=True, exist_ok=True)
        with replace_when_written(path / JOB) as partial:
            partial.write_text(text + "\n", encoding="utf-8")
    except OSError as error:
        reason = error.strerror or error
        raise OSError(f"the folder {path} cannot be written: {reason}") from error


def _identity_in(path: Path) -> dict[str, Any]:
    file = path / JOB
    if not file.exists():
        raise ValueError(f"{path} holds no Monte Carlo of slamgym: there is no {JOB}")
    try:
        identity = json.loads(file.read_text(encoding="utf-8"))
    except ValueError:
        identity = None
    if not isinstance(identity, dict) or identity.get("format") != FORMAT:
        raise ValueError(f"{file} is damaged, or not of a Monte Carlo of slamgym")
    return identity


def _refuse_other(path: Path, found: dict[str, Any], asked: dict[str, Any]) -> None:
    for key, value in asked.items():
        if found.get(key) != value:
            raise ValueError(
                f"{path} holds results of {_said(key, found.get(key))}, not of "
                f"{_said(key, value)}: choose another folder, or ask for fresh results"
            )


def _said(key: str, value: Any) -> str:
    """Name a part of a job in a few words."""
    if key in ("scenario", "assumed"):
        lines = str(value).splitlines()
        digest = hashlib.sha256(str(value).encode()).hexdigest()[:8]
        return f"{key} {lines[0].removeprefix('name = ') if lines else ''} ({digest})"
    if key == "estimators" and isinstance(value, dict):
        return f"estimators {', '.join(value)}"
    if key == "code" and isinstance(value, dict):
        return f"code {', '.join(f'{k} {v}' for k, v in value.items())}"
    return f"{key} {value}"


def _problem(file: Path, digest: str) -> str:
    """Say what is wrong with a block, nothing if it is whole."""
    try:
        with zipfile.ZipFile(file) as archive:
            if archive.testzip() is not None:
                return "is damaged"
        with np.load(file, allow_pickle=False) as arrays:
            job = str(arrays["job"])
    except (ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        return f"is truncated or damaged ({error})"
    if job != digest:
        raise ValueError(f"{file} is of another job than its folder: move it away")
    return ""


def _stop_of(file: Path) -> int:
    return int(file.stem.rpartition("-")[2])
