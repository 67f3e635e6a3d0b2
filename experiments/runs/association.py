"""How well a run associated readings without identity: its decisions and the truth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.distance import cdist

from ...arrays import Array, IntArray
from ...estimator.interface import (
    ScanDecisions,
    SlamEstimator,
    SupportsDecisions,
    UpdateReport,
)
from ...estimator.map_management.policy import policy_of
from ...evaluation.association_scores import (
    CUTOFF,
    AssociationScores,
    Gospa,
    gospa,
    known_places,
    landmark_identities,
    places_of,
    score_association,
)
from ...evaluation.trajectory_error import Alignment, align_positions
from .nan_statistics import finite

NAMES = (*AssociationScores._fields, "precision", "recall")


class TrueLandmarks(NamedTuple):
    """The true landmarks of a world."""

    ids: IntArray
    """Shape (n,)."""
    positions: Array
    """Shape (n, 2) [m]."""


class RunDecisions(NamedTuple):
    """What a filter decided about the readings of a run, and what they are of."""

    decisions: Sequence[ScanDecisions]
    """One per scan."""
    true_ids: Sequence[IntArray]
    """The true landmark of each reading, -1 for clutter, one array per scan."""
    confirm: tuple[int, int]
    """(k, n): the filter believes a landmark seen in k of n scans."""

    def identities(self) -> dict[int, int]:
        """Return the true landmark of each mapped one, -1 for clutter."""
        return landmark_identities(self.decisions, self.true_ids)


class RunAssociation(NamedTuple):
    """The association of a run, compared with the truth."""

    scores: AssociationScores | None
    """None where the true landmark of some reading is unknown."""
    raw: Gospa
    """Error of the final map."""
    aligned: Gospa
    """The same after the rigid motion that brings its landmarks closest to theirs."""
    resolution: float
    """True landmarks nearer to each other count as one [m]."""

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
                "cutoff": CUTOFF,
            },
        }


class DecisionRecorder:
    """Collect the decisions of an estimator about readings, update by update.

    Parameters
    ----------
    slam : SlamEstimator
        The estimator.
    """

    def __init__(self, slam: SlamEstimator) -> None:
        self._slam = slam
        self._reported: list[ScanDecisions] = []
        self._true_ids: list[IntArray | None] = []

    def add(self, report: UpdateReport, true_ids: IntArray | None) -> None:
        """Note an update with readings of true landmarks, shape (m,), if known."""
        self._true_ids.append(true_ids)
        if not isinstance(self._slam, SupportsDecisions):
            new = {*report.added_ids, *report.confirmed_ids}
            added = tuple(i for i in report.row_ids if i in new)
            self._reported.append(ScanDecisions(report.row_ids, added))

    def result(self) -> RunDecisions | None:
        """Return the decisions as they stand now.

        None if the estimator reports none, or a true landmark is unknown.
        """
        made: Sequence[ScanDecisions] = self._reported
        if isinstance(self._slam, SupportsDecisions):
            made = self._slam.decisions
        true_ids = [ids for ids in self._true_ids if ids is not None]
        if [len(scan.row_ids) for scan in made] != [len(ids) for ids in true_ids]:
            return None
        return RunDecisions(made, true_ids, policy_of(self._slam).confirm)


def compare_association(
    run: RunDecisions | None,
    truth: TrueLandmarks,
    landmark_ids: Sequence[int],
    landmarks: Array,
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
    landmark_ids : sequence of int
        The landmarks of the final map.
    landmarks : ndarray, shape (k, 2)
        Their positions [m].
    resolution : float
        True landmarks nearer to each other count as one place [m].
    """
    places = places_of(truth.ids, truth.positions, resolution)
    place = np.array([places[i] for i in truth.ids.tolist()], dtype=np.int64)
    scores, is_known = None, np.ones(len(place), dtype=np.bool_)
    if run is not None:
        scores = score_association(
            run.decisions, run.true_ids, places=places, confirm=run.confirm
        )
        seen = [[places.get(i, i) for i in scan.tolist()] for scan in run.true_ids]
        is_known = np.isin(place, list(known_places(seen, run.confirm)))
        identities = run.identities()
    else:
        identities = mutual_nearest(truth, landmark_ids, landmarks)
    there, of = truth.positions[is_known], place[is_known]
    moved = alignment(identities, truth, landmark_ids, landmarks)
    return RunAssociation(
        scores,
        gospa(landmarks, there, places=of),
        gospa(moved.apply(landmarks), there, places=of),
        resolution,
    )


def mutual_nearest(
    truth: TrueLandmarks, landmark_ids: Sequence[int], landmarks: Array
) -> dict[int, int]:
    """Pair mapped and true landmarks that are nearest to each other."""
    if not len(landmarks) or not len(truth.ids):
        return {}
    gaps = cdist(landmarks, truth.positions)
    nearest, back = gaps.argmin(axis=1), gaps.argmin(axis=0)
    return {
        i: int(truth.ids[j])
        for k, (i, j) in enumerate(zip(landmark_ids, nearest.tolist(), strict=True))
        if back[j] == k
    }


def alignment(
    identities: Mapping[int, int],
    truth: TrueLandmarks,
    landmark_ids: Sequence[int],
    landmarks: Array,
) -> Alignment:
    """Return the motion that brings landmarks closest to those they are of."""
    positions = dict(zip(truth.ids.tolist(), truth.positions, strict=True))
    owners = [positions.get(identities.get(i, -1)) for i in landmark_ids]
    pairs = [(m, o) for m, o in zip(landmarks, owners, strict=True) if o is not None]
    if not pairs:
        return Alignment(0.0, np.zeros(2))
    mapped, true = (np.array(side) for side in zip(*pairs, strict=True))
    return align_positions(mapped, true)
