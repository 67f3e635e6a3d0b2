"""The results of a Monte Carlo as they come: blocks of runs, in memory or in a folder.

A folder holds ``job.json``, what is computed, and ``blocks/runs-*.npz``, each written
whole or not at all, so that a job may be killed at any time and goes on after its last
whole block.  Blocks of one job made on several machines may be put into one folder.
"""

import hashlib
import json
import warnings
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

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
            "seed": self.seed,
            "block_size": self.block_size,
        }

    def digest(self) -> str:
        """Identify the job in its blocks."""
        text = json.dumps(self.identity(), sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()

    def spans(self, runs: int) -> list[Span]:
        """Divide runs into blocks, the last one perhaps shorter."""
        size = self.block_size
        return [Span(k, min(k + size, runs)) for k in range(0, runs, size)]


class BlockFolder:
    """The blocks of one job.

    Parameters
    ----------
    job : Job
        The job.
    path : Path, optional
        The folder; without one, blocks are kept in memory.

    Raises
    ------
    ValueError
        If the folder holds another job, or what slamgym did not write.
    OSError
        If it cannot be written.
    """

    def __init__(self, job: Job, path: Path | None) -> None:
        self._job = job
        self._path = path
        self._kept: dict[int, list[Block]] = {}
        if path is not None:
            _claim(path, job)

    def missing(self, runs: int) -> list[Span]:
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

    def blocks(self, runs: int) -> Iterator[tuple[Span, list[Block]]]:
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
                warnings.warn(
                    f"{file} {problem}; its runs are done again", stacklevel=4
                )
                file.unlink()
            elif _stop_of(file) >= span.stop:
                return True
        return False

    def _read(self, span: Span) -> list[Block]:
        (file,) = self._files_from(span.first)
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


def merge_blocks(sources: list[Path], target: Path) -> None:
    """Copy the blocks of one job from several folders into one.

    ``monte_carlo`` with ``out=target`` then has only the rest to compute.

    Raises
    ------
    ValueError
        If a folder holds another job than the first.
    """
    identities = [_identity_in(source) for source in sources]
    for source, identity in zip(sources, identities, strict=True):
        _refuse_other(source, identity, identities[0])
    _make_ours(target, identities[0])
    for source in sources:
        for file in sorted((source / "blocks").glob("runs-*.npz")):
            copy = target / "blocks" / file.name
            if not copy.exists():
                with replace_when_written(copy) as partial:
                    partial.write_bytes(file.read_bytes())


def _claim(path: Path, job: Job) -> None:
    """Make a folder the job's own, or see that it is."""
    if path.exists() and not path.is_dir():
        raise ValueError(f"out must be a folder, got the file {path}")
    if path.exists() and any(path.iterdir()):
        _refuse_other(path, _identity_in(path), job.identity())
    _make_ours(path, job.identity())


def _make_ours(path: Path, identity: dict[str, Any]) -> None:
    (path / "blocks").mkdir(parents=True, exist_ok=True)
    with replace_when_written(path / JOB) as partial:
        text = json.dumps(identity, indent=2, ensure_ascii=False)
        partial.write_text(text + "\n", encoding="utf-8")


def _identity_in(path: Path) -> dict[str, Any]:
    try:
        identity = json.loads((path / JOB).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        identity = None
    if not isinstance(identity, dict) or identity.get("format") != FORMAT:
        raise ValueError(f"{path} holds no Monte Carlo of slamgym: no {JOB} of one")
    return identity


def _refuse_other(path: Path, found: dict[str, Any], asked: dict[str, Any]) -> None:
    for key, value in asked.items():
        if found.get(key) != value:
            raise ValueError(
                f"{path} holds results of {_said(key, found.get(key))}, "
                f"not of {_said(key, value)}: choose another folder"
            )


def _said(key: str, value: Any) -> str:
    """Name a part of a job in a few words."""
    if key in ("scenario", "assumed"):
        lines = str(value).splitlines()
        digest = hashlib.sha256(str(value).encode()).hexdigest()[:8]
        return f"{key} {lines[0].removeprefix('name = ') if lines else ''} ({digest})"
    if key == "estimators" and isinstance(value, dict):
        return f"estimators {', '.join(value)}"
    return f"{key} {value}"


def _problem(file: Path, digest: str) -> str:
    """Say what is wrong with a block, nothing if it is whole."""
    try:
        with zipfile.ZipFile(file) as archive:
            if archive.testzip() is not None:
                return "is damaged"
        with np.load(file, allow_pickle=False) as arrays:
            return "" if str(arrays["job"]) == digest else "is of another job"
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        return f"is truncated or damaged ({error})"


def _stop_of(file: Path) -> int:
    return int(file.stem.rpartition("-")[2])
