"""The efficiency of an estimator: the bound of any filter by its squared error."""

from typing import Any

import numpy as np

from ....evaluation.error_bound import Efficiency, efficiency
from ...runs.nan_statistics import finite
from .scores import EstimatorScores


def efficiency_summary(scores: EstimatorScores) -> dict[str, Any] | None:
    """Divide the bounds by the mean squared errors, in the invariant frame.

    Returns
    -------
    dict or None
        ``pose`` (of the position) and ``heading`` over runs and steps, and ``map``,
        about its centre, at the end: ``{value, interval}`` each, None where it is not
        known. A smoother knows of a pose what comes later too, which no bound of
        filters holds for, so that it has that of the map only. None for results
        without bounds.
    """
    if "position_bound" not in scores.results:
        return None
    found = {"pose": None, "heading": None, "map": _of_the_map(scores)}
    if scores.nis_per_degree is None:
        return found
    pairs = {
        "pose": ("position_bound", "position_error_invariant"),
        "heading": ("heading_bound", "heading_error"),
    }
    each = {
        name: efficiency(scores.over_time(bound), scores.over_time(error) ** 2)
        for name, (bound, error) in pairs.items()
    }
    return found | {name: _entry(value) for name, value in each.items()}


def _of_the_map(scores: EstimatorScores) -> dict[str, Any] | None:
    bound, error = scores.per_run("map_bound"), scores.per_run("map_error_centred")
    known = np.isfinite(bound) & np.isfinite(error)
    return _entry(efficiency(bound[known], error[known] ** 2))


def _entry(found: Efficiency) -> dict[str, Any] | None:
    if not np.isfinite(found.value):
        return None
    return {
        "value": finite(found.value),
        "interval": [finite(end) for end in found.interval],
    }
