"""The numbers of a Monte Carlo, as one dictionary of plain JSON types."""

import json
import math
from typing import Any

import numpy as np
import xarray as xr

from ...estimator.consistency import average_band
from ...estimator.consistency_report import ConsistencyReport, consistency_report
from ...estimator.decisions import Decision
from ...estimator.error_frames import ErrorFrame
from ...estimator.time_average_decisions import EQUIVALENCE_MARGIN
from .scores import (
    POINT_FREEDOM,
    POSE_FREEDOM,
    Array,
    EstimatorScores,
    estimators_of,
    labels_of,
    scores_of,
    start_heading_std,
)
from .verdict import heading_sentence, judge, verdict_sentence

_BOOTSTRAP_SEED = 0  # the same for each estimator: its figures do not hang on others


def summarise_monte_carlo(
    dataset: xr.Dataset, *, frame: ErrorFrame = "invariant"
) -> dict[str, Any]:
    """Gather what one wants to know of many runs.

    Every number is finite; what is unknown is None.  The same results give the same
    summary.  Failed runs are counted and named, and left out of all else, as is step 0,
    a scan before any motion.

    Parameters
    ----------
    dataset : xarray.Dataset
        Results of ``monte_carlo``.
    frame : {"invariant", "additive"}
        Error coordinates of the decisions.

    Returns
    -------
    dict
        ``scenario`` (its name), ``scenario_toml``, ``assumed_toml`` (whose noise the
        estimators were told, None where the same), ``seed``, ``runs``, ``steps``,
        ``versions``, ``command``; ``frame``; ``knowable_heading_std`` [rad], the
        deviation of the heading at the start, below which it cannot fall; and
        ``estimators`` by label, see :func:`summarise_estimator`.
    """
    attrs = dataset.attrs
    assumed = attrs.get("assumed", attrs["scenario"])
    known = estimators_of(dataset)
    knowable = start_heading_std(dataset)
    return {
        "scenario": str(attrs["scenario_name"]),
        "scenario_toml": str(attrs["scenario"]),
        "assumed_toml": None if assumed == attrs["scenario"] else str(assumed),
        "seed": int(attrs["seed"]),
        "runs": dataset.sizes["run"],
        "steps": dataset.sizes["step"] - 1,
        "versions": json.loads(attrs.get("versions", "{}")),
        "command": str(attrs.get("command", "")),
        "frame": frame,
        "knowable_heading_std": knowable,
        "estimators": {
            label: known.get(label, {})
            | summarise_estimator(scores_of(dataset, label, frame), frame, knowable)
            for label in labels_of(dataset)
        },
    }


def summarise_estimator(
    scores: EstimatorScores, frame: ErrorFrame, knowable: float
) -> dict[str, Any]:
    """Sum up one estimator's runs.

    Averages and root mean squares (``rmse``, deviations) are over runs and steps unless
    they say ``end``.  NEES and NIS are divided by their degrees of freedom: 1
    is right.

    Parameters
    ----------
    scores : EstimatorScores
        Its results.
    frame : {"invariant", "additive"}
        Error coordinates of the decisions.
    knowable : float
        Deviation of the heading at the start [rad].

    Returns
    -------
    dict
        ``verdict`` with ``reason``, ``sentence`` and ``heading_sentence``; ``accepted``
        and ``decisions`` (None where fewer than 2 runs did not fail), ``sentences``,
        ``warnings``; ``good_runs``, ``failed_runs``; by frame ``pose_nees`` and its
        share of steps inside the 95 % band, and ``position_nees``;
        ``heading_nees``; ``median_run`` and ``share_above_3`` of the runs' averages;
        NEES at the end of ``state``, ``landmarks`` and ``relative_map``; ``nis``;
        ``heading_std_end``, ``{claimed, true}`` [rad]; ``rmse`` of position [m] and
        heading [rad]; ``ate`` and ``landmark_rmse``, ``{raw, aligned}`` [m];
        ``landmark_mahalanobis``, root mean square; ``area`` of the 3σ ellipses at the
        end [m²].
    """
    report = _decide(scores, frame)
    failed = len(scores.failures)
    verdict = judge(report, failed, len(scores.good))
    heading = _heading_std_end(scores)
    per_run = scores.ratios(frame).mean(axis=1)
    return {
        "verdict": verdict.word,
        "reason": verdict.reason,
        "sentence": verdict_sentence(scores.label, verdict),
        "heading_sentence": heading_sentence(heading["claimed"], knowable),
        "accepted": None if report is None else report.accepted,
        "decisions": None if report is None else decisions_table(report),
        "sentences": [] if report is None else list(report.sentences()),
        "warnings": [] if report is None else list(report.warnings()),
        "good_runs": int(scores.good.sum()),
        "failed_runs": [failure._asdict() for failure in scores.failures],
        "pose_nees": {name: _nees(scores, name) for name in ("invariant", "additive")},
        "position_nees": {
            name: _mean(scores.over_time(f"position_nees_{name}") / POINT_FREEDOM)
            for name in ("invariant", "additive")
        },
        "median_run": _finite(np.median(per_run) if len(per_run) else np.nan),
        "share_above_3": _mean(per_run > POSE_FREEDOM),
        "heading_nees": {
            "mean": _mean(scores.over_time("heading_nees")),
            "end": _mean(scores.over_time("heading_nees")[:, -1]),
        },
        "nees_end": _nees_at_the_end(scores, frame),
        "nis": _nis(scores),
        "heading_std_end": heading,
        "rmse": {
            "position": _rms(scores.over_time("position_error")),
            "position_end": _rms(scores.over_time("position_error")[:, -1]),
            "heading": _rms(scores.over_time("heading_error")),
        },
        "ate": _raw_and_aligned(scores, "ate"),
        "landmark_rmse": _raw_and_aligned(scores, "landmark_rmse"),
        "landmark_mahalanobis": _rms(scores.per_run("landmark_mahalanobis")),
        "area": {
            "pose": _mean(scores.per_run("pose_area")),
            "landmark": _mean(scores.per_run("landmark_area")),
        },
    }


def decisions_table(report: ConsistencyReport) -> dict[str, Any]:
    """Write a report's decisions as plain JSON types.

    Returns
    -------
    dict
        ``final_step``, ``time_average``, ``bootstrap``, ``nis``, ``whiteness``, each
        ``{statistic, interval, p_value, accepted, error_rate}`` with the interval that
        is accepted; ``grid``, with ``steps``, ``rejected`` and one ``statistic`` per
        step; ``equivalence``, whose 90 % ``interval`` must lie inside ``margin``;
        ``runs_needed`` to find covariances too small by a factor in 90 % of cases.
    """
    grid, equivalence = report.family, report.equivalence
    return {
        "final_step": _decision(report.final_step),
        "time_average": _decision(report.time_average),
        "bootstrap": _decision(report.bootstrap),
        "grid": {
            "steps": (report.family_steps + 1).tolist(),  # it has not seen step 0
            "statistic": [_finite(value) for value in grid.statistic],
            "interval": list(grid.interval),
            "p_value": grid.p_value,
            "rejected": grid.rejected.tolist(),
            "accepted": bool(grid.accepted),
            "error_rate": grid.error_rate,
        },
        "nis": _decision(report.nis),
        "whiteness": _decision(report.whiteness),
        "equivalence": {
            "statistic": _finite(equivalence.statistic),
            "interval": [_finite(end) for end in equivalence.interval],
            "margin": list(EQUIVALENCE_MARGIN),
            "verdict": equivalence.verdict,
            "accepted": equivalence.accepted,
            "error_rate": equivalence.error_rate,
        },
        "runs_needed": {f"{factor:g}": runs for factor, runs in report.runs_needed},
    }


def consistency_of(
    results: xr.Dataset, estimator: str, *, frame: ErrorFrame = "invariant"
) -> ConsistencyReport:
    """Decide whether an estimator's covariances tell the truth about its errors.

    Parameters
    ----------
    results : xarray.Dataset
        Of ``monte_carlo``.
    estimator : str
        Its label.
    frame : {"invariant", "additive"}
        Error coordinates of the NEES.

    Raises
    ------
    ValueError
        If there is no such label, or fewer than 2 runs did not fail.

    Examples
    --------
    >>> from slamgym.experiments.monte_carlo import monte_carlo
    >>> results = monte_carlo("six_landmarks", "ekf,invariant", runs=60)
    >>> [consistency_of(results, label).accepted for label in ("ekf", "invariant")]
    [False, True]
    """
    if estimator not in labels_of(results):
        known = ", ".join(labels_of(results))
        raise ValueError(f"estimator must be one of {known}, got '{estimator}'")
    return _report_of(scores_of(results, estimator, frame), frame)


def _decide(scores: EstimatorScores, frame: ErrorFrame) -> ConsistencyReport | None:
    """Decide on the runs that did not fail, where these are enough."""
    freedom = scores.results["nis_dof"].values[:, 1:]
    if scores.good.sum() < 2 or not freedom[scores.good].any():
        return None
    return _report_of(scores, frame)


def _report_of(scores: EstimatorScores, frame: ErrorFrame) -> ConsistencyReport:
    nees = scores.results[f"pose_nees_{frame}"].values[:, 1:].copy()
    nees[~scores.good] = np.nan
    return consistency_report(
        nees,
        scores.results["nis"].values[:, 1:],
        scores.results["nis_dof"].values[:, 1:],
        dof=POSE_FREEDOM,
        frame=frame,
        rng=np.random.default_rng(_BOOTSTRAP_SEED),
    )


def _decision(decision: Decision) -> dict[str, Any]:
    return {
        "statistic": _finite(decision.statistic),
        "interval": [_finite(end) for end in decision.interval],
        "p_value": _finite(decision.p_value),
        "accepted": bool(decision.accepted),
        "error_rate": decision.error_rate,
    }


def _nees(scores: EstimatorScores, frame: ErrorFrame) -> dict[str, float | None]:
    ratios = scores.ratios(frame)
    if not len(ratios):
        return {"mean": None, "end": None, "share_inside_band": None}
    average = ratios.mean(axis=0)
    low, high = np.array(average_band(len(ratios), POSE_FREEDOM)) / POSE_FREEDOM
    return {
        "mean": _mean(average),
        "end": _finite(average[-1]),
        "share_inside_band": _mean((average > low) & (average < high)),
    }


def _nees_at_the_end(
    scores: EstimatorScores, frame: ErrorFrame
) -> dict[str, float | None]:
    """Divide NEES of maps by their degrees of freedom, which hang on what was seen."""
    state = scores.per_run(f"state_nees_{frame}")
    relative = scores.per_run("relative_map_nees")
    each = scores.per_run(f"landmark_nees_{frame}")
    return {
        "state": _quotient(state, scores.per_run("state_dof")),
        "landmarks": _quotient(each, np.full(each.shape, POINT_FREEDOM)),
        "relative_map": _quotient(relative, scores.per_run("relative_map_dof")),
    }


def _nis(scores: EstimatorScores) -> float | None:
    freedom = scores.over_time("nis_dof")
    return _quotient(np.where(freedom > 0, scores.over_time("nis"), 0.0), freedom)


def _heading_std_end(scores: EstimatorScores) -> dict[str, float | None]:
    return {
        "claimed": _rms(scores.over_time("heading_std")[:, -1]),
        "true": _rms(scores.over_time("heading_error")[:, -1]),
    }


def _raw_and_aligned(scores: EstimatorScores, name: str) -> dict[str, float | None]:
    return {
        "raw": _rms(scores.per_run(name)),
        "aligned": _rms(scores.per_run(f"{name}_aligned")),
    }


def _quotient(values: Array, freedom: Array) -> float | None:
    """Divide sums, over entries that are known."""
    known = np.isfinite(values)
    total = freedom[known].sum()
    return _finite(values[known].sum() / total) if total else None


def _mean(values: Array) -> float | None:
    """Average over entries that are known."""
    known = np.asarray(values)[np.isfinite(values)]
    return _finite(known.mean()) if len(known) else None


def _rms(values: Array) -> float | None:
    with np.errstate(over="ignore"):
        square = _mean(np.asarray(values) ** 2)
    return None if square is None else math.sqrt(square)


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
