"""Summarise a Monte Carlo as one dictionary of plain JSON types.

`summarise_monte_carlo` summarises all estimators. `consistency_of` tests one estimator;
its decisions, its efficiency and the scores of its association become entries of the
summary.
"""

import json
import math
from typing import Any

import numpy as np
import xarray as xr

from ...arrays import Array
from ...estimator.models.rigid_motion import ErrorFrame
from ...evaluation.association_scores import CUTOFF, Gospa
from ...evaluation.consistency_report import ConsistencyReport, evaluate_consistency
from ...evaluation.error_bound import Efficiency, efficiency
from ...evaluation.hypothesis_tests import (
    EQUIVALENCE_MARGIN,
    HypothesisTest,
    average_band,
)
from ..runs.trace import finite, mean, quotient, root_mean_square
from .run_measures import COUNTS, KNOWN_IDS_ATE, MAPS, MARGIN, PREFIX, SHARES
from .verdict import (
    POINT_FREEDOM,
    POSE_FREEDOM,
    EstimatorScores,
    diagnosis_summary,
    estimators_of,
    failure_groups,
    heading_sentence,
    judge,
    labels_of,
    run_warnings,
    scores_of,
    start_heading_std,
    verdict_sentence,
)

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
        :func:`.verdict.failure_groups`); by frame ``pose_nees`` and its
        share of steps inside the 95 % band, and ``position_nees``;
        ``heading_nees``; ``median_run`` and ``share_above_3`` of the runs' averages;
        NEES at the end of ``state``, ``landmarks`` and ``relative_map``; ``nis``;
        ``heading_std_end``, ``{claimed, true}`` [rad]; ``rmse`` of position [m] and
        heading [rad]; ``ate`` and ``landmark_rmse``, ``{raw, aligned}`` [m];
        ``landmark_mahalanobis``, root mean square; ``area`` of the 3σ ellipses at the
        end [m²]; ``efficiency``, see :func:`.summary.efficiency_summary`;
        ``diagnosis``, see :func:`.verdict.diagnosis_summary`;
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


def decisions_table(report: ConsistencyReport) -> dict[str, Any]:
    """Return the decisions of a report as plain JSON types.

    Returns
    -------
    dict
        ``final_step``, ``time_average``, ``bootstrap``, ``nis``, ``whiteness``, each
        ``{statistic, interval, p_value, accepted, error_rate}`` with the interval that
        is accepted, all None where nothing is decided; ``grid``, with ``steps``,
        ``rejected`` and one ``statistic`` per step;
        ``equivalence``, whose 90 % ``interval`` must lie inside ``margin``;
        ``runs_needed`` to find covariances too small by a factor in 90 % of cases.
    """
    grid, equivalence = report.family, report.equivalence
    return {
        "final_step": _decision(report.final_step),
        "time_average": _decision(report.time_average),
        "bootstrap": _decision(report.bootstrap),
        "grid": {
            "steps": (report.family_steps + 1).tolist(),  # it has not seen step 0
            "statistic": [finite(value) for value in grid.statistic],
            "interval": list(grid.interval),
            "p_value": grid.p_value,
            "rejected": grid.rejected.tolist(),
            "accepted": bool(grid.accepted),
            "error_rate": grid.error_rate,
        },
        "nis": _decision(report.nis),
        "whiteness": _decision(report.whiteness),
        "equivalence": {
            "statistic": finite(equivalence.statistic),
            "interval": [finite(end) for end in equivalence.interval],
            "margin": list(EQUIVALENCE_MARGIN),
            "verdict": equivalence.verdict,
            "accepted": equivalence.accepted,
            "error_rate": equivalence.error_rate,
        },
        "runs_needed": {f"{factor:g}": runs for factor, runs in report.runs_needed},
    }


def _decision(decision: HypothesisTest) -> dict[str, Any]:
    decided = not math.isnan(decision.p_value)
    return {
        "statistic": finite(decision.statistic),
        "interval": [finite(end) for end in decision.interval],
        "p_value": finite(decision.p_value),
        "accepted": bool(decision.accepted) if decided else None,
        "error_rate": decision.error_rate,
    }


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
