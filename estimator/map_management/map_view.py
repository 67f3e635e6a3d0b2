"""Read the map of any filter, as fast as the filter allows."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from functools import lru_cache

import numpy as np

from ..filters.ekf import EkfSlam
from ..interface import (
    Belief,
    MapView,
    SlamEstimator,
    SupportsJoin,
    SupportsLandmarkIds,
    SupportsMapView,
)
from ..models.bearing_range import wrap_angle
from ..models.rigid_motion import ErrorFrame


def view_map(slam: SlamEstimator) -> MapView:
    """Return a view of the whole map of a filter, without a copy where possible."""
    if isinstance(slam, EkfSlam | SupportsMapView) and not hides_its_belief(slam):
        return slam.map_view()
    belief = slam.belief()
    return MapView(belief.mean, belief.covariance, belief.landmark_ids)


def mapped_ids(slam: SlamEstimator) -> tuple[int, ...]:
    """Return the landmarks in the map of a filter, in the order of its belief."""
    if isinstance(slam, EkfSlam | SupportsLandmarkIds) and not hides_its_belief(slam):
        return tuple(slam.landmark_ids)
    return slam.belief().landmark_ids


def is_near(one: MapView, other: MapView, tolerance: float) -> bool:
    """Return whether two maps of the same landmarks have nearly the same belief.

    In every coordinate with means μ₁, μ₂ and deviations σ₁, σ₂, the second belief must
    not be far off the first one and not be much less certain::

        (μ₂ − μ₁)² + σ₂² − σ₁² ≤ (tolerance σ₁)²
    """
    if one.ids != other.ids:
        return False
    size = 3 + 2 * len(one.ids)
    gap = other.mean[:size] - one.mean[:size]
    gap[2] = wrap_angle(float(gap[2]))
    variances, others = (np.diagonal(m.covariance)[:size] for m in (one, other))
    return bool((gap**2 + others <= (1 + tolerance**2) * variances).all())


def marginal(slam: SlamEstimator, ids: Sequence[int]) -> Belief:
    """Return the belief over the pose and some landmarks, in this order.

    Examples
    --------
    >>> slam = EkfSlam((0.1, 0.1, 0.1), (0.1, 0.1))
    >>> _ = slam.update([(0.0, 2.0), (0.0, 3.0)], [5, 6])
    >>> marginal(slam, [6]).landmarks
    array([[3., 0.]])
    """
    if isinstance(slam, EkfSlam) and not hides_its_belief(slam):
        return slam.belief(ids)
    if _takes_landmark_ids(getattr(slam.belief, "__func__", slam.belief)):
        belief: Belief = slam.belief(landmark_ids=ids)  # type: ignore[call-arg]
        return belief
    whole = slam.belief()
    return _part(whole, whole.landmark_ids, ids, whole.frame)


def marginal_without_joining(slam: SlamEstimator, ids: Sequence[int]) -> Belief:
    """Return a marginal as the filter has it without joining the parts of its map.

    Of a filter that joins its map it is taken from ``local_view``, where that holds
    these landmarks; its error is then judged in the invariant frame.
    """
    # The first test takes far less time than the second, and mostly decides.
    if not hasattr(slam, "join") or not isinstance(slam, SupportsJoin):
        return marginal(slam, ids)
    view = slam.local_view(0.0)
    if not set(ids) <= set(view.ids):
        return marginal(slam, ids)
    return _part(view, view.ids, ids, "invariant")


def hides_its_belief(slam: object) -> bool:
    """Return whether a subclass of :class:`EkfSlam` keeps its belief elsewhere.

    Then only ``belief()`` and the saved state are valid, not the map it inherits.
    """
    if not isinstance(slam, EkfSlam):
        return False
    kind = type(slam)
    return kind.belief is not EkfSlam.belief and kind.map_view is EkfSlam.map_view


@lru_cache(maxsize=64)
def _takes_landmark_ids(belief: Callable[..., Belief]) -> bool:
    return "landmark_ids" in inspect.signature(belief).parameters


def _part(
    whole: Belief | MapView, order: Sequence[int], ids: Sequence[int], frame: ErrorFrame
) -> Belief:
    slots = {i: slot for slot, i in enumerate(order)}
    return Belief.marginal(whole.mean, whole.covariance, slots, ids, frame)
