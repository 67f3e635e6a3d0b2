"""Select the results of a Monte Carlo that count: successful runs, after the start.

The first step is a scan before any motion. If the start is certain, further leading
steps have no NEES; they are left out as well.
"""

import json
import tomllib
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from ....arrays import Array, BoolArray, IntArray
from ....estimator.models.rigid_motion import ErrorFrame
from ...runs.nan_statistics import quotient

POSE_FREEDOM, POINT_FREEDOM = 3, 2
_FIRST = 1
_LARGEST = 1e100  # squares of larger numbers would overflow
_NO_MESSAGE = "its NEES or NIS is not finite, or above 1e100"


class FailedRun(NamedTuple):
    """A run that is left out of all figures, and the reason."""

    run: int
    step: int
    """-1 where unknown."""
    message: str


class EstimatorScores(NamedTuple):
    """One estimator's results: M successful runs, K steps after the start."""

    label: str
    first: int
    """First step that has a NEES, >= 1."""
    good: BoolArray
    """Which of all runs succeeded, shape (runs,)."""
    failures: tuple[FailedRun, ...]
    results: xr.Dataset
    """Of all runs and steps."""

    @property
    def steps(self) -> IntArray:
        """Numbers of the steps after the start, shape (K,)."""
        return np.arange(_FIRST, self.results.sizes["step"])

    def over_time(self, name: str) -> Array:
        """Return a variable of the runs and steps that count, shape (M, K)."""
        return np.asarray(self.results[name].values[self.good, _FIRST:])

    def per_run(self, name: str) -> Array:
        """Return a variable of the runs that count, shape (M, ...)."""
        return np.asarray(self.results[name].values[self.good])

    def ratios(self, frame: ErrorFrame) -> Array:
        """Return NEES of the pose divided by 3, shape (M, K + 1 − first)."""
        nees = self.over_time(f"pose_nees_{frame}")[:, self.first - _FIRST :]
        return np.asarray(nees / POSE_FREEDOM)

    @property
    def nis_per_degree(self) -> float | None:
        """Sum of NIS by the sum of degrees of freedom; None without readings."""
        freedom = self.over_time("nis_dof")
        return quotient(np.where(freedom > 0, self.over_time("nis"), 0.0), freedom)


def scores_of(dataset: xr.Dataset, label: str, frame: ErrorFrame) -> EstimatorScores:
    """Select one estimator's results, and find its failed runs.

    Parameters
    ----------
    dataset : xarray.Dataset
        Results of ``monte_carlo``.
    label : str
        Label of the estimator.
    frame : {"additive", "invariant"}
        Error coordinates whose NEES must be finite, and below 1e100.
    """
    results = dataset.sel(estimator=label)
    nees = results[f"pose_nees_{frame}"].values
    nis, freedom = results["nis"].values, results["nis_dof"].values
    known = nees < _LARGEST
    first = _FIRST + int(known[:, _FIRST:].any(axis=0).argmax())
    gaps = ~known
    gaps[:, :first] = False
    gaps |= ~(nis < _LARGEST) & (freedom > 0)
    flagged = results["failed"].values.astype(bool)
    good = ~(flagged | gaps.any(axis=1))
    at = np.where(flagged, results["failed_at"].values, gaps.argmax(axis=1))
    failures = [
        FailedRun(
            int(dataset["run"].values[row]),
            int(at[row]),
            str(results["message"].values[row]) or _NO_MESSAGE,
        )
        for row in np.flatnonzero(~good)
    ]
    return EstimatorScores(label, first, good, tuple(failures), results)


def labels_of(dataset: xr.Dataset) -> tuple[str, ...]:
    """Return the labels of the estimators in their order."""
    return tuple(str(label) for label in dataset["estimator"].values)


def estimators_of(dataset: xr.Dataset) -> dict[str, Any]:
    """Return name and options of each estimator by its label."""
    return dict(json.loads(dataset.attrs.get("estimators", "{}")))


def start_heading_std(dataset: xr.Dataset) -> float:
    """Return the standard deviation of the heading at the start [rad].

    Readings are relative to the robot and no landmark is known beforehand, so they hold
    no information about the orientation of the map: no later heading is known better.
    """
    table = tomllib.loads(dataset.attrs["scenario"])
    return float(table.get("start", {}).get("std", (0.0, 0.0, 0.0))[2])
