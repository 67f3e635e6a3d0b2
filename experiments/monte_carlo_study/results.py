"""The results of a Monte Carlo, a dataset estimator × run × step, and their folder.

A folder holds ``job.json``, the description of the job, and ``blocks/runs-*.npz``.
Each block appears complete or not at all, so that a job may be killed at any time and
then continues after its last complete block. Blocks of one job from several machines
may be put into one folder, and `merge_blocks` does so. xarray and netCDF are loaded
where they are used, because workers need neither.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import platform
import shutil
import zipfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ... import __version__
from ...arrays import Array
from ...estimator.models.sensors import find_sensor
from ...evaluation.noise_findings import CHANNELS, MOMENTS
from ...sim_configs import Scenario
from ...sim_configs.scenario_files import replace_when_written, scenario_text
from ...suggestions import counted
from .. import job_folders
from ..run_and_replay.filter_settings import EstimatorChoice
from . import run_measures

if TYPE_CHECKING:
    import xarray as xr


# --------------------------------------------------------------------------------------
# Keep the results of a Monte Carlo as blocks of runs, in memory or in a folder.


Blocks = Iterable[tuple[range, list[run_measures.Block]]]
_MOST_JOINED = 2**24  # bytes of blocks that are written together

_PACKAGES = ("numpy", "scipy", "numba", "gymnasium", "pymunk", "xarray")
#: The remedies where a folder holds other results.
_OTHERWISE = "choose another folder (out), or ask for fresh results (fresh)"
_FROM_TRUTH = "for a consistent filter, NEES and NIS are χ² with the stated degrees"


def dataset_of(
    job: MonteCarloJob,
    blocks: Blocks,
    runs: range,
    command: str = "",
    more: Mapping[str, str] | None = None,
) -> xr.Dataset:
    """Combine the blocks of a job into a dataset in memory.

    Parameters
    ----------
    job : MonteCarloJob
        The job.
    blocks : iterable
        All its blocks, in any order.
    runs : range
        Their runs.
    command : str
        Command that reproduces the results.
    more : mapping, optional
        Further attributes.
    """
    import xarray as xr  # noqa: PLC0415

    _offer_table()
    sizes = _sizes(job, runs)
    arrays: dict[str, Any] = {
        name: np.empty(
            [sizes[dim] for dim in _dims(variable)],
            object if variable.kind == "U" else variable.kind,
        )
        for name, variable in job.variables.items()
    }
    _fill(arrays, job, blocks, runs)
    return xr.Dataset(
        {
            name: (_dims(variable), arrays[name], {"long_name": variable.meaning})
            for name, variable in job.variables.items()
        },
        {dim: (dim, values) for dim, values in _coordinates(job, runs).items()},
        attributes(job, runs, command) | dict(more or {}),
    )


def write_results(
    path: Path,
    job: MonteCarloJob,
    blocks: Blocks,
    runs: range,
    command: str = "",
    more: Mapping[str, str] | None = None,
) -> None:
    """Write the blocks of a job as one netCDF file, a few in memory at a time.

    Parameters
    ----------
    path : Path
        The file; after an error it stays as it was.
    job, blocks, runs, command, more
        As in :func:`dataset_of`.
    """
    kept, full = "; its blocks stay, to continue from", RuntimeError  # of netCDF
    with job_folders.naming(path, kept, full), job_folders.replace_own(path) as partial:
        _write(partial, job, blocks, runs, command)
        if more:
            _add_attributes(partial, more)


def _add_attributes(path: Path, more: Mapping[str, str]) -> None:
    import netCDF4  # noqa: PLC0415

    with netCDF4.Dataset(path, "a") as file:
        file.setncatts(more)


def add_to_results(path: Path, added: Mapping[str, Array]) -> None:
    """Add variables of shape (estimator, run) to a results file.

    Parameters
    ----------
    path : Path
        The file; after an error it stays as it was.
    added : dict
        Of `SMALL_NOISE`.
    """
    import netCDF4  # noqa: PLC0415

    with (
        job_folders.naming(path, also=RuntimeError),
        job_folders.replace_own(path) as partial,
    ):
        shutil.copyfile(path, partial)
        with netCDF4.Dataset(partial, "a") as file:
            for name, values in added.items():
                variable = run_measures.SMALL_NOISE[name]
                made = file.createVariable(name, variable.kind, _dims(variable))
                made.long_name = variable.meaning
                made[:] = values


def load_results(path: str | Path) -> xr.Dataset:
    """Open the results of a Monte Carlo; arrays are read on demand.

    Parameters
    ----------
    path : str or Path
        A ``results.nc``, or the folder that holds it.

    Raises
    ------
    ValueError
        If the file is not one, or not complete.
    """
    import xarray as xr  # noqa: PLC0415

    _offer_table()
    file = Path(path)
    file = file / RESULTS if file.is_dir() else file
    if not file.exists():
        raise ValueError(f"{file} does not exist")
    try:
        results = xr.open_dataset(file, engine="netcdf4")
    except (OSError, KeyError, ValueError) as error:
        raise ValueError(
            f"{file} is truncated, or holds no results: {error}; if the folder "
            "blocks is beside it, repeat the command: it makes the file again"
        ) from error
    needed = set(run_measures.VARIABLES) - set(run_measures.DEVIATIONS)  # newer
    lacking = sorted(needed - set(results.variables))
    if lacking:
        results.close()
        raise ValueError(f"{file} is no result of a Monte Carlo: no {lacking[0]}")
    return results


class TableMethod:
    """The method ``table`` of results."""

    def __init__(self, results: xr.Dataset) -> None:
        self._results = results

    def __call__(self) -> Any:
        """Return `verdict_table` of the results."""
        # By its public name: the module that makes it reads results.
        return import_module(__package__).verdict_table(self._results)


def _offer_table() -> None:
    """Give the datasets of xarray the method ``table``."""
    import xarray as xr  # noqa: PLC0415

    register: Any = xr.register_dataset_accessor
    if not hasattr(xr.Dataset, "table"):
        register("table")(TableMethod)


def _write(
    path: Path, job: MonteCarloJob, blocks: Blocks, runs: range, command: str
) -> None:
    import netCDF4  # noqa: PLC0415

    with netCDF4.Dataset(path, "w") as file:
        for dim, size in _sizes(job, runs).items():
            file.createDimension(dim, size)
        for dim, values in _coordinates(job, runs).items():
            file.createVariable(dim, _stored(values.dtype.kind), (dim,))[:] = values
        for name, variable in job.variables.items():
            made = file.createVariable(name, _stored(variable.kind), _dims(variable))
            made.long_name = variable.meaning
            if variable.kind == "?":
                made.setncattr("dtype", "bool")  # xarray gives it back as such
        _fill(file.variables, job, _together(blocks), runs)
        file.setncatts(attributes(job, runs, command))


def attributes(job: MonteCarloJob, runs: range, command: str) -> dict[str, Any]:
    """Return the origin of results: all that is needed to reproduce them."""
    identity = job.identity()
    return {
        "title": f"Monte Carlo of {job.scenario.name}, {counted(len(runs), 'run')}",
        "scenario_name": job.scenario.name,
        "scenario": identity["scenario"],
        "assumed": identity["assumed"],
        "estimators": json.dumps(identity["estimators"]),
        # 1 where filters use readings later than they were made
        "readings_may_wait": int(not find_sensor(job.scenario.sensor.kind).places),
        "seed": job.seed,
        "runs": len(runs),
        "block_size": job.block_size,
        "resolution": job.resolution,
        **provenance(command),
    }


def provenance(command: str) -> dict[str, str]:
    """Return the attributes that name the command and the versions of packages."""
    own = {"slamgym": __version__, "python": platform.python_version()}
    found = own | {package: version(package) for package in _PACKAGES}
    return {"versions": json.dumps(found), "command": command, "comment": _FROM_TRUTH}


def _fill(
    arrays: Mapping[str, Any], job: MonteCarloJob, blocks: Blocks, runs: range
) -> None:
    variables = job.variables
    for span, parts in blocks:
        rows = slice(span.start - runs.start, span.stop - runs.start)
        for number, block in enumerate(parts):
            for name, values in block.items():
                text = variables[name].kind == "U"
                part = values.astype(object) if text else values
                arrays[name][number, rows] = part


def _together(blocks: Blocks) -> Blocks:
    """Join successive blocks: a file takes few large parts in less time."""
    held: list[tuple[range, list[run_measures.Block]]] = []
    for runs, parts in blocks:
        is_next = not held or runs.start == held[-1][0].stop
        if not is_next or len(held) * _bytes_of(parts) > _MOST_JOINED:
            yield _whole(held)
            held = []
        held.append((runs, parts))
    if held:
        yield _whole(held)


def _whole(
    held: Sequence[tuple[range, list[run_measures.Block]]],
) -> tuple[range, list[run_measures.Block]]:
    runs = range(held[0][0].start, held[-1][0].stop)
    of_each = zip(*(parts for _, parts in held), strict=True)
    return runs, [run_measures.joined(parts) for parts in of_each]


def _bytes_of(parts: Iterable[run_measures.Block]) -> int:
    return sum(array.nbytes for part in parts for array in part.values())


def _stored(kind: str) -> Any:
    """Return the type in a netCDF file, which has no booleans."""
    return {"?": "i1", "i": "i8", "U": str}.get(kind, kind)


def _dims(variable: run_measures.Variable) -> tuple[str, ...]:
    return ("estimator", *variable.dims)


def _sizes(job: MonteCarloJob, runs: range) -> dict[str, int]:
    return {
        "estimator": len(job.estimators),
        "run": len(runs),
        "step": job.scenario.steps + 1,
        "landmark": job.scenario.landmarks.count,
        **run_measures.NOISE_SIZES,
    }


def _coordinates(job: MonteCarloJob, runs: range) -> dict[str, np.ndarray[Any, Any]]:
    return {dim: np.arange(size) for dim, size in _sizes(job, runs).items()} | {
        "estimator": np.array([choice.label for choice in job.estimators]),
        "run": np.arange(runs.start, runs.stop),
        "noise": np.array(CHANNELS),
        "moment": np.array(MOMENTS),
    }


# --------------------------------------------------------------------------------------
# The folder of a Monte Carlo: it belongs to one job (``job.json``) and one writer.

FORMAT = "slamgym monte carlo 6"
JOB, BLOCKS, RESULTS = "job.json", "blocks", "results.nc"
REPORT, SUMMARY = "report.html", "summary.json"


#: Key in ``job.json`` of the looks: the verdicts that were given so far.
LOOKS = "looks"


class BlockFolder(NamedTuple):
    """The blocks of a job in its folder, which `opened` makes, checks and locks."""

    path: Path
    #: Of the job.
    digest: str

    def missing(self, blocks: Iterable[range], variables: Iterable[str]) -> list[range]:
        """Return the blocks that are still to be computed; warn of a damaged one.

        Raises
        ------
        ValueError
            If a block belongs to another job, or lacks a variable of the results.
        """
        names = {f"0/{name}" for name in variables}
        return [runs for runs in blocks if not self._has(runs, names)]

    def _has(self, runs: range, names: set[str]) -> bool:
        for file in self._files_from(runs.start):
            problem = problem_with(file, self.digest, names)
            if problem:
                job_folders.set_aside(file, f"{problem}, and its runs are repeated")
            elif int(file.stem.rpartition("-")[2]) >= runs.stop:
                return True
        return False

    def add(self, runs: range, parts: list[run_measures.Block]) -> None:
        """Keep a block, one part per estimator."""
        arrays = {
            f"{number}/{name}": array
            for number, part in enumerate(parts)
            for name, array in part.items()
        }
        file = self.path / BLOCKS / f"runs-{runs.start:07d}-{runs.stop:07d}.npz"
        whole = len(blocks_in(self.path))
        kept = f"; {whole} complete blocks stay there, to continue from"
        with job_folders.naming(file, kept), replace_when_written(file) as partial:
            np.savez(partial, allow_pickle=False, job=self.digest, **arrays)
        for shorter in self._files_from(runs.start):
            if shorter != file:
                shorter.unlink()

    def read(self, blocks: Iterable[range], job: MonteCarloJob) -> Blocks:
        """Yield blocks with their runs, one at a time."""
        for runs in blocks:
            file = self._files_from(runs.start)[-1]  # the longest
            with np.load(file, allow_pickle=False) as arrays:
                parts = [
                    {k: arrays[f"{number}/{k}"][: len(runs)] for k in job.variables}
                    for number in range(len(job.estimators))
                ]
            yield runs, parts

    def looks(self) -> list[tuple[int, int, str]]:
        """Return first run, end of the runs and ``until`` of each verdict so far."""
        return _looks_in(self.path)

    def keep_look(self, look: tuple[int, int, str]) -> None:
        """Record that there is a verdict on some runs."""
        looks = self.looks()
        if look not in looks:
            _write_job(self.path, identity_in(self.path), [*looks, look])

    def copy(self, file: Path) -> None:
        """Add a block of another folder, if it is not there."""
        problem = problem_with(file, self.digest)
        if problem:
            raise ValueError(f"{file} {problem}")
        copy = self.path / BLOCKS / file.name
        if not copy.exists():
            with replace_when_written(copy) as partial:
                partial.write_bytes(file.read_bytes())

    def _files_from(self, first: int) -> list[Path]:
        return sorted((self.path / BLOCKS).glob(f"runs-{first:07d}-*.npz"))


@contextlib.contextmanager
def opened(
    path: Path, identity: dict[str, Any], *, fresh: bool = False
) -> Iterator[BlockFolder]:
    """Make a folder for a job, or check that it is the job's, and lock it.

    Files that a killed writer left half written are removed.

    Parameters
    ----------
    path : Path
        The folder; it is made if it does not exist.
    identity : dict
        The job in plain values.
    fresh : bool
        Whether to remove the results of an earlier job, this one or another. Files
        that were changed since are set aside with a warning.

    Raises
    ------
    ValueError
        If the folder is a file, holds another job or what slamgym did not write, or
        another process writes to it.
    OSError
        If it cannot be written.
    """
    with job_folders.claimed(path) as anything:
        found = identity_in(path) if anything else None
        if found and not fresh:
            refuse_other(path, found, identity)
        with job_folders.naming(f"the folder {path}"):
            job_folders.remove_leftovers(path, path / BLOCKS)
            if found and fresh:
                _clear(path, found)
            _write_job(path, identity, _looks_in(path) if found and not fresh else [])
            (path / BLOCKS).mkdir(exist_ok=True)
        yield BlockFolder(path, digest_of(identity))


def _write_job(
    path: Path, identity: dict[str, Any], looks: Sequence[tuple[int, int, str]]
) -> None:
    table = identity | ({LOOKS: looks} if looks else {})
    with replace_when_written(path / JOB) as partial:
        text = json.dumps(table, indent=2, ensure_ascii=False)
        partial.write_text(text + "\n", encoding="utf-8")


def _clear(path: Path, identity: dict[str, Any]) -> None:
    """Remove the results of a job, and set aside what is not proven to be one."""
    digest, own = digest_of(identity), job_folders.own_files(path)
    for block in blocks_in(path):
        problem = problem_with(block, digest)
        if problem:
            job_folders.set_aside(block, problem)
        else:
            block.unlink()
    for name in (RESULTS, REPORT, SUMMARY):
        if not os.path.lexists(path / name):
            continue
        if job_folders.own_entry(path, name, own):
            (path / name).unlink()
        else:
            job_folders.set_aside(path / name, "is not as slamgym wrote it")


def blocks_in(path: Path) -> list[Path]:
    """List the whole blocks of a folder, in order."""
    return sorted((path / BLOCKS).glob("runs-*.npz"))


def problem_with(block: Path, digest: str, names: Iterable[str] = ()) -> str:
    """Return what is wrong with a block of a job; empty if it is complete.

    Raises
    ------
    ValueError
        If it belongs to another job, or lacks an array of these names.
    """
    try:
        with zipfile.ZipFile(block) as archive:
            if archive.testzip() is not None:
                return "is damaged"
        with np.load(block, allow_pickle=False) as arrays:
            job, lacking = str(arrays["job"]), sorted({*names} - {*arrays.files})
    except (ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        return f"is truncated or damaged ({error})"
    if job != digest:
        raise ValueError(f"{block} belongs to another job: move it away")
    if lacking:
        raise ValueError(
            f"{block} was written before {lacking[0].rpartition('/')[2]} was measured: "
            f"{_OTHERWISE}"
        )
    return ""


def digest_of(identity: dict[str, Any]) -> str:
    """Return the digest that identifies a job in its blocks."""
    return hashlib.sha256(json.dumps(identity, sort_keys=True).encode()).hexdigest()


def identity_in(path: Path) -> dict[str, Any]:
    """Read the job of a folder.

    Raises
    ------
    ValueError
        If there is none.
    """
    identity = _job_in(path)
    identity.pop(LOOKS, None)
    return identity


def _looks_in(path: Path) -> list[tuple[int, int, str]]:
    """Read the looks of a folder.

    Raises
    ------
    ValueError
        If they are damaged.
    """
    found = _job_in(path).get(LOOKS, [])
    with contextlib.suppress(TypeError, ValueError):
        return [(int(first), int(stop), str(until)) for first, stop, until in found]
    raise ValueError(
        f"{path / JOB} is damaged: {LOOKS} must be triples of first run, end and "
        f"until, got {found!r}"
    )


def _job_in(path: Path) -> dict[str, Any]:
    file = path / JOB
    if not file.exists():
        raise ValueError(f"{path} holds no Monte Carlo of slamgym: there is no {JOB}")
    try:
        identity = json.loads(file.read_text(encoding="utf-8"))
    except (ValueError, RecursionError):
        identity = None
    form = identity.get("format") if isinstance(identity, dict) else None
    if form != FORMAT and str(form).startswith(FORMAT.rstrip("0123456789")):
        raise ValueError(
            f"{file} was written by another version of slamgym: choose another folder"
        )
    if not isinstance(identity, dict) or form != FORMAT:
        raise ValueError(f"{file} is damaged, or no result of slamgym monte-carlo")
    return identity


def refuse_other(path: Path, found: dict[str, Any], asked: dict[str, Any]) -> None:
    """Refuse a folder of another job.

    Raises
    ------
    ValueError
        With the first difference.
    """
    key = job_folders.difference(found, asked)
    if key is not None:
        raise ValueError(
            f"{path} holds results of {_described(key, found.get(key))}, "
            f"not of {_described(key, asked.get(key))}: {_OTHERWISE}"
        )


def _described(key: str, value: Any) -> str:
    """Describe a part of a job in a few words."""
    if key in ("scenario", "assumed"):
        lines = str(value).splitlines()
        digest = hashlib.sha256(str(value).encode()).hexdigest()[:8]
        return f"{key} {lines[0].removeprefix('name = ') if lines else ''} ({digest})"
    if key == "estimators" and isinstance(value, dict):
        return f"estimators {', '.join(value)}"
    if key == "code" and isinstance(value, dict):
        return f"code {', '.join(f'{k} {v}' for k, v in value.items())}"
    return f"{key} {0.0 if value is None else value}"


class MonteCarloJob(NamedTuple):
    """What is computed, except for the number of runs."""

    scenario: Scenario
    #: The scenario whose noise the estimators assume.
    assumed: Scenario
    estimators: tuple[EstimatorChoice, ...]
    seed: int
    block_size: int
    #: True landmarks nearer to each other count as one place [m].
    resolution: float = 0.0

    @property
    def variables(self) -> dict[str, run_measures.Variable]:
        """The variables of its results."""
        return run_measures.variables_of(self.scenario)

    def identity(self) -> dict[str, Any]:
        """Describe the job in plain values, equal for equal jobs."""
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
            **({"resolution": self.resolution} if self.resolution else {}),
        }


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
    place, identity = Path(target), identity_in(folders[0])
    for folder in folders:
        refuse_other(folder, identity_in(folder), identity)
    with opened(place, identity) as merged:
        for file in (file for folder in folders for file in blocks_in(folder)):
            merged.copy(file)
