"""Smooth a log: filter it, then estimate all its poses and landmarks at once."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import count
from os import PathLike
from typing import Any, overload

import numpy as np

from ... import __version__
from ...arrays import Array, IntArray
from ...estimator.interface import SlamEstimator, SmoothedPath
from ...estimator.smoother import (
    Drive,
    Reassociation,
    SmoothedDrive,
    SmoothingSlam,
    reassociate,
)
from ...estimator.smoother import smooth as smooth_drive
from ...estimator.smoother.batch_smoother import smooth_repaired, smoother_in
from ...estimator.smoother.drive import Sightings
from ...evaluation import nees
from ..logs.ground_truth import path_accuracy, true_landmarks_of, true_poses_of
from ..logs.recording import predictions_until
from ..logs.slamlog import SlamLog
from . import summary
from .filter_settings import (
    SMOOTHER,
    FilterSettings,
    given_log,
    noise_or_assumed,
    one_blas_thread,
    settings_for,
)
from .log_replay import Progress, Replay, replay
from .trace import accuracy_of, finite


@dataclass(frozen=True, eq=False)
class SmoothedLog:
    """A log, filtered and smoothed."""

    #: The filter's run, whose associations the smoother has.
    filtered: Replay
    #: All poses at scans and all landmarks, given the whole log.
    drive: SmoothedDrive
    #: The pose after every step of the log, shape (K + 1, 3) [m, m, rad].
    poses: Array
    #: Step of each pose of the drive, shape (N,).
    scan_steps: IntArray

    #: The repaired association, if that was asked for.
    repair: Reassociation | None = None

    @property
    def log(self) -> SlamLog:
        """The log."""
        return self.filtered.log


@overload
def smooth(
    drive: Drive,
    settings: None = None,
    *,
    associate: bool = False,
    **options: Any,  # of the drive alone
) -> SmoothedDrive: ...


@overload
def smooth(
    drive: SlamLog | str | PathLike[str],
    settings: FilterSettings | None = None,
    *,
    associate: bool = False,
) -> SmoothedLog: ...


def smooth(
    drive: Drive | SlamLog | str | PathLike[str],
    settings: FilterSettings | None = None,
    *,
    associate: bool = False,
    **options: Any,
) -> SmoothedDrive | SmoothedLog:
    """Smooth a drive, a log, or the file of a log, as ``slamgym smooth`` does.

    Parameters
    ----------
    drive : Drive, SlamLog or path
        A drive goes to :func:`slamgym.estimator.smooth`, a log to `smooth_log`.
    settings : FilterSettings, optional
        Settings for a log, see `smooth_log`.
    associate : bool
        Whether the whole drive repairs the associations.
    **options
        Options for a drive, see :func:`slamgym.estimator.smooth`.

    Raises
    ------
    TypeError
        If `drive` is none of these, or an option belongs to the other kind.

    Examples
    --------
    >>> drive = Drive(motion_std=(0.1, 0.1, 0.05), measurement_std=(0.02, 0.1))
    >>> drive.update([(0.0, 5.0)], [7])
    >>> drive.predict((2.0, 0.0))
    >>> drive.update([(0.0, 3.2)], [7])
    >>> np.round(smooth(drive).poses[-1], 3)
    array([1.933, 0.   , 0.   ])
    """
    if not isinstance(drive, SlamLog | str | PathLike):
        if settings is not None:
            raise TypeError("settings must be None for a drive, which has a noise")
        return smooth_drive(drive, associate=associate, **options)
    if options:
        raise TypeError(
            f"a log takes no options of a drive, got {', '.join(options)}: give "
            "settings=settings_for(log, estimator='smoother', options={...})"
        )
    return smooth_log(drive, settings, associate=associate)


def smooth_log(
    log: SlamLog | str | PathLike[str],
    settings: FilterSettings | None = None,
    *,
    associate: bool = False,
    progress: Progress | None = None,
    repairing: Progress | None = None,
) -> SmoothedLog:
    """Filter a log, and smooth it with the associations of the filter.

    Parameters
    ----------
    log : SlamLog or path
        The log.
    settings : FilterSettings, optional
        Of `SMOOTHER`; by ``management`` it associates readings without identity. By
        default with the noise in the log, or an assumed one.
    associate : bool
        Whether to repair the associations of the filter by the whole drive, see
        `reassociate`.
    progress, repairing : callable, optional
        Called with (steps done, steps) of the filter, and of the repair.

    Raises
    ------
    ValueError
        If the log has no scan, the filter refuses a reading, or it reports no
        associations to repair.
    numpy.linalg.LinAlgError
        If the smoother does not converge.
    """
    log = given_log(log)
    if settings is None:
        stds: dict[str, Any] = {**noise_or_assumed(log, {})}
        settings = settings_for(log, estimator=SMOOTHER, **stds)
    slam = settings.make(log.start)
    if smoother_in(slam) is None:
        raise ValueError(f"estimator '{settings.estimator}' does not smooth")
    followed = str(settings.options.get("follow", "invariant"))
    filtered = replay(log, slam, name=followed, progress=progress)
    if not filtered.scans:
        raise ValueError(
            f"{log.name} holds no scan: without readings of landmarks there is nothing "
            "to smooth"
        )
    smoother = smoother_in(slam)  # of the hypothesis that is the best one now
    repair: Reassociation | None = None
    drive: SmoothedPath | None = None
    readings = predictions_until(log)
    with one_blas_thread():
        recorder = getattr(slam, "filter", slam)
        if associate and isinstance(recorder, SmoothingSlam):
            whole = _with_all_readings(recorder.recorded(), log, slam)
            ends = np.searchsorted(readings, whole.readings_until, side="right") - 1
            repair = reassociate(
                whole,
                start=filtered.trace.poses[ends],
                progress=repairing or (lambda done, steps: None),
            )
            if repair.changed:
                drive = smooth_repaired(repair, **recorder.kernel)
        if drive is None and smoother is not None:
            drive = smoother.smoothed()
    if not isinstance(drive, SmoothedDrive):
        raise ValueError(f"estimator '{settings.estimator}' is not slamgym's smoother")
    scan_steps = np.searchsorted(readings, drive.readings_until).astype(np.int64)
    return SmoothedLog(filtered, drive, drive.path[readings], scan_steps, repair)


def _with_all_readings(drive: Drive, log: SlamLog, slam: SlamEstimator) -> Drive:
    """Return a drive with the filter's associations of all readings of a log.

    Readings that it has given to no landmark get an identity of their own.
    """
    made = getattr(slam, "decisions", None)
    scans = [scan.measurements for scan in log.scans]
    if made is None or len(made) != len(scans) or len(drive.scans) != len(scans):
        raise ValueError(
            "the filter reports no associations: set its option management"
        )
    own = count(
        1 + max((i for m in made for i in m.row_ids if i is not None), default=0)
    )
    sightings = []
    for z, decided in zip(scans, made, strict=True):
        ids = [next(own) if i is None else i for i in decided.row_ids]
        near = z[:, 1] >= drive.rules.min_range
        sightings.append(Sightings(z[near], np.array(ids, dtype=np.int64)[near]))
    return drive.with_scans(sightings)


def summarise_smoothing(
    smoothed: SmoothedLog, settings: FilterSettings | None = None
) -> dict[str, Any]:
    """Summarise a smoothed log.

    Returns
    -------
    dict
        ``log``, ``follows``, the name of the filter, ``settings``, ``slamgym``;
        ``steps`` and ``scans`` of the log; ``poses``, ``readings`` and ``landmarks``
        that were smoothed; ``cost``, half the sum of squares, at the ``first`` and the
        last estimate and ``per_degree`` (1 is expected without a robust kernel);
        ``iterations``; ``repair``: the scores ``first`` and ``last`` of the
        association, its ``landmarks`` and ``unused`` readings, or None;
        ``ate``, ``landmark_rmse`` and ``nees`` (of the pose), each
        of ``filter`` and ``smoother``, None if the truth is unknown; ``warnings``, see
        `exchange_warnings`.
    """
    log, trace, drive = smoothed.log, smoothed.filtered.trace, smoothed.drive
    path = trace.t, smoothed.poses
    truth = true_landmarks_of(log, drive.landmark_ids, drive.landmarks, path)
    return {
        "slamgym": __version__,
        "log": log.name,
        "follows": trace.estimator,
        "settings": None if settings is None else summary.settings_table(settings),
        "steps": trace.last_step,
        "scans": smoothed.filtered.scans,
        "poses": len(drive.poses),
        "readings": drive.readings,
        "landmarks": len(drive.landmarks),
        "cost": {
            "first": finite(drive.first_cost),
            "last": finite(drive.cost),
            "per_degree": finite(drive.cost_per_degree),
        },
        "iterations": drive.iterations,
        "repair": _repair_table(smoothed),
        "ate": {
            "filter": summary.rmse_table(path_accuracy(log, trace.t, trace.poses)),
            "smoother": summary.rmse_table(path_accuracy(log, *path)),
        },
        "landmark_rmse": {
            "filter": summary.rmse_table(summary.map_accuracy(trace)),
            "smoother": summary.rmse_table(accuracy_of(drive.landmarks, truth)),
        },
        "nees": {"filter": summary.nees_summary(trace), "smoother": _nees(smoothed)},
        "warnings": summary.exchange_warnings(
            log, drive.landmark_ids, drive.landmarks, truth
        ),
    }


def _repair_table(smoothed: SmoothedLog) -> dict[str, Any] | None:
    found = smoothed.repair
    if found is None:
        return None
    return {
        "first": finite(found.first_score),
        "last": finite(found.score),
        "landmarks": len(found.drive.landmark_ids),
        "unused": int((np.concatenate(found.ids) < 0).sum()),
    }


def _nees(smoothed: SmoothedLog) -> dict[str, Any] | None:
    """Summarise the NEES of the poses at the scans, in the invariant frame."""
    truth = true_poses_of(smoothed.log, smoothed.filtered.trace.t[smoothed.scan_steps])
    if truth is None:
        return None
    drive, known = smoothed.drive, np.isfinite(truth).all(axis=1)
    if not known.any():
        return None
    poses, covariances = drive.poses[known], drive.pose_covariances[known]
    values = nees.pose_nees(truth[known], poses, covariances, frame="invariant")
    return summary.nees_table(values, "invariant")
