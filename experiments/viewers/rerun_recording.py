"""Write a run of one or more filters as a recording for the viewer rerun."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ...arrays import Array
from ...envs.rendering.render_state import drawn_readings
from ...sim_configs.scenario_files import replace_when_written
from ..logs.recording import steps_of
from ..logs.slamlog import SlamLog
from ..run_and_replay.summary import pose_nees
from . import run_page as run_frames
from .run_page import ViewedRun, map_at, shown_steps

SIGMAS = 3
_COLOURS = ([0, 114, 178], [230, 159, 0], [0, 158, 115], [204, 121, 167])  # Okabe, Ito
_GREY, _ALARM = [128, 128, 128], [213, 94, 0]
_GOOD = {run_frames.OUTCOMES.index(name) for name in ("used", "new")}


def import_rerun() -> Any:
    """Return the module ``rerun``.

    Raises
    ------
    ImportError
        If it is not installed.
    """
    try:
        import rerun  # noqa: PLC0415 (optional, and slow to import)
    except ImportError:
        raise ImportError(
            "a recording for rerun needs rerun-sdk: pip install 'slamgym[viewer]'"
        ) from None
    return rerun


def write_rerun(
    path: str | Path,
    log: SlamLog,
    runs: Sequence[ViewedRun],
    *,
    walls: Iterable[Sequence[float]] = (),
) -> None:
    """Write what :func:`write_run_page` shows as a recording, to open with ``rerun``.

    The recording holds the world in the plane z = 0, each filter below ``world`` under
    its name, NEES by 3 and NIS by its degrees of freedom below ``plots``, and matrices
    of the correlations below ``correlations``.

    Parameters
    ----------
    path : str or Path
        The .rrd file; its folder must exist.
    log : SlamLog
        The log.
    runs : sequence of ViewedRun
        Its replays, at least one.
    walls : iterable of (x0, y0, x1, y1)
        Walls of the world [m].

    Raises
    ------
    ImportError
        If rerun-sdk is not installed.
    FileNotFoundError
        If the folder does not exist.
    """
    rerun = import_rerun()
    with replace_when_written(path) as partial:
        recording = rerun.RecordingStream("slamgym")
        recording.save(partial)
        recording.send_recording_name(log.name)
        recording.log("world", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        _log_world(rerun, recording, log, walls)
        kind = log.header.get("sensor", "bearing_range")
        scans = [
            None if step.scan is None else drawn_readings(kind, step.scan.measurements)
            for step in steps_of(log)
        ]
        steps = shown_steps([run.frames for run in runs])
        for number, run in enumerate(runs):
            colour = _COLOURS[number % len(_COLOURS)]
            _Writer(recording, scans, run, colour).write(steps)
        recording.flush()
        recording.disconnect()


def _log_world(
    rerun: Any, recording: Any, log: SlamLog, walls: Iterable[Sequence[float]]
) -> None:
    """Log what does not move: landmarks, walls, and the true path."""
    lines = [_raised(np.reshape(wall, (2, 2))) for wall in walls]
    recording.log("world/walls", rerun.LineStrips3D(lines, colors=_GREY), static=True)
    labels = [str(i) for i in log.landmark_ids]
    points = rerun.Points3D(
        _raised(log.landmarks), labels=labels, colors=_GREY, show_labels=False
    )
    recording.log("world/truth/landmarks", points, static=True)
    path = rerun.LineStrips3D([_raised(log.ground_truth[:, 1:3])], colors=_GREY)
    recording.log("world/truth/path", path, static=True)


class _Writer:
    """Log one filter's run."""

    def __init__(
        self, recording: Any, scans: Sequence[Array | None], run: ViewedRun, colour: Any
    ) -> None:
        self._rerun, self._recording, self._run = import_rerun(), recording, run
        self._scans, self._colour, self._log = scans, colour, recording.log
        self._name = self._rerun.escape_entity_path_part(run.trace.estimator)

    def write(self, steps: Sequence[int]) -> None:
        """Log the kept steps."""
        trace = self._run.trace
        nees = pose_nees(trace) / 3
        for step in steps:
            self._recording.set_time("step", sequence=step)
            if trace.time_unit == "s":
                self._recording.set_time("time", duration=float(trace.t[step]))
            self._log_truth(step)
            self._log_belief(step)
            self._log_readings(step)
            self._log_correlations(step)
            self._log_value("nees", nees[step])
            if trace.nis_dof[step]:
                self._log_value("nis", trace.nis[step] / trace.nis_dof[step])

    def _log_truth(self, step: int) -> None:
        truth = self._run.trace.true_poses
        if truth is not None and np.isfinite(truth[step]).all():
            self._log("world/truth/robot", self._arrow(truth[step], _GREY))

    def _log_belief(self, step: int) -> None:
        trace, place = self._run.trace, f"world/{self._name}"
        pose, covariance = trace.poses[step], trace.pose_covariances[step]
        self._log(f"{place}/robot", self._arrow(pose, self._colour))
        path = self._rerun.LineStrips3D(
            [_raised(trace.poses[max(step - 1, 0) : step + 1, :2])], colors=self._colour
        )
        self._log(f"{place}/motion", path)
        own = self._ellipses(pose[None, :2], covariance[None, :2, :2], ["robot"])
        self._log(f"{place}/robot/ellipse", own)
        frame = map_at(self._run, step)
        labels = [str(i) for i in frame.ids]
        landmarks = self._ellipses(frame.means, frame.covariances, labels)
        self._log(f"{place}/landmarks", landmarks)

    def _log_readings(self, step: int) -> None:
        scan, frame = self._scans[step], map_at(self._run, step)
        pose = self._run.trace.poses[step]
        readings = np.empty((0, 2)) if scan is None else scan
        angles = pose[2] + readings[:, 0]
        directions = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        ends = pose[:2] + readings[:, 1:] * directions
        lines = [_raised(np.stack([pose[:2], end])) for end in ends]
        colours = [self._colour if code in _GOOD else _ALARM for code in frame.outcomes]
        labels = [run_frames.OUTCOMES[code] for code in frame.outcomes]
        strips = self._rerun.LineStrips3D(
            lines, colors=colours or None, labels=labels or None, show_labels=False
        )
        self._log(f"world/{self._name}/readings", strips)

    def _log_correlations(self, step: int) -> None:
        found = self._run.frames.correlations.get(step)
        if found is None or not len(found.ids):
            return
        size = len(found.ids) + 1
        matrix = np.eye(size, dtype=np.float32)
        matrix[np.tril_indices(size, -1)] = found.values
        matrix = np.maximum(matrix, matrix.T)
        self._log(f"correlations/{self._name}", self._rerun.Tensor(matrix))

    def _log_value(self, kind: str, value: float) -> None:
        if np.isfinite(value):
            self._log(f"plots/{kind}/{self._name}", self._rerun.Scalars(float(value)))

    def _arrow(self, pose: Array, colour: Any) -> Any:
        direction = [np.cos(pose[2]), np.sin(pose[2]), 0.0]
        return self._rerun.Arrows3D(
            origins=_raised(pose[None, :2]), vectors=[direction], colors=colour
        )

    def _ellipses(self, means: Array, covariances: Array, labels: Sequence[str]) -> Any:
        variances, axes = np.linalg.eigh(np.nan_to_num(covariances))
        half = SIGMAS * np.sqrt(np.maximum(variances, 0.0))
        angles = np.arctan2(axes[:, 1, 0], axes[:, 0, 0])  # of the first half axis
        turns = np.stack([0 * angles, 0 * angles, np.sin(angles / 2)], axis=1)
        return self._rerun.Ellipsoids3D(
            centers=_raised(means),
            half_sizes=_raised(half),
            quaternions=np.column_stack([turns, np.cos(angles / 2)]),
            colors=[self._colour] * len(means),
            labels=list(labels),
            show_labels=False,
        )


def _raised(points: Array) -> Array:
    """Put points (n, 2) into the plane z = 0."""
    return np.column_stack([points, np.zeros(len(points))])
