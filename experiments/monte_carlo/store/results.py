"""The results of a Monte Carlo as one dataset: estimator × run × step.

xarray and netCDF are loaded where they are used, because workers need neither.
"""

from __future__ import annotations

import json
import platform
from collections.abc import Iterator, Mapping, MutableMapping
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from .... import __version__
from ....evaluation.noise_findings import CHANNELS, MOMENTS
from ...runs.own_files import replace_own
from ..measure.run_measures import NOISE_SIZES, VARIABLES, Block, Variable
from .job_folder import RESULTS
from .result_blocks import Job, Span

if TYPE_CHECKING:
    import xarray as xr

Blocks = Iterator[tuple[Span, list[Block]]]

_PACKAGES = ("numpy", "scipy", "numba", "gymnasium", "pymunk", "xarray")
_FROM_TRUTH = "for a consistent filter, NEES and NIS are χ² with the stated degrees"


def dataset_of(job: Job, blocks: Blocks, runs: Span, command: str = "") -> xr.Dataset:
    """Combine the blocks of a job into a dataset in memory.

    Parameters
    ----------
    job : Job
        The job.
    blocks : iterator
        All its blocks, in order.
    runs : Span
        Their runs.
    command : str
        Command that reproduces the results.
    """
    import xarray as xr  # noqa: PLC0415

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
        attributes(job, runs, command),
    )


def write_results(
    path: Path, job: Job, blocks: Blocks, runs: Span, command: str = ""
) -> None:
    """Write the blocks of a job as one netCDF file, one block in memory at a time.

    Parameters
    ----------
    path : Path
        The file; after an error it stays as it was.
    job, blocks, runs, command
        As in :func:`dataset_of`.
    """
    try:
        with replace_own(path) as partial:
            _write(partial, job, blocks, runs, command)
    except (OSError, RuntimeError) as error:  # netCDF raises the second on a full disk
        reason = getattr(error, "strerror", None) or error
        raise OSError(
            f"{path} cannot be written: {reason}; its blocks stay, to continue from"
        ) from error


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

    file = Path(path)
    file = file / RESULTS if file.is_dir() else file
    if not file.exists():
        raise ValueError(f"{file} does not exist")
    try:
        results = xr.open_dataset(file, engine="netcdf4")
    except (OSError, KeyError, ValueError) as error:
        raise ValueError(
            f"{file} is truncated, or holds no results: {error}; if there is blocks/ "
            "beside it, the same command makes the file again from them"
        ) from error
    lacking = sorted(set(VARIABLES) - set(results.variables))
    if lacking:
        results.close()
        raise ValueError(f"{file} is no result of a Monte Carlo: no {lacking[0]}")
    return results


def _write(path: Path, job: Job, blocks: Blocks, runs: Span, command: str) -> None:
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
        _fill(file.variables, job, blocks, runs)
        file.setncatts(attributes(job, runs, command))


def attributes(job: Job, runs: Span, command: str) -> dict[str, Any]:
    """Return the origin of results: all that is needed to reproduce them."""
    identity = job.identity()
    return {
        "title": f"Monte Carlo of {job.scenario.name}, {runs.size} runs",
        "scenario_name": job.scenario.name,
        "scenario": identity["scenario"],
        "assumed": identity["assumed"],
        "estimators": json.dumps(identity["estimators"]),
        "seed": job.seed,
        "runs": runs.size,
        "block_size": job.block_size,
        "resolution": job.resolution,
        "versions": json.dumps(_versions()),
        "command": command,
        "comment": _FROM_TRUTH,
    }


def _versions() -> dict[str, str]:
    own = {"slamgym": __version__, "python": platform.python_version()}
    return own | {package: version(package) for package in _PACKAGES}


def _fill(
    arrays: MutableMapping[str, Any] | Mapping[str, Any],
    job: Job,
    blocks: Blocks,
    runs: Span,
) -> None:
    variables = job.variables
    for span, parts in blocks:
        rows = slice(span.first - runs.first, span.stop - runs.first)
        for number, block in enumerate(parts):
            for name, values in block.items():
                text = variables[name].kind == "U"
                part = values.astype(object) if text else values
                arrays[name][number, rows] = part


def _stored(kind: str) -> Any:
    """Return the type in a netCDF file, which has no booleans."""
    return {"?": "i1", "i": "i8", "U": str}.get(kind, kind)


def _dims(variable: Variable) -> tuple[str, ...]:
    return ("estimator", *variable.dims)


def _sizes(job: Job, runs: Span) -> dict[str, int]:
    return {
        "estimator": len(job.estimators),
        "run": runs.size,
        "step": job.scenario.steps + 1,
        "landmark": job.scenario.landmarks.count,
        **NOISE_SIZES,
    }


def _coordinates(job: Job, runs: Span) -> dict[str, np.ndarray[Any, Any]]:
    return {dim: np.arange(size) for dim, size in _sizes(job, runs).items()} | {
        "estimator": np.array([choice.label for choice in job.estimators]),
        "run": np.arange(runs.first, runs.stop),
        "noise": np.array(CHANNELS),
        "moment": np.array(MOMENTS),
    }
