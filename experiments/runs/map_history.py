"""The maps of a run after every step, or after a limited number of steps."""

from bisect import bisect_right
from collections.abc import Sequence
from typing import overload

import numpy as np

from ...estimator.interface import Belief, MapView
from .trace import MapEstimate


class MapHistory(Sequence[MapEstimate]):
    """The maps of a run, one per step; a step without one has the map before it.

    Parameters
    ----------
    most : int, optional
        Number of maps to keep, evenly spaced over the run; all by default. The first
        map with a landmark and the latest one are kept in addition.

    Examples
    --------
    >>> history = MapHistory(most=2)
    >>> for x in range(5):
    ...     history.append(Belief(np.array([0, 0, 0, x, 0.0]), np.eye(5), (7,)))
    >>> [float(landmarks.means[0, 0]) for landmarks in history]
    [0.0, 0.0, 2.0, 2.0, 4.0]
    """

    def __init__(self, most: int | None = None) -> None:
        self._most = most
        self._stride = 1
        self._kept: dict[int, MapEstimate] = {}
        self._first_map: int | None = None
        self._length = 0

    def append(self, belief: Belief | MapView) -> None:
        """Append the belief after the next step."""
        step = self._length
        ids = belief.ids if isinstance(belief, MapView) else belief.landmark_ids
        self._latest = MapEstimate(
            np.array(ids, dtype=np.int64),
            belief.landmarks.copy(),
            belief.landmark_covariances,
        )
        is_due = self.is_due(step, ids)
        if ids and self._first_map is None:
            self._first_map = step
        if is_due:
            self._kept[step] = self._latest
            self._thin()
        self._length += 1

    def leave_out(self) -> None:
        """Skip the next step, which must be neither due nor the last."""
        self._length += 1

    def is_due(self, step: int, ids: Sequence[int]) -> bool:
        """Whether the map of a step will be kept; ``ids`` are the landmarks in it."""
        is_first_map = self._first_map is None and len(ids) > 0
        return is_first_map or self._is_due(step)

    @overload
    def __getitem__(self, index: int) -> MapEstimate: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[MapEstimate]: ...
    def __getitem__(self, index: int | slice) -> MapEstimate | Sequence[MapEstimate]:
        """Return the map after a step, or the latest kept one before it."""
        if isinstance(index, slice):
            return [self[k] for k in range(*index.indices(self._length))]
        step = range(self._length)[index]
        if step == self._length - 1:
            return self._latest
        kept = list(self._kept)
        return self._kept[kept[bisect_right(kept, step) - 1]]

    def __len__(self) -> int:
        """Return the number of steps, kept or not."""
        return self._length

    def _is_due(self, step: int) -> bool:
        return step % self._stride == 0 or step == self._first_map

    def _thin(self) -> None:
        """Drop every second map if there are too many."""
        if self._most is None or len(self._kept) <= self._most + 1:
            return
        self._stride *= 2
        self._kept = {
            step: kept for step, kept in self._kept.items() if self._is_due(step)
        }
