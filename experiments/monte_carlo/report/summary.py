"""Summarise a Monte Carlo as one dictionary of plain JSON types."""

import json
from typing import Any

import numpy as np
import xarray as xr

from ....estimator.models.rigid_motion import ErrorFrame
from ....evaluation.consistency_report import ConsistencyReport, evaluate_consistency
from ....evaluation.hypothesis_tests import average_band
from ...runs.nan_statistics import finite, mean, quotient, root_mean_square
from ..measure.association_measures import KNOWN_IDS_ATE
from .association import association_summary
from .decision_entries import decisions_table
from .diagnosis import diagnosis_summary
from .efficiency import efficiency_summary
from .scores import (
    POINT_FREEDOM,
    POSE_FREEDOM,
    EstimatorScores,
    estimators_of,
    labels_of,
    scores_of,
    start_heading_std,
)
from .verdict import heading_sentence, judge, verdict_sentence
from .warnings import failure_groups, run_warnings

_BOOTSTRAP_SEED = 0  # the same for each estimator, independent of the others
_FRAMES: tuple[ErrorFrame, ...] = ("invariant", "additive")


def summarise_monte_carlo(
    dataset: xr.Dataset, *, frame: ErrorFrame = "invariant"
) -> dict[str, Any]:
    """Summarise the results of many runs.

    Every number is finite; unknown values are None. The same results give the same
    summary. Failed runs are counted and named, and excluded from everything else, as is
    step 0, a scan before any motion.

    Parameters
    ----------
    dataset : xarray.Dataset
        Results of ``monte_carlo``.
    frame : {"invariant", "additive"}
        Error coordinates of the decisions.

    Returns
    -------
    dict
        ``scenario`` (its name), ``scenario_toml``, ``assumed_toml`` (the scenario whose
        noise the estimators assume, None where the same), ``seed``, ``runs``,
        ``first_run`` (number of the first of them), ``steps``, ``block_size`` (None
        where unknown), ``resolution`` (of places in scores of association) [m],
        ``versions``, ``command``; ``frame``; ``knowable_heading_std`` [rad], the
        deviation of the heading at the start, below which it cannot fall;
        ``estimators`` by label, see `summarise_estimator`; and ``notes``, the
        warnings of `run_warnings`.
    """
    attrs = dataset.attrs
    assumed = attrs.get("assumed", attrs["scenario"])
    known = estimators_of(dataset)
    knowable = start_heading_std(dataset)
    entries = {
        label: known.get(label, {})
        | summarise_estimator(scores_of(dataset, label, frame), frame, knowable)
        for label in labels_of(dataset)
    }
    block_size = attrs.get("block_size")
    return {
        "scenario": str(attrs["scenario_name"]),
        "scenario_toml": str(attrs["scenario"]),
        "assumed_toml": None if assumed == attrs["scenario"] else str(assumed),
        "seed": int(attrs["seed"]),
        "runs": dataset.sizes["run"],
        "first_run": int(dataset["run"].values[0]),
        "steps": dataset.sizes["step"] - 1,
        "block_size": None if block_size is None else int(block_size),
        "resolution": float(attrs.get("resolution", 0.0)),
        "versions": json.loads(attrs.get("versions", "{}")),
        "command": str(attrs.get("command", "")),
        "frame": frame,
        "knowable_heading_std": knowable,
        "estimators": entries,
        "notes": run_warnings(entries, dataset.sizes["run"]),
    }


def summarise_estimator(
    scores: EstimatorScores, frame: ErrorFrame, knowable: float
) -> dict[str, Any]:
    """Summarise the runs of one estimator.

    Averages and root mean squares (``rmse``, deviations) are over runs and steps, or
    over runs for keys with ``end``. NEES and NIS are divided by their degrees of
    freedom: 1 is expected.

    Parameters
    ----------
    scores : EstimatorScores
        Results of the estimator.
    frame : {"invariant", "additive"}
        Error coordinates of the decisions.
    knowable : float
        Deviation of the heading at the start [rad].

    Returns
    -------
    dict
        ``verdict`` with ``reason``, ``sentence`` and ``heading_sentence``; ``accepted``
        and ``decisions`` (None if fewer than 2 runs succeeded), ``sentences``,
        ``warnings``; ``good_runs``, ``failed_runs``, ``failure_groups`` (see
        :func:`.warnings.failure_groups`); by frame ``pose_nees`` and its
        share of steps inside the 95 % band, and ``position_nees``;
        ``heading_nees``; ``median_run`` and ``share_above_3`` of the runs' averages;
        NEES at the end of ``state``, ``landmarks`` and ``relative_map``; ``nis``;
        ``heading_std_end``, ``{claimed, true}`` [rad]; ``rmse`` of position [m] and
        heading [rad]; ``ate`` and ``landmark_rmse``, ``{raw, aligned}`` [m];
        ``landmark_mahalanobis``, root mean square; ``area`` of the 3σ ellipses at the
        end [m²]; ``efficiency``, see :func:`.efficiency.efficiency_summary`;
        ``diagnosis``, see :func:`.diagnosis.diagnosis_summary`;
        ``association``, see :func:`.association.association_summary`;
        ``unused_readings``, the share of readings of known identity that corrected
        nothing and added no landmark, None where identities are hidden.
    """
    heading = _heading_std_end(scores)
    per_run = scores.ratios(frame).mean(axis=1)
    return {
        **_verdict(scores, _decide(scores, frame), heading["claimed"], knowable),
        "good_runs": int(scores.good.sum()),
        "failed_runs": [failure._asdict() for failure in scores.failures],
        "failure_groups": failure_groups(scores.failures),
        "pose_nees": {name: _nees(scores, name) for name in _FRAMES},
        "position_nees": {
            name: mean(scores.over_time(f"position_nees_{name}") / POINT_FREEDOM)
            for name in _FRAMES
        },
        "median_run": finite(np.median(per_run) if len(per_run) else np.nan),
        "share_above_3": mean(per_run > POSE_FREEDOM),
        "heading_nees": {
            "mean": mean(scores.over_time("heading_nees")),
            "end": mean(scores.over_time("heading_nees")[:, -1]),
        },
        "nees_end": _nees_at_the_end(scores, frame),
        "nis": scores.nis_per_degree,
        "heading_std_end": heading,
        "rmse": {
            "position": root_mean_square(scores.over_time("position_error")),
            "position_end": root_mean_square(scores.over_time("position_error")[:, -1]),
            "heading": root_mean_square(scores.over_time("heading_error")),
        },
        "ate": _raw_and_aligned(scores, "ate"),
        "landmark_rmse": _raw_and_aligned(scores, "landmark_rmse"),
        "landmark_mahalanobis": root_mean_square(
            scores.per_run("landmark_mahalanobis")
        ),
        "area": {
            "pose": mean(scores.per_run("pose_area")),
            "landmark": mean(scores.per_run("landmark_area")),
        },
        "efficiency": efficiency_summary(scores),
        "diagnosis": diagnosis_summary(scores, frame),
        "association": association_summary(scores),
        "unused_readings": _unused_readings(scores),
    }


def _verdict(
    scores: EstimatorScores,
    report: ConsistencyReport | None,
    heading_std: float | None,
    knowable: float,
) -> dict[str, Any]:
    """Write the verdict on an estimator, and the decisions behind it."""
    verdict = judge(report, len(scores.failures), len(scores.good))
    return {
        "verdict": verdict.word,
        "reason": verdict.reason,
        "sentence": verdict_sentence(scores.label, verdict),
        "heading_sentence": heading_sentence(heading_std, knowable),
        "accepted": None if report is None else report.accepted,
        "decisions": None if report is None else decisions_table(report),
        "sentences": [] if report is None else list(report.sentences()),
        "warnings": [] if report is None else list(report.warnings()),
    }


def consistency_of(
    results: xr.Dataset, estimator: str, *, frame: ErrorFrame = "invariant"
) -> ConsistencyReport:
    """Decide whether an estimator's covariances agree with its errors.

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
        If there is no such label, or fewer than 2 runs succeeded.

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
    """Test the successful runs, if there are enough."""
    if scores.good.sum() < 2:
        return None
    return _report_of(scores, frame)


def _report_of(scores: EstimatorScores, frame: ErrorFrame) -> ConsistencyReport:
    nees = scores.results[f"pose_nees_{frame}"].values[:, 1:].copy()
    nees[~scores.good] = np.nan
    return evaluate_consistency(
        nees,
        scores.results["nis"].values[:, 1:],
        scores.results["nis_dof"].values[:, 1:],
        dof=POSE_FREEDOM,
        frame=frame,
        rng=np.random.default_rng(_BOOTSTRAP_SEED),
    )


def _nees(scores: EstimatorScores, frame: ErrorFrame) -> dict[str, float | None]:
    ratios = scores.ratios(frame)
    if not len(ratios):
        return {"mean": None, "end": None, "share_inside_band": None}
    average = ratios.mean(axis=0)
    low, high = np.array(average_band(len(ratios), POSE_FREEDOM)) / POSE_FREEDOM
    return {
        "mean": mean(average),
        "end": finite(average[-1]),
        "share_inside_band": mean((average > low) & (average < high)),
    }


def _nees_at_the_end(
    scores: EstimatorScores, frame: ErrorFrame
) -> dict[str, float | None]:
    """Divide NEES of maps by their degrees of freedom, which depend on the map."""
    state = scores.per_run(f"state_nees_{frame}")
    relative = scores.per_run("relative_map_nees")
    each = scores.per_run(f"landmark_nees_{frame}")
    return {
        "state": quotient(state, scores.per_run("state_dof")),
        "landmarks": quotient(each, np.full(each.shape, POINT_FREEDOM)),
        "relative_map": quotient(relative, scores.per_run("relative_map_dof")),
    }


def _unused_readings(scores: EstimatorScores) -> float | None:
    """Divide the readings that a gate or the least range rejected by all readings."""
    if KNOWN_IDS_ATE in scores.results:
        return None
    corrected = scores.per_run("nis_dof").sum(axis=1) / 2
    added = scores.per_run("relative_map_dof") / 2
    readings = scores.per_run("readings")
    return quotient(readings - corrected - added, readings)


def _heading_std_end(scores: EstimatorScores) -> dict[str, float | None]:
    return {
        "claimed": root_mean_square(scores.over_time("heading_std")[:, -1]),
        "true": root_mean_square(scores.over_time("heading_error")[:, -1]),
    }


def _raw_and_aligned(scores: EstimatorScores, name: str) -> dict[str, float | None]:
    return {
        "raw": root_mean_square(scores.per_run(name)),
        "aligned": root_mean_square(scores.per_run(f"{name}_aligned")),
    }
