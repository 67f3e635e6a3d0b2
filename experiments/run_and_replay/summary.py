"""Summarise a run as one dictionary of plain JSON types: `summarise`.

`run_warnings` lists what is suspicious about a run. Only `exchange_warnings` needs the
truth.
"""

import json
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ... import __version__
from ...arrays import Array
from ...estimator.models.bearing_range import wrap_angle
from ...estimator.models.rigid_motion import ErrorFrame, rotation
from ...estimator.models.sensors import BEARING_RANGE, DELAYED
from ...evaluation import nees
from ...evaluation.association_scores import oracle_errors, places_of
from ...evaluation.hypothesis_tests import chi_square_quantile
from ...evaluation.trajectory_error import (
    Alignment,
    PositionAccuracy,
    exchanged_positions,
)
from ..logs import ground_truth
from ..logs.slamlog import SlamLog
from .filter_settings import FilterSettings
from .log_replay import Replay
from .trace import Integers, RunTrace, accuracy_of, compare_association, finite

_SHARE = 0.95  # probability of the interval of the NIS


def summarise(
    replay: Replay, settings: FilterSettings | None = None, *, resolution: float = 0.0
) -> dict[str, Any]:
    """Summarise a run.

    Every number is finite; values that need missing ground truth are None.

    Parameters
    ----------
    replay : Replay
        The run.
    settings : FilterSettings, optional
        Settings of its estimator, to be included.
    resolution : float
        True landmarks nearer to each other count as one place [m], in ``association``.

    Returns
    -------
    dict
        ``landmarks``, see :func:`landmark_table`; ``aligned_landmarks``, the same with
        distances after alignment, where the start of the log is not the true one, else
        None; ``never_placed``, the ids of
        landmarks that the log names and the map never held; ``pose``,
        ``pose_covariance``; ``steps``, ``scans``; ``readings``, counted by their
        outcome; ``map_changes``, the numbers of landmarks confirmed, removed and
        merged, and the largest size of the map; ``nis``, see `nis_summary`; ``nees``,
        see `nees_summary`; ``ate``, the root mean square distance of the path from the
        truth at the times of the truth, and ``landmark_rmse``, that of the map, both
        ``{raw, aligned}`` [m]; ``association``, see `association_summary`;
        ``probably_lost``, whether the filter reports that it is probably lost (None
        where identities are known); ``warnings``, see `run_warnings`; ``log``,
        ``estimator``, ``settings``, and ``slamgym``, the version.
    """
    log, trace = replay.log, replay.trace
    return {
        "slamgym": __version__,
        "log": log.name,
        "estimator": trace.estimator,
        "settings": None if settings is None else settings_table(settings),
        "steps": trace.last_step,
        "scans": replay.scans,
        "readings": replay.readings._asdict(),
        "map_changes": replay.changes._asdict(),
        "pose": _finite_list(trace.poses[-1]),
        "pose_covariance": [_finite_list(row) for row in trace.pose_covariances[-1]],
        "landmarks": landmark_table(trace),
        "aligned_landmarks": _aligned_landmarks(replay),
        "never_placed": never_placed(replay),
        "nis": nis_summary(trace),
        "nees": nees_summary(trace),
        "ate": rmse_table(ground_truth.path_accuracy(log, trace.t, trace.poses)),
        "landmark_rmse": rmse_table(map_accuracy(trace)),
        "association": association_summary(replay, resolution, settings),
        "probably_lost": replay.probably_lost,
        "warnings": run_warnings(replay, settings),
    }


def association_summary(
    replay: Replay, resolution: float, settings: FilterSettings | None = None
) -> dict[str, Any] | None:
    """Summarise how well readings without identity were associated.

    Returns
    -------
    dict or None
        ``correct``, ``wrong``, ``new_correct``, ``duplicate``, ``ghost``, ``missed``,
        ``clutter_used``, ``map_size`` and ``true_map_size``, numbers of
        :class:`~slamgym.evaluation.AssociationScores`; ``precision`` and ``recall``;
        ``oracle_errors``, the share of readings that even the true pose and map would
        assign wrongly under the noise of the settings;
        the ``resolution`` [m]; ``gospa`` of the map, ``raw`` and ``aligned``, with
        their parts, see :class:`~slamgym.evaluation.Gospa`, and the ``cutoff`` [m].
        Without true ids, all entries except ``gospa`` are None, and ``gospa`` compares
        the map with all true landmarks.  The result is None if all readings have
        identities, or the true landmarks are unknown.
    """
    log, trace = replay.log, replay.trace
    if not ground_truth.hides_identities(log) or not len(log.landmarks):
        return None
    found = compare_association(
        replay.decisions,
        ground_truth.TrueLandmarks(log.landmark_ids, log.landmarks),
        trace.landmarks,
        trace.true_landmarks,
        resolution=resolution,
    ).as_dict()
    return found | {"oracle_errors": _oracle_errors(log, resolution, settings)}


def _oracle_errors(
    log: SlamLog, resolution: float, settings: FilterSettings | None
) -> float | None:
    """Return :func:`~slamgym.evaluation.oracle_errors`; None without noise or truth."""
    poses = ground_truth.true_poses_of(log, np.array([scan.t for scan in log.scans]))
    true_ids = [
        ids for scan in log.scans if (ids := ground_truth.true_ids_of(scan)) is not None
    ]
    if settings is None or poses is None or len(true_ids) < len(log.scans):
        return None
    share = oracle_errors(
        poses,
        [scan.measurements for scan in log.scans],
        true_ids,
        log.landmark_ids,
        log.landmarks,
        settings.measurement_std,
        sensor=settings.sensor,
        places=places_of(log.landmark_ids, log.landmarks, resolution),
    )
    return finite(share)


def never_placed(replay: Replay) -> list[int]:
    """List the landmarks that the readings of a log name, but the map never held."""
    if ground_truth.hides_identities(replay.log):
        return []
    held = {*replay.last_seen, *replay.trace.landmark_ids.tolist()}
    return sorted(replay.log.read_ids - held)


def landmark_table(
    trace: RunTrace, alignment: Alignment | None = None
) -> list[dict[str, Any]]:
    """List the final landmarks and their distances to the truth.

    ::

        e = l − l_true,    euclidean = ‖e‖,    mahalanobis = sqrt(eᵀ P⁻¹ e)

    Parameters
    ----------
    trace : RunTrace
        The run.
    alignment : Alignment, optional
        A motion of the map before it is compared: e = C l + c − l_true, and C P Cᵀ
        replaces P.

    Returns
    -------
    list of dict
        ``{id, x, y, euclidean, mahalanobis}`` [m, m, m, -] in the order of the state;
        the distances are None if the truth is unknown, and the last one also where
        the covariance is singular.
    """
    truth = trace.true_landmarks
    landmarks, covariances = trace.landmarks, trace.landmark_covariances
    if alignment is not None:
        turn = rotation(alignment.angle)
        landmarks, covariances = alignment.apply(landmarks), turn @ covariances @ turn.T
    errors = landmarks - (np.nan if truth is None else truth)
    squared = nees.normalised_squared_error(errors, covariances)
    return [
        {
            "id": landmark_id,
            "x": finite(x),
            "y": finite(y),
            "euclidean": finite(math.hypot(*error)),
            "mahalanobis": finite(math.sqrt(square)),
        }
        for landmark_id, (x, y), error, square in zip(
            trace.landmark_ids.tolist(), trace.landmarks, errors, squared, strict=True
        )
    ]


def _aligned_landmarks(replay: Replay) -> list[dict[str, Any]] | None:
    """List landmarks with aligned distances where the start is not the true one."""
    trace = replay.trace
    if trace.true_landmarks is None or ground_truth.starts_at_truth(replay.log):
        return None
    known = np.isfinite(trace.true_landmarks).all(axis=1)
    pairs = trace.landmarks[known], trace.true_landmarks[known]
    return landmark_table(trace, exchanged_positions(*pairs).alignment)


def nis_summary(trace: RunTrace) -> dict[str, Any] | None:
    """Summarise the normalised innovations squared, ν S⁻¹ ν of whole scans.

    Returns
    -------
    dict or None
        ``mean`` over the ``scans`` that corrected something; ``total`` and its
        ``degrees_of_freedom``, and their quotient ``per_degree``, near 1 for a
        consistent filter; ``inside_95``, the share of scans within the two-sided 95 %
        interval of χ². None if no scan corrected anything.
    """
    used = trace.nis_dof > 0
    if not used.any():
        return None
    nis, dof = trace.nis[used], trace.nis_dof[used]
    tail = (1 - _SHARE) / 2
    inside = (nis >= chi_square_quantile(tail, dof)) & (
        nis <= chi_square_quantile(1 - tail, dof)
    )
    return {
        "mean": finite(nis.mean()),
        "total": finite(nis.sum()),
        "degrees_of_freedom": int(dof.sum()),
        "per_degree": finite(nis.sum() / dof.sum()),
        "inside_95": finite(inside.mean()),
        "scans": int(used.sum()),
    }


def nees_summary(trace: RunTrace) -> dict[str, Any] | None:
    """Summarise the normalised estimation error squared of the pose.

    Returns
    -------
    dict or None
        ``mean`` over the ``steps`` where it is defined, ``final`` at the last step
        (None where undefined), ``degrees_of_freedom`` 3, ``per_degree``, the mean by 3,
        near 1 for a consistent filter, and the ``frame`` of the error, which is the
        filter's own; ``singular``, the number of poses without a NEES because their
        covariance is singular, if there are any besides those known exactly.  None if
        no pose has a truth, or all are known exactly.
    """
    values = pose_nees(trace)
    table = nees_table(values, trace.frame)
    lost = 0
    if trace.true_poses is not None:
        is_uncertain = trace.pose_covariances.any(axis=(1, 2))
        is_known = np.isfinite(trace.true_poses).all(axis=1)
        lost = int((is_known & is_uncertain & ~np.isfinite(values)).sum())
    if table is None and not lost:
        return None
    if table is None:
        none = dict.fromkeys(("mean", "per_degree"))
        table = {"degrees_of_freedom": 3, "steps": 0, "frame": trace.frame, **none}
    singular = {"singular": lost} if lost else {}
    return {"mean": table["mean"], "final": finite(values[-1]), **table, **singular}


def nees_table(values: Array, frame: ErrorFrame) -> dict[str, Any] | None:
    """Summarise NEES of the pose (K,) as `nees_summary`, without the final step."""
    known = values[np.isfinite(values)]
    if not len(known):
        return None
    return {
        "mean": finite(known.mean()),
        "degrees_of_freedom": 3,
        "per_degree": finite(known.mean() / 3),
        "steps": len(known),
        "frame": frame,
    }


def pose_nees(trace: RunTrace) -> Array:
    """Return the NEES of the pose at every step, in the error frame of the filter.

    Returns
    -------
    ndarray, shape (K + 1,)
        nan where the true pose is unknown or P is singular, as at a certain start.
    """
    if trace.true_poses is None:
        return np.full(len(trace.t), np.nan)
    with np.errstate(invalid="ignore"):  # nan if the truth is unknown
        return nees.pose_nees(
            trace.true_poses, trace.poses, trace.pose_covariances, frame=trace.frame
        )


def map_accuracy(trace: RunTrace) -> PositionAccuracy | None:
    """Compare the final map with the truth; None if it is unknown."""
    return accuracy_of(trace.landmarks, trace.true_landmarks)


def settings_table(settings: FilterSettings) -> dict[str, Any]:
    """Write an estimator's settings as plain JSON types."""
    return {
        "motion_std": list(settings.motion_std),
        "measurement_std": list(settings.measurement_std),
        "initial_pose_std": list(settings.initial_pose_std),
        "options": {key: _plain(value) for key, value in settings.options.items()},
    }


def _plain(value: Any) -> Any:
    """Return a value as it is if JSON can represent it, else as text."""
    try:
        json.dumps(value, allow_nan=False)
    except (TypeError, ValueError):
        return str(value)
    return value


def rmse_table(accuracy: PositionAccuracy | None) -> dict[str, float | None] | None:
    """Return root mean squares ``{raw, aligned}`` [m]; None if the truth is unknown."""
    if accuracy is None:
        return None
    return {"raw": finite(accuracy.raw_rmse), "aligned": finite(accuracy.aligned_rmse)}


def _finite_list(values: Array) -> list[float | None]:
    return [finite(value) for value in values]


#: Share of rejected readings above which a filter may diverge.
MOST_REJECTED = 0.05

#: NIS per degree of freedom that causes no warning.
NIS_RANGE = (0.5, 2.0)

#: Largest time between two rows of odometry, relative to the median.
LONG_GAP = 30.0

#: A landmark within reach in this many scans should be in one of them.
MANY_SCANS = 10

#: Share of landmarks that scans no longer show above which a map may be split.
MOST_ABANDONED = 0.25


#: The warning about a filter that is probably lost.
LOST = (
    "The run is probably lost: the scans showed far fewer landmarks than the map "
    "promised, readings fitted nothing, or the heading became unknown."
)


def association_failure(summary: Mapping[str, Any]) -> str:
    """Write why the association of a run failed, by the alarm or the truth; or "".

    By the truth, it failed if a filter that knew pose and map would assign at least
    `MOST_REJECTED` more of the readings rightly.

    Parameters
    ----------
    summary : mapping
        Of `summarise`.
    """
    scores = summary["association"] or {}
    precision, wrong = scores.get("precision"), scores.get("oracle_errors") or 0.0
    if precision is not None and 1 - precision > wrong + MOST_REJECTED:
        return (
            f"{1 - precision:.1%} of the assigned readings have a wrong landmark; "
            f"with known pose and map, {wrong:.1%} would"
        )
    return "the filter is probably lost" if summary["probably_lost"] else ""


def run_warnings(replay: Replay, settings: FilterSettings | None = None) -> list[str]:
    """List what is suspicious about a run.

    Parameters
    ----------
    replay : Replay
        The run.
    settings : FilterSettings, optional
        Settings of its estimator.

    Returns
    -------
    list of str
        Sentences of one line.
    """
    found = [LOST * bool(replay.probably_lost)]
    found += [_rejections(replay), _nis(replay), _crowded_map(replay)]
    found += [_coarse(replay.log, settings), _gap(replay)]
    trace = replay.trace
    found += exchange_warnings(
        replay.log, trace.landmark_ids, trace.landmarks, trace.true_landmarks
    )
    return [sentence for sentence in found if sentence]


def exchange_warnings(
    log: SlamLog, ids: Sequence[int] | Integers, landmarks: Array, truth: Array | None
) -> list[str]:
    """Name landmarks of a final map that fit each other's true position.

    Parameters
    ----------
    log : SlamLog
        The log; without identities the ids are the filter's own, and none is named.
    ids : sequence of int
        Ids of the landmarks.
    landmarks, truth : ndarray, shape (n, 2)
        Their estimated and true positions [m], nan where unknown; no truth is None.

    Returns
    -------
    list of str
        One sentence for each cycle of `exchanged_positions`.
    """
    if truth is None or ground_truth.hides_identities(log):
        return []
    known = np.isfinite(truth).all(axis=1)
    names = np.asarray(ids)[known].tolist()
    found = exchanged_positions(landmarks[known], truth[known]).cycles
    return [_exchange([names[k] for k in cycle]) for cycle in found]


def _exchange(ids: Sequence[int]) -> str:
    """Write which landmarks fit each other's truth, and the remedy.

    Examples
    --------
    >>> _exchange([11, 17])
    "Landmarks 11 and 17 fit each other's true position: exchange the ids of their ..."
    >>> _exchange([3, 5, 8])
    'Landmarks 3, 5 and 8 fit the true positions of 5, 8 and 3: the rows ...'
    """
    others = [*ids[1:], ids[0]]
    rows = [f"`landmark,{i},…`" for i in others]
    if len(ids) == 2:
        return (
            f"Landmarks {_listed(ids)} fit each other's true position: exchange the "
            f"ids of their rows {_listed(rows[::-1])} in the file of the truth."
        )
    return (
        f"Landmarks {_listed(ids)} fit the true positions of {_listed(others)}: the "
        f"rows {_listed(rows)} in the file of the truth need the ids {_listed(ids)}."
    )


def _listed(items: Sequence[object]) -> str:
    *most, last = map(str, items)
    return f"{', '.join(most)} and {last}"


def _rejections(replay: Replay) -> str:
    counts = replay.readings
    tested = counts.associated + counts.rejected
    if not tested or counts.rejected <= MOST_REJECTED * tested:
        return ""
    return (
        f"The gate rejects {counts.rejected / tested:.0%} of the readings of mapped "
        "landmarks: the filter may have diverged, or assume too little noise."
    )


def _nis(replay: Replay) -> str:
    trace = replay.trace
    freedom = trace.nis_dof.sum()
    if not freedom:
        return ""
    nis = np.where(trace.nis_dof > 0, trace.nis, 0.0)
    total = float(nis.sum())
    ratio = total / freedom
    low, high = NIS_RANGE
    if low <= ratio <= high:
        return ""
    worst = int(nis.argmax())
    rest = freedom - trace.nis_dof[worst]
    if ratio > high and rest and nis[worst] > total / 2:
        without = (total - nis[worst]) / rest
        return (
            f"The NIS is {ratio:.3g} per degree of freedom, where 1 is expected, and "
            f"{without:.3g} without the scan at {_at(trace, worst)}: one of its "
            "readings is probably wrong."
        )
    associates = ground_truth.hides_identities(replay.log)
    return f"The {nis_suspicion(ratio, associates=associates)}"


def nis_suspicion(ratio: float, *, associates: bool) -> str:
    """Write what a NIS per degree of freedom far from 1 means.

    Parameters
    ----------
    ratio : float
        NIS per degree of freedom.
    associates : bool
        Whether the filter associates readings without identity.

    Examples
    --------
    >>> nis_suspicion(3.0, associates=False)
    'NIS is 3 per degree of freedom, where 1 is expected: the filter assumes too ...
    """
    amount = "too much" if ratio < 1 else "too little"
    other = ", or associates wrongly" * associates
    return (
        f"NIS is {ratio:.3g} per degree of freedom, where 1 is expected: the filter "
        f"assumes {amount} noise{other}."
    )


def _at(trace: RunTrace, step: int) -> str:
    return f"t = {round(trace.t[step], 3):.15g}" + " s" * (trace.time_unit == "s")


def _gap(replay: Replay) -> str:
    trace = replay.trace
    spans = np.diff(trace.t)
    lasting = spans[spans > 0]
    if not len(lasting) or lasting.max() <= LONG_GAP * np.median(lasting):
        return ""
    step = int(spans.argmax())
    return (
        f"The log has no odometry between {_at(trace, step)} and "
        f"{_at(trace, step + 1)}: how the robot moved there is not known."
    )


def _coarse(log: SlamLog, settings: FilterSettings | None) -> str:
    readings = [scan.measurements for scan in log.scans if len(scan.measurements)]
    if settings is None or settings.sensor != BEARING_RANGE or not readings:
        return ""
    if settings.options.get("landmark_init") == DELAYED:
        return ""
    distance = float(np.median(np.concatenate(readings)[:, 1]))
    std = settings.sensor.stds(settings.measurement_std, distance)
    return coarse_suspicion(float(std[0]), float(std[1]), distance)


def coarse_suspicion(bearing_std: float, range_std: float, distance: float) -> str:
    """Write whether bearings are too coarse beside fine ranges.

    A reading with the noise (σβ, σr) at the range r lies on an arc, which is r σβ²/2
    away from its tangent at one σβ.  A filter that places a landmark by one reading
    takes the tangent for the arc, and is overconfident where this exceeds σr.

    Parameters
    ----------
    bearing_std, range_std : float
        σβ [rad] and σr [m].
    distance : float
        r [m].

    Examples
    --------
    >>> coarse_suspicion(0.3, 0.1, 5.0)
    'A bearing error of σβ = 0.3 rad moves a reading at 5 m by 0.225 m off its ...
    >>> coarse_suspicion(0.1, 0.1, 5.0)
    ''
    """
    off = distance * bearing_std**2 / 2
    if off <= range_std:
        return ""
    return (
        f"A bearing error of σβ = {bearing_std:g} rad moves a reading at "
        f"{distance:.3g} m by {off:.3g} m off its tangent, but σr is {range_std:.3g} "
        "m. Filters that place a landmark by one reading are overconfident. With "
        "landmark_init=delayed, filters of slamgym wait for several readings."
    )


def _crowded_map(replay: Replay) -> str:
    size, abandoned = len(replay.trace.landmark_ids), abandoned_landmarks(replay)
    if not size or abandoned <= MOST_ABANDONED * size:
        return ""
    return (
        f"{abandoned} of the {size} landmarks in the map should have been seen again, "
        "but were not: the map may hold landmarks twice."
    )


def abandoned_landmarks(replay: Replay) -> int:
    """Count landmarks of the final map that scans no longer show.

    A landmark is abandoned if it was within the sensor's reach in `MANY_SCANS` scans
    since its last reading.  The reach is that of three quarters of all readings, and
    their widest bearing to either side but for 5 %.  Where all readings have
    identities, or the sensor is another, no landmark is.
    """
    log, trace = replay.log, replay.trace
    scans = log.scans
    if not scans or not ground_truth.hides_identities(log) or "sensor" in log.header:
        return 0
    bearings, ranges = np.concatenate([scan.measurements for scan in scans]).T
    reach = np.quantile(ranges, 0.75)
    width = np.quantile(np.abs(wrap_angle(bearings)), 0.95)
    last = np.array([replay.last_seen.get(i, -1) for i in trace.landmark_ids.tolist()])
    steps = np.searchsorted(trace.t, [scan.t for scan in scans], "right") - 1
    in_view = np.zeros(len(last), dtype=np.int64)
    for step in steps.tolist():
        x, y, heading = trace.poses[step]
        dx, dy = (trace.landmarks - (x, y)).T
        bearing = wrap_angle(np.arctan2(dy, dx) - heading)
        is_near = (np.hypot(dx, dy) <= reach) & (np.abs(bearing) <= width)
        in_view += is_near & (step > last)
    return int((in_view >= MANY_SCANS).sum())
