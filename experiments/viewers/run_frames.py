"""Keep the map, its correlations and the outcomes of the readings, step by step."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...arrays import Array, IntArray
from ...estimator.interface import MapView, SlamEstimator, SupportsJoin, UpdateReport
from ...estimator.map_management.map_editor import view_map
from ..logs.events import Scan
from ..logs.slamlog import SlamLog
from ..logs.steps import steps_of
from .thinned_steps import ThinnedSteps

OUTCOMES = (
    "not used",
    "used",
    "new",
    "rejected",
    "too close",
    "tentative",
    "ambiguous",
)
"""What became of a reading; its code is the place in this list."""
NO_ID = -1
"""In place of the landmark of a reading that was given to none."""
MOST_CORRELATED = 300
"""Landmarks of the largest map whose correlations are kept."""

_UNUSED, _USED, _NEW, _REJECTED, _SKIPPED, _TENTATIVE, _AMBIGUOUS = range(7)
_MOST_FRAMES = 2000
_MOST_LANDMARKS = 400_000  # summed over the frames
_MOST_PAIRS = 2_000_000  # summed over the frames with correlations


class MapFrame(NamedTuple):
    """The map after one step, and what became of the scan's readings."""

    ids: IntArray
    """Landmarks, shape (n,)."""
    means: Array
    """Shape (n, 2) [m]."""
    covariances: Array
    """Shape (n, 2, 2) [m²]."""
    outcomes: NDArray[np.uint8]
    """Of each reading, its place in `OUTCOMES`, shape (m,)."""
    row_ids: IntArray
    """The mapped landmark of each reading, or `NO_ID`, shape (m,)."""


class CorrelationFrame(NamedTuple):
    """The correlations after one step: of the robot's position and n landmarks."""

    ids: IntArray
    """Landmarks, shape (n,)."""
    values: Array
    """In [0, 1]: of row 1 with column 0, 2 with 0, 2 with 1, …, shape (n (n + 1) / 2,).
    The robot is row 0."""


class RunFrames:
    """Watch a replay, and keep what a viewer shows of it, within bounded memory.

    A long run, or one with a large map, keeps evenly spaced steps, and fewer of them
    with correlations. Maps above `MOST_CORRELATED` landmarks keep no correlations.

    Parameters
    ----------
    log : SlamLog
        The log that is replayed.

    Examples
    --------
    >>> from slamgym.estimator import make_estimator
    >>> from slamgym.experiments.runs import replay
    >>> log = SlamLog("one scan", events=(Scan(0, [(0.0, 5.0), (1.0, 4.0)], [4, 9]),))
    >>> frames = RunFrames(log)
    >>> slam = make_estimator("ekf", motion_std=(0.1,) * 3, measurement_std=(0.1, 0.1))
    >>> trace = replay(log, slam, watch=frames.watch).trace
    >>> frames.maps[0].ids, frames.correlations[0].values
    (array([4, 9]), array([0., 0., 0.]))
    """

    def __init__(self, log: SlamLog) -> None:
        self._scans = [step.scan for step in steps_of(log)]
        last = len(self._scans) - 1
        self._maps = ThinnedSteps[MapFrame](_MOST_FRAMES, _MOST_LANDMARKS, last)
        self._pairs = ThinnedSteps[CorrelationFrame](_MOST_FRAMES, _MOST_PAIRS, last)
        self.largest = 0
        """Landmarks of the largest map."""
        self.joins = False
        """Whether the filter joins its map on demand; then the frames hold no map."""

    @property
    def maps(self) -> dict[int, MapFrame]:
        """The kept maps by their steps, the first and the last one among them."""
        return self._maps.items

    @property
    def correlations(self) -> dict[int, CorrelationFrame]:
        """The kept correlations by their steps; empty where a map is too large."""
        return {} if self.largest > MOST_CORRELATED else self._pairs.items

    def watch(
        self, step: int, slam: SlamEstimator, report: UpdateReport | None
    ) -> None:
        """Keep a step, if it is due; pass this as ``watch`` of ``replay``."""
        if not self._maps.is_due(step):
            return
        self.joins = isinstance(slam, SupportsJoin)
        outcomes = row_outcomes(self._scans[step], report)
        if self.joins:
            empty = np.empty(0, np.int64), np.empty((0, 2)), np.empty((0, 2, 2))
            self._maps.put(step, MapFrame(*empty, *outcomes), 1)
            return
        view = view_map(slam)
        ids = np.array(view.ids, dtype=np.int64)
        maps = ids, view.landmarks.copy(), view.landmark_covariances
        self._maps.put(step, MapFrame(*maps, *outcomes), len(ids) + 1)
        self.largest = max(self.largest, len(ids))
        if self.largest <= MOST_CORRELATED and self._pairs.is_due(step):
            values = correlations_of(view)
            self._pairs.put(step, CorrelationFrame(ids, values), len(values) + 1)


def row_outcomes(
    scan: Scan | None, report: UpdateReport | None
) -> tuple[NDArray[np.uint8], IntArray]:
    """Return what became of each reading of a scan, and its landmark in the map.

    Returns
    -------
    outcomes : ndarray of uint8, shape (m,)
        Places in `OUTCOMES`.
    row_ids : ndarray of int, shape (m,)
        `NO_ID` where the filter gave a reading to no landmark.
    """
    rows = 0 if scan is None else len(scan.measurements)
    if scan is None or report is None:
        return np.zeros(rows, np.uint8), np.full(rows, NO_ID)
    ids = _landmark_of_rows(scan, report)
    by_id = dict.fromkeys(report.added_ids, _NEW)
    by_id |= dict.fromkeys(report.rejected_ids, _REJECTED)
    by_id |= dict.fromkeys(report.skipped_ids, _SKIPPED)
    known = np.array([NO_ID if i is None else i for i in ids], np.int64)
    codes = np.array([by_id.get(i, _USED) for i in known.tolist()], np.uint8)
    codes[known == NO_ID] = _UNUSED
    codes[list(report.tentative_rows)] = _TENTATIVE
    codes[list(report.ambiguous_rows)] = _AMBIGUOUS
    return codes, known


def correlations_of(view: MapView) -> Array:
    """Return how strongly the positions of robot and landmarks are correlated.

    For two positions a and b, ρ is their largest canonical correlation: the largest
    correlation between a coordinate of a and one of b, over all directions ::

        ρ = σ₁(Lₐ⁻¹ Pₐᵦ Lᵦ⁻ᵀ),    Lₐ Lₐᵀ = Pₐₐ

    Parameters
    ----------
    view : MapView
        The belief over the pose and n landmarks.

    Returns
    -------
    ndarray, shape (n (n + 1) / 2,)
        As in `CorrelationFrame`; 0 where a position is certain.
    """
    size = 3 + 2 * len(view.ids)
    columns = np.r_[0, 1, 3:size]
    P = np.asarray(view.covariance)[np.ix_(columns, columns)]
    count = len(columns) // 2
    one, other = np.tril_indices(count, -1)
    blocks = P.reshape(count, 2, count, 2)
    own = np.arange(count)
    whiten = _inverse_factors(blocks[own, :, own, :])
    white = whiten[one] @ blocks[one, :, other, :] @ whiten[other].transpose(0, 2, 1)
    return np.minimum(_largest_singular_values(white), 1.0)


def _landmark_of_rows(scan: Scan, report: UpdateReport) -> Sequence[int | None]:
    rows = len(scan.measurements)
    if len(report.row_ids) == rows:
        return report.row_ids
    if scan.landmark_ids is None:
        return (NO_ID,) * rows
    return tuple(scan.landmark_ids.tolist())


def _inverse_factors(P: Array) -> Array:
    """Return L⁻¹ of L Lᵀ = P, shape (n, 2, 2); zeros where P is singular."""
    inverse = np.zeros_like(P)
    a, b = P[:, 0, 0], P[:, 1, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        first = 1 / np.sqrt(a)
        second = 1 / np.sqrt(P[:, 1, 1] - b * b / a)
        inverse[:, 0, 0], inverse[:, 1, 1] = first, second
        inverse[:, 1, 0] = -b / a * second
    inverse[~np.isfinite(inverse).all(axis=(1, 2))] = 0.0
    return inverse


def _largest_singular_values(A: Array) -> Array:
    """Return σ₁ of 2 × 2 matrices, shape (n,), in closed form."""
    (a, b), (c, d) = A[:, 0].T, A[:, 1].T
    return np.asarray((np.hypot(a + d, c - b) + np.hypot(a - d, c + b)) / 2)
