"""Keep the results of a Monte Carlo as blocks of runs, in memory or in a folder.

A folder holds ``job.json``, the description of the job, and ``blocks/runs-*.npz``. Each
block appears complete or not at all, so that a job may be killed at any time and then
continues after its last complete block. Blocks of one job from several machines may be
put into one folder.
"""

import contextlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from .... import __version__
from ....sim_configs import Scenario
from ....sim_configs.atomic_file import replace_when_written
from ....sim_configs.scenario_files import scenario_text
from ...runs.own_files import set_aside
from ..measure.estimator_choices import EstimatorChoice
from ..measure.run_measures import Block, Variable, variables_of
from . import job_folder


class Span(NamedTuple):
    """Consecutive runs."""

    first: int
    stop: int

    @property
    def size(self) -> int:
        """Number of runs."""
        return self.stop - self.first


class Job(NamedTuple):
    """What is computed, except for the number of runs."""

    scenario: Scenario
    assumed: Scenario
    """The scenario whose noise the estimators assume."""
    estimators: tuple[EstimatorChoice, ...]
    seed: int
    block_size: int
    resolution: float = 0.0
    """True landmarks nearer to each other count as one place [m]."""

    @property
    def variables(self) -> dict[str, Variable]:
        """The variables of its results."""
        return variables_of(self.scenario)

    def identity(self) -> dict[str, Any]:
        """Describe the job in plain values, equal for equal jobs."""
        return {
            "format": job_folder.FORMAT,
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
            **({"resolution": self.resolution} if self.resolution else {}),
        }

    def spans(self, runs: Span) -> list[Span]:
        """Divide runs into blocks; the last one may be shorter."""
        size = self.block_size
        starts = range(runs.first, runs.stop, size)
        return [Span(first, min(first + size, runs.stop)) for first in starts]


class BlockFolder:
    """The blocks of one job; its folder is locked within ``with``.

    Parameters
    ----------
    job : Job
        The job.
    path : Path, optional
        The folder; without one, blocks are kept in memory.
    fresh : bool
        Whether to remove the results of an earlier job, this one or another.

    Raises
    ------
    ValueError
        If the folder is a file. On entry: if it holds another job, or files that
        slamgym did not write, or another process writes to it.
    OSError
        On entry, if it cannot be written.
    """

    def __init__(self, job: Job, path: Path | None, *, fresh: bool = False) -> None:
        if path is not None and path.exists() and not path.is_dir():
            raise ValueError(f"out must be a folder, got the file {path}")
        self._job = job
        self._path = path
        self._fresh = fresh
        self._identity = job.identity()  # as the sources of its estimators are now
        self._digest = job_folder.digest_of(self._identity)
        self._kept: dict[int, list[Block]] = {}
        self._claim = contextlib.ExitStack()

    def __enter__(self) -> "BlockFolder":
        """Lock the folder."""
        if self._path is not None:
            claim = job_folder.claimed(self._path, self._identity, fresh=self._fresh)
            self._claim.enter_context(claim)
        return self

    def __exit__(self, *_: object) -> None:
        """Unlock the folder."""
        self._claim.close()

    def missing(self, runs: Span) -> list[Span]:
        """List the blocks that are still to be computed; warn of a damaged one."""
        return [span for span in self._job.spans(runs) if not self._has(span)]

    def add(self, span: Span, blocks: list[Block]) -> None:
        """Keep a block, one part per estimator."""
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
                np.savez(partial, allow_pickle=False, job=self._digest, **arrays)
        except OSError as error:
            whole = len(list(file.parent.glob("runs-*.npz")))
            raise OSError(
                f"{file} cannot be written: {error.strerror or error}; "
                f"{whole} complete blocks stay there, to continue from"
            ) from error
        for shorter in self._files_from(span.first):
            if shorter != file:
                shorter.unlink()

    def blocks(self, runs: Span) -> Iterator[tuple[Span, list[Block]]]:
        """Yield all blocks in order, one at a time."""
        for span in self._job.spans(runs):
            if self._path is None:
                yield span, self._kept.pop(span.first)
            else:
                yield span, self._read(span)

    def _has(self, span: Span) -> bool:
        if self._path is None:
            return False
        for file in self._files_from(span.first):
            problem = job_folder.problem_with(file, self._digest)
            if problem:
                set_aside(file, f"{problem}, and its runs are repeated")
            elif _stop_of(file) >= span.stop:
                return True
        return False

    def _read(self, span: Span) -> list[Block]:
        file = self._files_from(span.first)[-1]  # the longest
        with np.load(file, allow_pickle=False) as arrays:
            return [
                {
                    name: arrays[f"{number}/{name}"][: span.size]
                    for name in self._job.variables
                }
                for number in range(len(self._job.estimators))
            ]

    def _file(self, span: Span) -> Path:
        assert self._path is not None
        name = f"runs-{span.first:07d}-{span.stop:07d}.npz"
        return self._path / job_folder.BLOCKS / name

    def _files_from(self, first: int) -> list[Path]:
        assert self._path is not None
        return sorted((self._path / job_folder.BLOCKS).glob(f"runs-{first:07d}-*.npz"))


def merge_blocks(sources: Sequence[str | Path], target: str | Path) -> None:
    """Copy the blocks of one job from several folders into one.

    ``monte_carlo`` with ``out=target`` then computes only the missing blocks.

    Parameters
    ----------
    sources : sequence of str or Path
        Folders written by ``monte_carlo``, at least one.
    target : str or Path
        A new folder, or one of the same job.

    Raises
    ------
    ValueError
        If a folder holds a different job from the first, or a damaged block, or another
        process writes to the target.
    """
    folders = [Path(source) for source in sources]
    if not folders:
        raise ValueError("sources must be at least one folder, got none")
    place, identity = Path(target), job_folder.identity_in(folders[0])
    for folder in folders:
        job_folder.refuse_other(folder, job_folder.identity_in(folder), identity)
    with job_folder.claimed(place, identity):
        digest = job_folder.digest_of(identity)
        for folder in folders:
            for file in job_folder.blocks_in(folder):
                _copy_block(file, place / job_folder.BLOCKS / file.name, digest)


def _copy_block(file: Path, copy: Path, digest: str) -> None:
    """Copy a block of a job, if the copy does not exist."""
    problem = job_folder.problem_with(file, digest)
    if problem:
        raise ValueError(f"{file} {problem}")
    if not copy.exists():
        with replace_when_written(copy) as partial:
            partial.write_bytes(file.read_bytes())


def _stop_of(file: Path) -> int:
    return int(file.stem.rpartition("-")[2])
