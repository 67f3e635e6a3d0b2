"""The beliefs of one estimator at every step of one run, as plain arrays: `RunTrace`.

`compare_association` scores how the run associated readings without identity.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...arrays import AnyArray, Array, IntArray
from ...estimator import interface
from ...estimator.models.rigid_motion import ErrorFrame
from ...evaluation import association_scores, trajectory_error
from ..logs.ground_truth import TrueLandmarks

Integers = NDArray[np.integer]


class MapEstimate(NamedTuple):
    """The landmarks in the map at one step, in the order of the state."""

    #: Shape (k,).
    ids: Integers
    #: Shape (k, 2) [m].
    means: Array
    #: Shape (k, 2, 2) [m²].
    covariances: Array


@dataclass(frozen=True, eq=False)
class RunTrace:
    """One estimator's run over one log, for steps k = 0 … K.

    Step 0 is the start and its scan, before any motion. "Predicted" means before the
    scan of a step, "updated" after it.

    Raises
    ------
    ValueError
        If the shapes do not match.
    """

    #: Name for titles.
    estimator: str
    #: Times, shape (K + 1,) [`time_unit`].
    t: Array
    #: Poses (x, y, θ) before the scans, shape (K + 1, 3) [m, m, rad].
    predicted_poses: Array
    #: Shape (K + 1, 3, 3).
    predicted_pose_covariances: Array
    #: Updated poses, shape (K + 1, 3) [m, m, rad].
    poses: Array
    #: Shape (K + 1, 3, 3).
    pose_covariances: Array
    #: Shape (K + 1, 3), nan where unknown; None without ground truth.
    true_poses: Array | None
    #: Normalised innovation squared of each scan, shape (K + 1,).
    nis: Array
    #: Its degrees of freedom, 0 where nothing was corrected, shape (K + 1,).
    nis_dof: Integers
    #: Ids of the final map in the order of the state, shape (n,).
    landmark_ids: Integers
    #: Final means, shape (n, 2) [m].
    landmarks: Array
    #: Means when each landmark entered the map, shape (n, 2) [m].
    first_landmarks: Array
    #: Covariances when each landmark entered the map, shape (n, 2, 2) [m²].
    first_landmark_covariances: Array
    #: The map after each step, K + 1 times (ids, means, covariances).
    landmark_history: Sequence[tuple[Integers, Array, Array]]
    #: Shape (n, 2), nan where unknown; None without ground truth.
    true_landmarks: Array | None
    #: Covariance of the state right after the first scan that added landmarks.
    first_covariance: Array
    #: Covariance of the state at the end, shape (3 + 2n, 3 + 2n).
    final_covariance: Array
    #: Unit of `t` for labels; simulated logs count "steps".
    time_unit: str = "s"
    #: Coordinates of the estimator's Gaussian error.
    frame: ErrorFrame = "additive"
    #: Every true landmark, in the map or not, shape (L, 2); by default those in it.
    world_landmarks: Array | None = None

    def __post_init__(self) -> None:
        steps, n = len(self.t), len(self.landmark_ids)
        if steps == 0:
            raise ValueError("t must hold at least one step, got none")
        if len(self.landmark_history) != steps:
            raise ValueError(
                f"landmark_history must have {steps} entries, "
                f"got {len(self.landmark_history)}"
            )
        for shape, names in (
            ((steps,), "t nis nis_dof"),
            ((steps, 3), "predicted_poses poses true_poses"),
            ((steps, 3, 3), "predicted_pose_covariances pose_covariances"),
            ((n, 2), "landmarks first_landmarks true_landmarks"),
            ((n, 2, 2), "first_landmark_covariances"),
            ((3 + 2 * n, 3 + 2 * n), "final_covariance"),
        ):
            for name in names.split():
                value = getattr(self, name)
                if value is not None and np.shape(value) != shape:
                    raise ValueError(
                        f"{name} must have shape {shape}, got {np.shape(value)}"
                    )

    @property
    def last_step(self) -> int:
        """K, the number of motions."""
        return len(self.t) - 1

    @property
    def every_true_landmark(self) -> Array:
        """Every true landmark that is known, shape (m, 2); some rows may be nan."""
        known = (self.world_landmarks, self.true_landmarks, np.empty((0, 2)))
        return next(truth for truth in known if truth is not None)

    @property
    def landmark_covariances(self) -> Array:
        """Final covariance of each landmark, shape (n, 2, 2) [m²]."""
        return trajectory_error.landmark_covariances(self.final_covariance)

    def map_at(self, step: int) -> MapEstimate:
        """Return the map after a step."""
        return MapEstimate(*self.landmark_history[step])

    def step_of_first_map(self) -> int:
        """Return the first step with landmarks; 0 if there are none."""
        counts = [len(ids) for ids, *_ in self.landmark_history]
        return next((step for step, count in enumerate(counts) if count), 0)

    def first_steps(self) -> Integers:
        """Return the step at which each landmark of the final map first appears."""
        first = dict.fromkeys(self.landmark_ids.tolist(), self.last_step)
        for step in range(self.last_step, -1, -1):
            ids = self.map_at(step).ids.tolist()
            first.update({i: step for i in ids if i in first})
        return np.array(list(first.values()), dtype=np.int64)


NAMES = (*association_scores.AssociationScores._fields, "precision", "recall")


class RunDecisions(NamedTuple):
    """What a filter decided about the readings of a run, and what they are of."""

    #: One per scan.
    decisions: Sequence[interface.ScanDecisions]
    #: The true landmark of each reading, -1 for clutter, one array per scan.
    true_ids: Sequence[IntArray]
    #: (k, n): the filter believes a landmark seen in k of n scans.
    confirm: tuple[int, int]
    #: Whether the filter reports that it is probably lost; None: it does not say.
    probably_lost: bool | None = None

    def identities(self) -> dict[int, int]:
        """Return the true landmark of each mapped one, -1 for clutter."""
        return association_scores.landmark_identities(self.decisions, self.true_ids)


class RunAssociation(NamedTuple):
    """The association of a run, compared with the truth."""

    #: None where the true landmark of some reading is unknown.
    scores: association_scores.AssociationScores | None
    #: Error of the final map.
    raw: association_scores.Gospa
    #: The same after the rigid motion that brings its landmarks closest to theirs.
    aligned: association_scores.Gospa
    #: True landmarks nearer to each other count as one [m].
    resolution: float

    def as_dict(self) -> dict[str, Any]:
        """Return all as plain JSON types; None where undefined."""
        values: dict[str, Any] = dict.fromkeys(NAMES)
        if self.scores is not None:
            values |= self.scores._asdict()
            values["precision"] = finite(self.scores.precision)
            values["recall"] = finite(self.scores.recall)
        return {
            **values,
            "resolution": self.resolution,
            "gospa": {
                "raw": self.raw._asdict(),
                "aligned": self.aligned._asdict(),
                "cutoff": association_scores.CUTOFF,
            },
        }


class DecisionRecorder:
    """Collect the decisions of an estimator about readings, update by update.

    Parameters
    ----------
    slam : SlamEstimator
        The estimator.
    """

    def __init__(self, slam: interface.SlamEstimator) -> None:
        self._slam: Any = slam
        self._reported: list[interface.ScanDecisions] = []
        self._true_ids: list[IntArray | None] = []

    def add(self, report: interface.UpdateReport, true_ids: IntArray | None) -> None:
        """Note an update with readings of true landmarks, shape (m,), if known."""
        self._true_ids.append(true_ids)
        if not hasattr(type(self._slam), "decisions"):
            new = {*report.added_ids, *report.confirmed_ids}
            added = tuple(i for i in report.row_ids if i in new)
            self._reported.append(interface.ScanDecisions(report.row_ids, added))

    def result(self) -> RunDecisions | None:
        """Return the decisions as they stand now.

        None if the estimator reports none, or a true landmark is unknown.
        """
        made: Sequence[interface.ScanDecisions] = self._reported
        if hasattr(type(self._slam), "decisions"):
            made = self._slam.decisions
        true_ids = [ids for ids in self._true_ids if ids is not None]
        if [len(scan.row_ids) for scan in made] != [len(ids) for ids in true_ids]:
            return None
        from ...estimator.map_management.policy import policy_of  # noqa: PLC0415 (many)

        confirm = policy_of(self._slam).confirm
        return RunDecisions(made, true_ids, confirm, alarm_of(self._slam))


def alarm_of(slam: object) -> bool | None:
    """Return whether an estimator is probably lost; None where it does not say."""
    alarm = getattr(slam, "probably_lost", None)
    return None if alarm is None else bool(alarm)


def compare_association(
    run: RunDecisions | None,
    truth: TrueLandmarks,
    landmarks: Array,
    paired: Array | None,
    *,
    resolution: float = 0.0,
) -> RunAssociation:
    """Compare the association and the final map of a run with the truth.

    Parameters
    ----------
    run : RunDecisions or None
        The decisions, if known.
    truth : TrueLandmarks
        The true landmarks.
    landmarks : ndarray, shape (k, 2)
        The landmarks of the final map [m].
    paired : ndarray, shape (k, 2), or None
        The true ones to align them with [m], nan where unknown; None if all are.
    resolution : float
        True landmarks nearer to each other count as one place [m].
    """
    places = association_scores.places_of(truth.ids, truth.positions, resolution)
    place = np.array([places[i] for i in truth.ids.tolist()], dtype=np.int64)
    scores, is_known = None, np.ones(len(place), dtype=np.bool_)
    if run is not None:
        scores = association_scores.score_association(
            run.decisions, run.true_ids, places=places, confirm=run.confirm
        )
        seen = [[places.get(i, i) for i in scan.tolist()] for scan in run.true_ids]
        is_known = np.isin(
            place, list(association_scores.known_places(seen, run.confirm))
        )
    there, of = truth.positions[is_known], place[is_known]
    accuracy = accuracy_of(landmarks, paired)
    moved = landmarks if accuracy is None else accuracy.alignment.apply(landmarks)
    return RunAssociation(
        scores,
        association_scores.gospa(landmarks, there, places=of),
        association_scores.gospa(moved, there, places=of),
        resolution,
    )


def accuracy_of(
    landmarks: Array, truth: Array | None
) -> trajectory_error.PositionAccuracy | None:
    """Compare landmarks (n, 2) with the truth, nan where unknown; None without it."""
    if truth is None:
        return None
    known = np.isfinite(truth).all(axis=1)
    return trajectory_error.position_accuracy(landmarks[known], truth[known])


# --------------------------------------------------------------------------------------
# Statistics over the finite entries of arrays; None where there is none.


def is_finite(belief: interface.Belief) -> bool:
    """Return whether a belief holds neither nan nor infinity."""
    return bool(np.isfinite(belief.mean).all() and np.isfinite(belief.covariance).all())


def finite(value: float) -> float | None:
    """Return a number, or None for nan and infinity, which JSON does not know."""
    return float(value) if math.isfinite(value) else None


def mean(values: AnyArray) -> float | None:
    """Average over the entries that are finite.

    Examples
    --------
    >>> mean(np.array([1.0, np.nan, 2.0])), mean(np.array([np.nan]))
    (1.5, None)
    """
    known = np.asarray(values)[np.isfinite(values)]
    return finite(known.mean()) if len(known) else None


def root_mean_square(values: AnyArray) -> float | None:
    """Take the root of the mean square of the entries that are finite."""
    with np.errstate(over="ignore"):
        square = mean(np.asarray(values) ** 2)
    return None if square is None else math.sqrt(square)


def quotient(values: AnyArray, freedom: AnyArray) -> float | None:
    """Divide sums, over the entries whose value is finite.

    Parameters
    ----------
    values, freedom : ndarray, of the same shape
        Chi-square numbers and their degrees of freedom.
    """
    known = np.isfinite(values)
    total = freedom[known].sum()
    return finite(values[known].sum() / total) if total else None


def standard_error(values: AnyArray) -> float | None:
    """Return the standard error of the mean, s / √M; None for fewer than two.

    Examples
    --------
    >>> standard_error(np.array([1.0, 3.0])), standard_error(np.array([1.0]))
    (1.0, None)
    """
    count = len(values)
    return finite(values.std(ddof=1) / math.sqrt(count)) if count > 1 else None
