"""Read the map of any filter, as fast as the filter allows."""

from __future__ import annotations

import inspect
from collections.abc import Mapping, Sequence
from typing import TypeGuard

import numpy as np
from numpy.typing import NDArray

from ..error_frames import ErrorFrame
from ..filters.ekf import FRAMES, EkfSlam
from ..interface import (
    Belief,
    MapView,
    SlamEstimator,
    SupportsJoin,
    SupportsLandmarkIds,
    SupportsMapView,
)

Array = NDArray[np.float64]


def view_map(slam: SlamEstimator) -> MapView:
    """Return a view of the whole map of a filter, without a copy where possible."""
    if keeps_own_arrays(slam):
        return MapView(slam._mean, slam._covariance, list(slam._slots))
    if isinstance(slam, SupportsMapView):
        return slam.map_view()
    belief = slam.belief()
    return MapView(belief.mean, belief.covariance, belief.landmark_ids)


def mapped_ids(slam: SlamEstimator) -> tuple[int, ...]:
    """Return the landmarks in the map of a filter, in the order of its belief."""
    if keeps_own_arrays(slam):
        return tuple(slam._slots)
    if isinstance(slam, SupportsLandmarkIds):
        return tuple(slam.landmark_ids)
    return slam.belief().landmark_ids


def marginal(slam: SlamEstimator, ids: Sequence[int]) -> Belief:
    """Return the belief over the pose and some landmarks, in this order.

    Examples
    --------
    >>> slam = EkfSlam((0.1, 0.1, 0.1), (0.1, 0.1))
    >>> _ = slam.update([(0.0, 2.0), (0.0, 3.0)], [5, 6])
    >>> marginal(slam, [6]).landmarks
    array([[3., 0.]])
    """
    if keeps_own_arrays(slam):
        order, frame = slam._slots, FRAMES[slam._frame]
        return _part(slam._mean, slam._covariance, order, ids, frame)
    if "landmark_ids" in inspect.signature(slam.belief).parameters:
        belief: Belief = slam.belief(landmark_ids=ids)  # type: ignore[call-arg]
        return belief
    whole = slam.belief()
    order = {i: slot for slot, i in enumerate(whole.landmark_ids)}
    return _part(whole.mean, whole.covariance, order, ids, whole.frame)


def marginal_without_joining(slam: SlamEstimator, ids: Sequence[int]) -> Belief:
    """Return a marginal as the filter has it without joining the parts of its map.

    Of a filter that joins its map it is taken from ``local_view``, where that holds
    these landmarks; its error is then judged in the invariant frame.
    """
    if not isinstance(slam, SupportsJoin):
        return marginal(slam, ids)
    view = slam.local_view(0.0)
    if not set(ids) <= set(view.ids):
        return marginal(slam, ids)
    order = {i: slot for slot, i in enumerate(view.ids)}
    return _part(view.mean, view.covariance, order, ids, "invariant")


def keeps_own_arrays(slam: object) -> TypeGuard[EkfSlam]:
    """Return whether a filter believes what the arrays of :class:`EkfSlam` hold.

    A subclass with a belief of its own may keep it elsewhere.
    """
    return isinstance(slam, EkfSlam) and type(slam).belief is EkfSlam.belief


def _part(
    mean: Array,
    covariance: Array,
    order: Mapping[int, int],
    ids: Sequence[int],
    frame: ErrorFrame,
) -> Belief:
    columns = [0, 1, 2, *(3 + 2 * order[i] + axis for i in ids for axis in (0, 1))]
    P = covariance[np.ix_(columns, columns)]
    return Belief(mean[columns], P, tuple(ids), frame)
