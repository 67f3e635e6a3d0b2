"""Summarise a Monte Carlo as one dictionary of plain JSON types.

`summarise_monte_carlo` summarises all estimators. `consistency_of` tests one estimator;
its decisions, its efficiency and the scores of its association become entries of the
summary.
"""

import json
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from ...arrays import AnyArray, Array, BoolArray
from ...estimator.models.rigid_motion import ErrorFrame
from ...estimator.models.sensors import DELAYED
from ...evaluation.association_scores import CUTOFF, Gospa
from ...evaluation.consistency_report import ConsistencyReport
from ...evaluation.error_bound import Efficiency, efficiency
from ...evaluation.hypothesis_tests import (
    EQUIVALENCE_MARGIN,
    HypothesisTest,
    average_band,
)
from ...evaluation.map_consistency import ERROR_RATE as MAP_ERROR_RATE
from ...evaluation.map_consistency import MapReport, farthest
from ..run_and_replay.trace import finite, mean, quotient, root_mean_square
from .looks import is_sequential, looks_summary, verdict_of, watched
from .run_measures import (
    ALARM,
    COUNTS,
    KNOWN_IDS_ATE,
    MAPS,
    MARGIN,
    ORACLE,
    PREFIX,
    SHARES,
)
from .verdict import (
    FITTED,
    NEARLY,
    NOT_CONSISTENT,
    POINT_FREEDOM,
    POSE_FREEDOM,
    EstimatorScores,
    coarse_bearings,
    diagnosis_summary,
    estimators_of,
    failure_groups,
    heading_sentence,
    in_degrees,
    labels_of,
    maps_of,
    report_of,
    run_warnings,
    scores_of,
    seeds_sentence,
    start_heading_std,
    verdict_sentence,
)

_FRAMES: tuple[ErrorFrame, ...] = ("invariant", "additive")


def summarise_monte_carlo(
    dataset: xr.Dataset, *, frame: ErrorFrame | None = None
) -> dict[str, Any]:
    """Summarise the results of many runs.

    Every number is finite; unknown values are None. The same results give the same
    summary. Failed runs are counted and named, and excluded from everything else, as is
    step 0, a scan before any motion.

    Parameters
    ----------
    dataset : xarray.Dataset
        Results of ``monte_carlo``.
    frame : {"invariant", "additive"}, optional
        Error coordinates of the decisions. By default "additive" for files that
        ``judge`` read as such, and "invariant" for all others.

    Returns
    -------
    dict
        ``scenario`` (its name), ``scenario_toml``, ``assumed_toml`` (the scenario whose
        noise the estimators assume, None where the same), ``seed``, ``runs``,
        ``first_run`` (number or name of the first), ``steps``, ``block_size`` (None
        where unknown), ``resolution`` (of places in scores of association) [m],
        ``versions``, ``command``; ``until``, only for a study that was to run until it
        is decided; ``frame``; ``knowable_heading_std`` [rad], the
        deviation of the heading at the start, below which it cannot fall;
        ``estimators`` by label, see `summarise_estimator`; and ``notes``, the
        warnings of `run_warnings` and `coarse_bearings`.
    """
    attrs = dataset.attrs
    frame = frame or attrs.get("frame", "invariant")
    assumed = attrs.get("assumed", attrs["scenario"])
    known = estimators_of(dataset)
    knowable = start_heading_std(dataset)
    entries = {
        label: known.get(label, {})
        | summarise_estimator(scores_of(dataset, label, frame), frame, knowable)
        for label in labels_of(dataset)
    }
    block_size = attrs.get("block_size")
    coarse = coarse_bearings(attrs["scenario"], entries)
    return {
        "scenario": str(attrs["scenario_name"]),
        "scenario_toml": str(attrs["scenario"]),
        "assumed_toml": None if assumed == attrs["scenario"] else str(assumed),
        "seed": int(attrs["seed"]),
        "runs": dataset.sizes["run"],
        "first_run": dataset["run"].values.tolist()[0],
        "steps": dataset.sizes["step"] - 1,
        "block_size": None if block_size is None else int(block_size),
        "resolution": float(attrs.get("resolution", 0.0)),
        "versions": json.loads(attrs.get("versions", "{}")),
        "command": str(attrs.get("command", "")),
        "frame": frame,
        "knowable_heading_std": knowable,
        **({"until": str(attrs["until"])} if attrs.get("until") else {}),
        "estimators": entries,
        "notes": [
            *json.loads(attrs.get("notes", "[]")),
            *run_warnings(entries, dataset.sizes["run"]),
            *([coarse] if coarse else []),
        ],
    }


def verdict_table(results: xr.Dataset) -> Any:
    """Return verdicts, consistency and errors, one row for each estimator.

    ``to_latex`` of the table writes it for a paper.

    Parameters
    ----------
    results : xarray.Dataset
        Results of ``monte_carlo``.

    Returns
    -------
    pandas.DataFrame
        Number of successful runs, verdict, averages over runs and steps, and over runs
        at the end; NaN where unknown. NEES and NIS per degree of freedom are 1 for a
        consistent filter.

    Examples
    --------
    >>> from slamgym.experiments import monte_carlo
    >>> table = verdict_table(monte_carlo("six_landmarks", "ekf,invariant", runs=2))
    >>> list(table.index), list(table)[:3]
    (['ekf', 'invariant'], ['runs', 'verdict', 'pose NEES / 3'])
    """
    summary = summarise_monte_carlo(results)
    frame, found = summary["frame"], summary["estimators"].values()
    numbers = {
        "pose NEES / 3": [each["pose_nees"][frame]["mean"] for each in found],
        "pose NEES / 3, end": [each["pose_nees"][frame]["end"] for each in found],
        "NIS / degree": [each["nis"] for each in found],
        "position RMSE [m]": [each["rmse"]["position"] for each in found],
        "heading RMSE [rad]": [each["rmse"]["heading"] for each in found],
    }
    columns: dict[str, Any] = {
        "runs": [each["good_runs"] for each in found],
        "verdict": [each["verdict"] for each in found],
        **{name: np.array(values, dtype=float) for name, values in numbers.items()},
    }
    variables = {name: ("estimator", values) for name, values in columns.items()}
    labels = {"estimator": list(summary["estimators"])}
    return xr.Dataset(variables, labels).to_dataframe()


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
        and ``decisions`` (None if fewer than 2 runs succeeded), ``sentences``; for a
        study that grows ``sequential``, see :func:`.looks.looks_summary`;
        ``warnings``; ``good_runs``, ``failed_runs``, ``failure_groups`` (see
        :func:`.verdict.failure_groups`); by frame ``pose_nees`` and its
        share of steps inside the 95 % band, and ``position_nees``;
        ``heading_nees``; ``median_run`` and ``share_above_3`` of the runs' averages;
        NEES at the end of ``state``, ``landmarks``, ``relative_map`` and its
        ``worst_landmark``; ``nis``;
        ``heading_std_end``, ``{claimed, true}`` [rad]; ``rmse`` of position [m] and
        heading [rad]; ``ate`` and ``landmark_rmse``, ``{raw, aligned}`` [m];
        ``landmark_mahalanobis``, root mean square; ``area`` of the 3σ ellipses at the
        end [m²]; ``efficiency``, see :func:`.summary.efficiency_summary`;
        ``diagnosis``, see :func:`.verdict.diagnosis_summary`; ``seeds_sentence``, the
        seeds of runs that deserve a look;
        ``association``, see :func:`.summary.association_of_runs`;
        ``unused_readings``, the share of readings of known identity that corrected
        nothing and added no landmark, None where identities are hidden or readings of
        a sensor may wait.
    """
    found = _computed(scores, frame)
    claimed = found["heading_std_end"]["claimed"]
    decides = scores.good.sum() > 1 and not scores.is_fitted
    report = report_of(scores, frame) if decides else None
    watch = watched(scores, frame) if report and is_sequential(scores) else None
    verdict = FITTED if scores.is_fitted else verdict_of(scores, frame, watch, report)
    accepted = report and report.accepted
    sequential: dict[str, Any] = {}
    if watch is not None:
        accepted = verdict.word not in (NOT_CONSISTENT, NEARLY) and not scores.failures
        sequential["sequential"] = looks_summary(scores, watch)
    return {
        "verdict": verdict.word,
        "reason": verdict.reason,
        "sentence": verdict_sentence(scores.label, verdict),
        "heading_sentence": heading_sentence(claimed, knowable),
        "accepted": accepted,
        **sequential,
        "decisions": report and decisions_table(report),
        "sentences": list(report.sentences()) if report else [],
        "warnings": list(report.warnings()) if report else [],
        "good_runs": int(scores.good.sum()),
        "failed_runs": [failure._asdict() for failure in scores.failures],
        "failure_groups": failure_groups(scores.failures),
        **found,
        "efficiency": efficiency_summary(scores),
        "diagnosis": diagnosis_summary(
            scores, frame, verdict, report.map if report else None
        ),
        "seeds_sentence": seeds_sentence(scores, frame, _errors_of_bad_runs(scores)),
        "association": association_of_runs(scores),
        "unused_readings": _unused_readings(scores),
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
    >>> from slamgym.experiments.monte_carlo_study import monte_carlo
    >>> results = monte_carlo("six_landmarks", "ekf,invariant", runs=60)
    >>> [consistency_of(results, label).accepted for label in ("ekf", "invariant")]
    [False, True]
    """
    if estimator not in labels_of(results):
        known = ", ".join(labels_of(results))
        raise ValueError(f"estimator must be one of {known}, got '{estimator}'")
    return report_of(scores_of(results, estimator, frame), frame)


def _unused_readings(scores: EstimatorScores) -> float | None:
    """Divide the readings that a gate or the least range rejected by all readings."""
    options = estimators_of(scores.results).get(scores.label, {}).get("options") or {}
    may_wait = bool(scores.results.attrs.get("readings_may_wait"))
    may_wait |= options.get("landmark_init") == DELAYED
    if KNOWN_IDS_ATE in scores.results or may_wait:
        return None
    corrected = scores.each(lambda dof: dof.sum(axis=1), "nis_dof", begin=0) / 2
    added = scores.per_run("relative_map_dof") / 2
    readings = scores.per_run("readings")
    return quotient(readings - corrected - added, readings)


# --------------------------------------------------------------------------------------
# The measures of an estimator: each is declared once, for the summary and the tables of
# the command and the report.

Entry = dict[str, Any]
Computation = Callable[[EstimatorScores], float | None]

#: In place of a number that is unknown.
NOTHING = "–"
_LEAST_BOUND = math.radians(0.1)  # of a heading that is shown


def number(value: float) -> str:
    """Write a number with three digits.

    Examples
    --------
    >>> number(1.0), number(0.01234), number(12345.6), number(1e9)
    ('1.00', '0.0123', '12346', '1e+09')
    """
    if abs(value) >= 1e6:
        return f"{value:.0e}"
    size = math.floor(math.log10(abs(value))) if value else 0
    return f"{value:.{min(max(2 - size, 0), 6)}f}"


def percent(share: float) -> str:
    """Write a share as a percentage.

    Examples
    --------
    >>> percent(0.0), percent(0.005), percent(0.7303)
    ('0 %', '0.5 %', '73 %')
    """
    shown = 100 * share
    return f"{shown:.2g} %" if shown < 99.5 else f"{shown:.0f} %"


def share(value: float) -> str:
    """Write a share that should be 1.

    Examples
    --------
    >>> share(0.98765), share(1.0)
    ('.988', '1.000')
    """
    return f"{value:.3f}".removeprefix("0")


def _missed_and_false(found: dict[str, float | None]) -> str:
    counts = found["missed_count"], found["false_count"]
    return ", ".join(NOTHING if count is None else number(count) for count in counts)


def _alarms(found: dict[str, int]) -> str:
    """Write the alarms among bad and among other runs.

    Examples
    --------
    >>> _alarms({"count": 4, "runs": 60, "found": 3, "bad": 3})
    '3 of 3, 1 of 57'
    """
    false, others = found["count"] - found["found"], found["runs"] - found["bad"]
    return f"{found['found']} of {found['bad']}, {false} of {others}"


def _count(found: list[Any]) -> str:
    return str(len(found))


def _with_error(found: dict[str, Any]) -> str:
    """Write a number and half the width of its interval, if that is known."""
    reach = found["interval"][1]
    spread = "" if reach is None else f" ± {reach - found['value']:.2f}"
    return f"{found['value']:.2f}{spread}"


class Measure(NamedTuple):
    """A number of one estimator: its computation, and its row in tables."""

    #: Its keys in the entry of an estimator, joined by dots.
    path: str
    #: None for a part of an entry that is computed as a whole.
    compute: Computation | None = None
    #: Title of its row; tables omit a measure without one.
    name: str = ""
    #: Value of a consistent filter, or lower bound; else empty.
    right: str = ""
    write: Callable[[Any], str] = number

    def of(self, entry: Entry) -> str:
        """Write the cell of one estimator from its entry in the summary."""
        value: Any = entry
        for key in self.path.split("."):
            value = None if value is None else value[key]
        return NOTHING if value is None else self.write(value)


def _declared(frame: ErrorFrame) -> list[Measure]:
    """List all measures in the order of tables, for decisions in an error frame."""
    other: ErrorFrame = "additive" if frame == "invariant" else "invariant"
    row, root = Measure, root_mean_square
    # fmt: off
    return [
        row(f"pose_nees.{frame}.mean", _anees(frame), f"NEES / 3, {frame} frame", "1"),
        row(f"pose_nees.{frame}.end", _anees(frame, -1), "… at the end", "1"),
        *(row(f"position_nees.{name}", _position_nees(name)) for name in _FRAMES),
        row("median_run", _averages(_median, frame), "… of the median run", "≲ 1"),
        row("share_above_3", _averages(lambda each: mean(each > POSE_FREEDOM), frame),
            "… runs above 3", "few", percent),
        row(f"pose_nees.{frame}.share_inside_band", _inside_band(frame),
            "… steps in the 95 % band", "varies", percent),
        row(f"pose_nees.{other}.mean", _anees(other), f"NEES / 3, {other} frame"),
        row(f"pose_nees.{other}.end", _anees(other, -1)),
        row(f"pose_nees.{other}.share_inside_band", _inside_band(other)),
        row("heading_nees.mean", lambda scores: scores.average("heading_nees"),
            "NEES of the heading", "1"),
        row("heading_nees.end", _end(mean, "heading_nees")),
        row("nees_end.state", _by_freedom(f"state_nees_{frame}", "state_dof")),
        row("nees_end.landmarks", _by_freedom(f"landmark_nees_{frame}")),
        row("nees_end.relative_map",
            _by_freedom("relative_map_nees", "relative_map_dof"),
            "NEES of the map at the end", "1"),
        row("nees_end.worst_landmark", _worst_landmark(frame),
            "… of the worst landmark", "≈ 1"),
        row("nis", lambda scores: scores.nis_per_degree,
            "NIS / degrees of freedom", "1"),
        row("heading_std_end.claimed", _end(root, "heading_std"),
            "heading at the end, claimed", "{least}", in_degrees),
        row("heading_std_end.true", _end(root, "heading_error"),
            "… true error", "= claimed", in_degrees),
        row("rmse.position", lambda scores: scores.rms("position_error")),
        row("rmse.position_end", _end(root, "position_error")),
        row("rmse.heading", lambda scores: scores.rms("heading_error"),
            "… RMSE over all steps", "", in_degrees),
        row("efficiency.pose", None, "efficiency of the position", "≤ 1", _with_error),
        row("efficiency.heading", None,
            "efficiency of the heading", "≤ 1", _with_error),
        row("efficiency.map", None, "efficiency of the map", "≤ 1", _with_error),
        row("ate.raw", _runs(root, "ate"), "path (ATE), raw [m]"),
        row("ate.aligned", _runs(root, "ate_aligned"), "… aligned [m]"),
        row("landmark_rmse.raw", _runs(root, "landmark_rmse"),
            "landmark RMSE, raw [m]"),
        row("landmark_rmse.aligned", _runs(root, "landmark_rmse_aligned"),
            "… aligned [m]"),
        row("landmark_mahalanobis", _runs(root, "landmark_mahalanobis")),
        row("area.pose", _runs(mean, "pose_area")),
        row("area.landmark", _runs(mean, "landmark_area")),
        *(row(f"association.{path}", None, *shown) for path, *shown in _ASSOCIATION),
        row("failed_runs", None, "failed runs of {runs}", "0", _count),
    ]
    # fmt: on


#: Rows of a world that hides identities, of :func:`association_of_runs`.
_ASSOCIATION: tuple[tuple[Any, ...], ...] = (
    ("median_ate.hidden", "path (ATE), median run, raw [m]"),
    ("median_ate.known", "… with known identities [m]"),
    ("gospa.raw.distance", "GOSPA of the map, {cutoff:g} m, raw [m]"),
    ("gospa.aligned.distance", "… aligned [m]"),
    ("gospa.aligned", "… landmarks missed, false", "0, 0", _missed_and_false),
    ("map_size", "landmarks in the map", "{true_size}"),
    ("new_correct", "… new ones correct", "{true_size}"),
    ("duplicate", "… duplicates", "0"),
    ("ghost", "… of clutter", "0"),
    ("correct", "readings given right"),
    ("wrong", "… wrong", "0"),
    ("missed", "… not used", "0"),
    ("clutter_used", "… clutter used", "0"),
    ("precision", "precision", "1", share),
    ("oracle_errors", "… with true pose and map", "", lambda wrong: share(1 - wrong)),
    ("recall", "recall", "1", share),
    ("bad_runs.count", "bad runs of {runs}", "0", str),
    ("alarm", "… alarms in bad runs, in others", "all, 0", _alarms),
)


def measures(summary: dict[str, Any]) -> list[Measure]:
    """List the rows of a table that follow the verdict.

    Parameters
    ----------
    summary : dict
        Result of ``summarise_monte_carlo``.
    """
    knowable = summary["knowable_heading_std"]
    least = f"≥ {in_degrees(knowable)}" if knowable >= _LEAST_BOUND else ""
    facts = {"runs": summary["runs"], "least": least}
    scores = [entry["association"] for entry in summary["estimators"].values()]
    if None not in scores:
        size = scores[0]["true_map_size"]
        facts["true_size"] = "" if size is None else number(size)
        facts["cutoff"] = scores[0]["gospa"]["cutoff"]
    return [
        measure._replace(
            name=measure.name.format(**facts), right=measure.right.format(**facts)
        )
        for measure in _declared(summary["frame"])
        if measure.name and not (None in scores and "association" in measure.path)
    ]


def _computed(scores: EstimatorScores, frame: ErrorFrame) -> Entry:
    """Compute the measures that are not parts of a larger entry."""
    entry: Entry = {"pose_nees": {name: {} for name in _FRAMES}}
    for measure in _declared(frame):
        if measure.compute is not None:
            *keys, last = measure.path.split(".")
            place = entry
            for key in keys:
                place = place.setdefault(key, {})
            place[last] = measure.compute(scores)
    return entry


Statistic = Callable[[AnyArray], float | None]


def _end(statistic: Statistic, name: str) -> Computation:
    return lambda scores: statistic(scores.at_end(name))


def _runs(statistic: Statistic, name: str) -> Computation:
    return lambda scores: statistic(scores.per_run(name))


def _averages(statistic: Statistic, frame: ErrorFrame) -> Computation:
    """Return the computation of a statistic over the runs' averages of NEES / 3."""
    return lambda scores: statistic(scores.ratios(frame))


def _anees(frame: ErrorFrame, first: int | None = None) -> Computation:
    """Return the computation of ANEES / 3 over the steps from `first` on."""

    def compute(scores: EstimatorScores) -> float | None:
        return mean(scores.anees(frame)[first:]) if scores.good.any() else None

    return compute


def _inside_band(frame: ErrorFrame) -> Computation:
    """Return the computation of the share of steps with ANEES in its 95 % band."""

    def compute(scores: EstimatorScores) -> float | None:
        if not (runs := int(scores.good.sum())):
            return None
        average = scores.anees(frame)
        low, high = np.array(average_band(runs, POSE_FREEDOM)) / POSE_FREEDOM
        return mean((average > low) & (average < high))

    return compute


def _position_nees(frame: ErrorFrame) -> Computation:
    name = f"position_nees_{frame}"
    return lambda scores: scores.average(name, lambda nees: nees / POINT_FREEDOM)


def _by_freedom(name: str, dof: str = "") -> Computation:
    """Return the computation of a NEES at the end by its degrees of freedom."""

    def compute(scores: EstimatorScores) -> float | None:
        values = scores.per_run(name)
        freedom = scores.per_run(dof) if dof else np.full(values.shape, POINT_FREEDOM)
        return quotient(values, freedom)

    return compute


def _worst_landmark(frame: ErrorFrame) -> Computation:
    """Return the ratio of a landmark farthest from 1, from the robot or in the map."""

    def compute(scores: EstimatorScores) -> float | None:
        maps = maps_of(scores, frame)
        if maps is None or not len(maps.ratios):
            return None
        known = np.isfinite(maps.map_ratios)
        ratios = np.concatenate([maps.ratios, maps.map_ratios[known]])
        return finite(ratios[farthest(ratios)])

    return compute


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
        ``runs_needed`` to find covariances too small by a factor in 90 % of cases;
        ``rate_of_each``, the share of the error rate of final step, averages and grid;
        ``map``, None where the pose alone is tested, with its ``sentence``, the 90 %
        ``interval`` of its ratio and, for each of its ``landmarks``, the ``ratio`` seen
        from the robot, the ``map_ratio`` in the frame of the map, and the ``mean``
        error in deviations.
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
        "rate_of_each": report.deciding_rate,
        "map": report.map and _map_decision(report.map),
    }


def _map_decision(maps: MapReport) -> dict[str, Any]:
    """Return the decisions on the map as plain JSON types."""
    rows = zip(maps.landmarks, maps.ratios, maps.map_ratios, maps.means, strict=True)
    return {
        "sentence": maps.sentence(),
        "statistic": finite(maps.equivalence.statistic),
        "interval": [finite(end) for end in maps.equivalence.interval],
        "p_value": maps.p_value,
        "accepted": maps.accepted,
        "shown": maps.shown,
        "error_rate": MAP_ERROR_RATE,
        "runs": maps.runs,
        "without_nees": maps.undefined + maps.indefinite,
        "joint": maps.joint,
        "landmarks": [
            {
                "landmark": int(name),
                "ratio": finite(ratio),
                "map_ratio": finite(alone),
                "mean": mean.tolist(),
            }
            for name, ratio, alone, mean in rows
        ],
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
    bound, error = scores.per_run("map_bound"), scores.per_run("map_error_centred")
    known = np.isfinite(bound) & np.isfinite(error)
    of_the_map = efficiency(bound[known], error[known] ** 2)
    found = {"pose": None, "heading": None, "map": _entry(of_the_map)}
    if scores.nis_per_degree is None:
        return found
    for name, least, actual in (
        ("pose", "position_bound", "position_error_invariant"),
        ("heading", "heading_bound", "heading_error"),
    ):
        bound = scores.each(lambda least: least.mean(axis=1), least)
        squares = scores.each(lambda error: (error**2).mean(axis=1), actual)
        found[name] = _entry(efficiency(bound, squares))
    return found


def _entry(found: Efficiency) -> dict[str, Any] | None:
    if not np.isfinite(found.value):
        return None
    return {"value": finite(found.value), "interval": [*map(finite, found.interval)]}


def association_of_runs(scores: EstimatorScores) -> dict[str, Any] | None:
    """Summarise the association of one estimator; None where identities are known.

    Parameters
    ----------
    scores : EstimatorScores
        Results of the estimator.

    Returns
    -------
    dict or None
        Means over the runs that succeeded of ``correct``, ``wrong``,
        ``new_correct``, ``duplicate``, ``ghost``, ``missed``, ``clutter_used``,
        ``map_size``, ``true_map_size``, ``precision`` and ``recall``; None where
        the estimator reports none.  ``gospa``: ``raw`` and ``aligned`` means of
        the metric and its parts, and the ``cutoff`` [m].  ``resolution`` [m].
        ``bad_runs``: ``count`` and ``share`` of all runs, failed or more than
        ``margin`` [m] worse than with known identities.  ``median_ate``: ``hidden``
        and ``known`` [m], raw.  ``oracle_errors``, the mean share of readings that
        even the true pose and map would assign wrongly.  ``alarm``: ``count`` and
        ``share`` of the ``runs`` that report whether they are probably lost, and do;
        ``found`` of the ``bad`` ones among them; None where no run reports it.
    """
    if KNOWN_IDS_ATE not in scores.results:
        return None
    hidden, known = scores.per_run("ate"), scores.per_run(KNOWN_IDS_ATE)
    is_bad = _errors_of_bad_runs(scores) > 0
    bad = int((~scores.good).sum() + is_bad.sum())
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
        "bad_runs": {"count": bad, "share": bad / len(scores.good), "margin": MARGIN},
        "oracle_errors": mean(scores.per_run(ORACLE)),
        "alarm": _alarm(scores.per_run(ALARM), is_bad),
        "median_ate": {"hidden": _median(hidden), "known": _median(known)},
    }


def _errors_of_bad_runs(scores: EstimatorScores) -> Array:
    """Return the path error of each bad run that succeeded, 0 of others, (M,) [m]."""
    ate = scores.per_run("ate")
    if KNOWN_IDS_ATE not in scores.results:
        return np.zeros_like(ate)
    return np.where(ate > scores.per_run(KNOWN_IDS_ATE) + MARGIN, ate, 0.0)


def _alarm(raised: Array, is_bad: BoolArray) -> dict[str, Any] | None:
    known = np.isfinite(raised)
    if not known.any():
        return None
    is_raised, is_bad = raised[known] > 0, is_bad[known]
    return {
        "count": int(is_raised.sum()),
        "share": float(is_raised.mean()),
        "runs": int(known.sum()),
        "found": int((is_raised & is_bad).sum()),
        "bad": int(is_bad.sum()),
    }


def _median(values: Array) -> float | None:
    known = values[np.isfinite(values)]
    return finite(np.median(known)) if len(known) else None
