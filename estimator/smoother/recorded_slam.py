"""A filter that records its drive, with the associations that it decided on."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import ArrayLike

from ... import argument_checks
from .. import interface
from ..filters.pose_readings import PoseReading
from ..guards import saved_states
from ..guards.interrupts import changing
from ..map_management.map_editor import MapEditor
from ..models.motions import UNICYCLE, Motion
from ..models.sensors import Sensor
from ..registry import accepted_options, find_estimator, make_estimator, read_label
from .batch_smoother import SmoothedDrive, robust_kernel, smooth
from .drive import Drive

HISTORY = "recorded_events"


class Event(NamedTuple):
    """One event of a drive, after all those before it."""

    before: Event | None
    name: str  # method of :class:`Drive` that takes it in
    arguments: tuple[Any, ...]


class RecordedSlam(interface.FilterWrapper):
    """A filter that also records its drive, for the smoother.

    The drive receives the readings that the filter used.  Landmarks that the filter
    merged are one landmark in the drive, and landmarks that it removed are not in it.
    With landmark management around this filter, the drive has the associations of the
    management, including those of landmarks that are confirmed later.

    Parameters
    ----------
    slam : SlamEstimator
        The filter, at its start.
    **noise
        The keywords of :class:`Drive`.

    Examples
    --------
    >>> from slamgym.estimator import InvariantEkfSlam, smooth
    >>> noise = {"motion_std": (0.1, 0.1, 0.05), "measurement_std": (0.02, 0.1)}
    >>> slam = RecordedSlam(InvariantEkfSlam(**noise), **noise)
    >>> _ = slam.update([(0.0, 5.0)], [7])
    >>> slam.predict((2.0, 0.0))
    >>> _ = slam.update([(0.0, 3.2)], [7])
    >>> smooth(slam.recorded()).landmarks.round(3)
    array([[5.067, 0.   ]])
    """

    def __init__(self, slam: interface.SlamEstimator, **noise: Any) -> None:
        # It refuses what it cannot smooth.
        self._columns = Drive(**noise).sensor.columns
        self._slam, self._noise = slam, noise
        self._editor = MapEditor(slam)
        self._last: Event | None = None
        #: Number of steps taken.
        self.steps = 0
        self._report = interface.UpdateReport()

    @property
    def inside(self) -> interface.SlamEstimator:
        """The filter, which only this recorder may change."""
        return self._slam

    def recorded(self) -> Drive:
        """Return the drive until now; its last pose is the present one."""
        drive = Drive(**self._noise)
        for event in self._events():
            getattr(drive, event.name)(*event.arguments)
        drive.end_motion()
        return drive

    def reset(self, pose: ArrayLike, pose_std: ArrayLike) -> None:
        """Start a new run and a new drive, at a pose (3,) known to (3,) [m, m, rad]."""
        with changing(self, "reset", anew=True):
            self._slam.reset(pose, pose_std)
            first, std = np.array(pose, dtype=float), np.array(pose_std, dtype=float)
            self._last = Event(None, "start_at", (first, std))
            self._report = interface.UpdateReport()

    def predict(self, odometry: ArrayLike, dt: float = 1.0) -> None:
        """Move by odometry (d, α) [m, rad]; dt multiplies the noise variance."""
        motion = argument_checks.pair("odometry", odometry)
        with changing(self, "predict"):
            self._slam.predict(motion, dt)
            self.steps += 1
            self._record("predict", motion, dt)

    def update(
        self, measurements: ArrayLike, landmark_ids: Sequence[int] | None = None
    ) -> interface.UpdateReport:
        """Update the filter with one scan, and record the readings that it used."""
        with changing(self, "update"):
            report = self._slam.update(measurements, landmark_ids)
            self.steps += 1
            decided = report.row_ids or (() if landmark_ids is None else landmark_ids)
            unused = {*report.rejected_ids, *report.skipped_ids, None}
            used = {row: i for row, i in enumerate(decided) if i not in unused}
            readings = argument_checks.scan(measurements, self._columns)
            self._record("update", readings[list(used)], list(used.values()))
            for kept, gone in report.merged_ids:
                self._record("merge", kept, gone)
            if report.removed_ids:
                self._record("forget", report.removed_ids)
            self._report = report
        return report

    def observe_pose(
        self, reading: ArrayLike, matrix: ArrayLike, covariance: ArrayLike
    ) -> interface.UpdateReport:
        """Update the filter with a reading of the pose, and record it if it is used."""
        given = PoseReading.checked(reading, matrix, covariance)
        with changing(self, "observe_pose"):
            report = interface.taking_poses(self._slam).observe_pose(*given)
            self.steps += 1
            if report.degrees_of_freedom:
                self._record("observe_pose", *given)
            self._report = report
        return cast(interface.UpdateReport, report)

    def remove(self, landmark_ids: Sequence[int]) -> None:
        """Marginalise landmarks, and drop their readings from the drive."""
        with changing(self, "remove"):
            self._editor.remove(landmark_ids)
            self._record("forget", tuple(landmark_ids))

    def merge(self, kept: int, gone: int) -> None:
        """Merge two landmarks, in the filter and in the drive."""
        self.merge_pairs([(kept, gone)])

    def merge_pairs(self, pairs: Sequence[tuple[int, int]]) -> None:
        """Merge pairs (kept, gone) of landmarks, in the filter and in the drive."""
        with changing(self, "merge"):
            self._editor.merge_pairs(pairs)
            for kept, gone in pairs:
                self._record("merge", kept, gone)

    @property
    def _inside(self) -> interface.SlamEstimator:
        self.refuse_interrupted()
        return self._slam

    def state_dict(self) -> dict[str, Any]:
        """Return the filter's state, and the events until now as one object.

        The object is of this process, so that a state takes no time that grows with the
        drive; `numpy.load` refuses it.
        """
        self.refuse_interrupted()
        history = np.empty((), dtype=object)
        history[()] = self._last
        return self._slam.state_dict() | {HISTORY: history}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a saved state of this process, with its drive.

        Raises
        ------
        ValueError
            If the state holds no drive, or the filter refuses it.
        """
        saved_states.refuse_other_state(state, [HISTORY])
        if not _is_history(history := state[HISTORY]):
            raise ValueError(
                f"state['{HISTORY}'] must be the events of a drive, got {history!r}"
            )
        self._load(state, self._slam.load_state_dict)

    def restore(self, state: Mapping[str, Any]) -> None:
        """Continue from a state that this process has saved, without checks."""
        self._load(state, partial(interface.restore, self._slam))

    def _load(
        self, state: Mapping[str, Any], load: Callable[[Mapping[str, Any]], None]
    ) -> None:
        with changing(self, "load_state_dict", anew=True):
            load(state)
            self._last, self._report = state[HISTORY].item(), interface.UpdateReport()

    def snapshot(self) -> tuple[Any, Event | None, interface.UpdateReport]:
        """Return the present state for :meth:`resume`."""
        self.refuse_interrupted()
        return interface.snapshot(self._slam), self._last, self._report

    def resume(self, before: tuple[Any, Event | None, interface.UpdateReport]) -> None:
        """Return to a :meth:`snapshot` of a recorder with the same settings."""
        with changing(self, "resume", anew=True):
            interface.resume(self._slam, before[0])
            _, self._last, self._report = before

    def report(self) -> interface.UpdateReport:
        """Return the report of the last update once more."""
        self.refuse_interrupted()
        return self._report

    def __repr__(self) -> str:
        return f"Recorded {self._slam!r}"

    def _record(self, name: str, *arguments: Any) -> None:
        self._last = Event(self._last, name, arguments)

    def _events(self) -> Iterator[Event]:
        """Yield the events in their order."""
        self.refuse_interrupted()
        events: list[Event] = []
        event = self._last
        while event is not None:
            events.append(event)
            event = event.before
        yield from reversed(events)


def _is_history(saved: Any) -> bool:
    """Return whether a saved value is the last event of a drive, or none."""
    is_one = isinstance(saved, np.ndarray) and saved.dtype == object and not saved.shape
    return is_one and isinstance(saved.item(), Event | None)


class SmoothingSlam(RecordedSlam):
    """A filter that records its drive, and smooths it at the end.

    During the drive, its beliefs are those of the filter. :meth:`smoothed` returns the
    beliefs about all poses given the whole drive, and experiments use these instead.

    Parameters
    ----------
    motion_std, measurement_std, initial_pose, initial_pose_std
        As every filter takes them.
    follow : str
        The filter, by a name that :func:`~slamgym.estimator.make_estimator` takes.
        Options in brackets override the keywords.
    robust, robust_scale
        As in `batch_smoother.smooth`.
    sensor, motion, noise_at_rest, min_range
        As in :class:`Drive`; the filter gets those that it takes.
    **options
        Further options of the filter.

    Raises
    ------
    ValueError
        If an argument is refused.
    TypeError
        If the filter does not take an option.
    """

    def __init__(
        self,
        motion_std: ArrayLike,
        measurement_std: ArrayLike,
        *,
        follow: str = "invariant",
        robust: str | None = None,
        robust_scale: float | None = None,
        initial_pose: ArrayLike = (0.0, 0.0, 0.0),
        initial_pose_std: ArrayLike = (0.0, 0.0, 0.0),
        sensor: str | Sensor = "bearing_range",
        noise_at_rest: bool = True,
        min_range: float = 1e-3,
        motion: str | Motion = UNICYCLE,
        **options: Any,
    ) -> None:
        noise: dict[str, Any] = {
            "motion_std": motion_std,
            "measurement_std": measurement_std,
            "initial_pose": initial_pose,
            "initial_pose_std": initial_pose_std,
        }
        name, own = read_label(follow)
        settings: dict[str, Any] = {
            "sensor": sensor,
            "noise_at_rest": noise_at_rest,
            "min_range": min_range,
            "motion": motion,
        }
        settings |= {key: own.pop(key) for key in settings if key in own}
        options |= own
        robust_kernel(robust, robust_scale)
        taken = accepted_options(find_estimator(name), settings)
        slam = make_estimator(name, **noise, **taken, **options)
        super().__init__(slam, **noise, **settings)
        #: The robust kernel, as keywords of `batch_smoother.smooth`.
        self.kernel: dict[str, Any] = {"robust": robust, "robust_scale": robust_scale}

    def smoothed(self) -> SmoothedDrive:
        """Return the beliefs about all poses, given the drive until now."""
        return smooth(self.recorded(), start=self.belief(), **self.kernel)
