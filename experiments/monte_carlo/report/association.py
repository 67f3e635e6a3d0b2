"""Summarise how well readings without identity were associated in many runs."""

from typing import Any

import numpy as np

from ....arrays import Array
from ....evaluation.association_scores import CUTOFF, Gospa
from ...runs.nan_statistics import finite, mean
from ..measure.association_measures import (
    COUNTS,
    KNOWN_IDS_ATE,
    MAPS,
    MARGIN,
    PREFIX,
    SHARES,
)
from .scores import EstimatorScores


def association_summary(scores: EstimatorScores) -> dict[str, Any] | None:
    """Summarise the association of one estimator; None where identities are known.

    Parameters
    ----------
    scores : EstimatorScores
        Results of the estimator.

    Returns
    -------
    dict or None
        Means over the runs that did not fail of ``correct``, ``wrong``,
        ``new_correct``, ``duplicate``, ``ghost``, ``missed``, ``clutter_used``,
        ``map_size``, ``true_map_size``, ``precision`` and ``recall``; None where
        the estimator reports none.  ``gospa``: ``raw`` and ``aligned`` means of
        the metric and its parts, and the ``cutoff`` [m].  ``resolution`` [m].
        ``bad_runs``: ``count`` and ``share`` of all runs, failed or more than
        ``margin`` [m] worse than with known identities.  ``median_ate``: ``hidden``
        and ``known`` [m], raw.
    """
    if KNOWN_IDS_ATE not in scores.results:
        return None
    hidden, known = scores.per_run("ate"), scores.per_run(KNOWN_IDS_ATE)
    bad = int((~scores.good).sum() + (hidden > known + MARGIN).sum())
    parts = {
        which: {
            part: mean(scores.per_run(f"gospa_{which}_{part}"))
            for part in Gospa._fields
        }
        for which in MAPS
    }
    return {
        **{name: mean(scores.per_run(f"{PREFIX}{name}")) for name in COUNTS + SHARES},
        "gospa": {**parts, "cutoff": CUTOFF},
        "resolution": float(scores.results.attrs.get("resolution", 0.0)),
        "bad_runs": {
            "count": bad,
            "share": bad / len(scores.good),
            "margin": MARGIN,
        },
        "median_ate": {"hidden": _median(hidden), "known": _median(known)},
    }


def _median(values: Array) -> float | None:
    known = values[np.isfinite(values)]
    return finite(np.median(known)) if len(known) else None
