"""The interface of every estimator, `SlamEstimator`.

The other protocols describe what only some estimators can do. `view_map` and `marginal`
read the map of any of them.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import lru_cache
from typing import Any, Protocol, runtime_checkable

from numpy.typing import ArrayLike

from ..arrays import Array
from .beliefs import Belief, MapView, ScanDecisions, UpdateReport, part_of
from .guards.interrupts import Interruptible

__all__ = [
    "Belief",
    "FilterWrapper",
    "MapView",
    "ScanDecisions",
    "SlamEstimator",
    "SmoothedPath",
    "UpdateReport",
    "restore",
    "taking_poses",
    "with_fix",
]
__dir__ = __all__.copy


@runtime_checkable
class SlamEstimator(Protocol):
    """A filter that estimates a robot's pose and a map of landmarks step by step.

    Any class with these methods works in an experiment or an agent's loop.
    :func:`slamgym.estimator.check_estimator` names what a class of your own lacks.

    A class may have further members; only their names count:

    - ``observe_truth(pose, landmarks)`` takes the true pose (3,) and landmarks before
      the predict of a step, for a filter that linearises there;
    - ``observe_pose(reading, matrix, covariance)`` takes z = H (x, y, θ) + w, w of
      covariance R, from z, H and R, and returns an `UpdateReport`;
    - ``decisions`` lists the `ScanDecisions` about every scan since the start;
    - ``smoothed()`` returns the `SmoothedPath` of the drive until now;
    - ``local_view(within)`` returns a `MapView` of the pose and at least the landmarks
      within a distance [m], faster than the whole belief;
    - ``join()``, beside it, joins parts of a map that were kept apart until then;
    - ``belief_limit`` is the largest number of landmarks of a dense belief.
    """

    def reset(self, pose: ArrayLike, pose_std: ArrayLike) -> None:
        """Start a new run at a pose (3,) with deviations (3,) [m, m, rad], no map."""

    def predict(self, odometry: ArrayLike, dt: float = 1.0) -> None:
        """Move by odometry (d, α) [m, rad]; dt multiplies the noise variance."""

    def update(
        self, measurements: ArrayLike, landmark_ids: Sequence[int] | None = None
    ) -> UpdateReport:
        """Take in one scan, rows (bearing, range) [rad, m], all seen at once."""
        ...

    def belief(self) -> Belief:
        """Return the present belief."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """Return everything that load_state_dict() needs, as arrays."""
        ...

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a saved state, bit for bit."""


def taking_poses(estimator: Any) -> Any:
    """Return an estimator that takes readings of the pose; refuse any other."""
    if not hasattr(estimator, "observe_pose"):
        name = type(estimator).__name__
        raise ValueError(f"{name} does not accept readings of the pose")
    return estimator


def with_fix(report: UpdateReport, fix: UpdateReport) -> UpdateReport:
    """Return the report of a scan with the NIS of a reading of the pose after it."""
    return report.replace(
        nis=report.nis + fix.nis,
        degrees_of_freedom=report.degrees_of_freedom + fix.degrees_of_freedom,
    )


class SmoothedPath(Protocol):
    """Beliefs about the poses of a drive, given all of its readings."""

    #: At every scan, shape (N, 3) [m, m, rad].
    poses: Array

    @property
    def pose_covariances(self) -> Array:
        """Shape (N, 3, 3)."""
        ...

    def belief(self) -> Belief:
        """Return the belief about the last pose and the map."""
        ...


def restore(estimator: Any, state: Mapping[str, Any]) -> None:
    """Continue from a state that this process has saved, without checks if possible."""
    getattr(estimator, "restore", estimator.load_state_dict)(state)


def snapshot(estimator: Any) -> Any:
    """Return a copy of the present state for :func:`resume`."""
    return getattr(estimator, "snapshot", estimator.state_dict)()


def resume(estimator: Any, before: Any) -> None:
    """Return to a :func:`snapshot` of an estimator with the same settings."""
    if hasattr(estimator, "resume"):
        estimator.resume(before)
    else:
        restore(estimator, before)


@contextmanager
def returned_on_error(estimator: Any) -> Iterator[None]:
    """Return an estimator to its present state if the block raises, even an interrupt.

    It works for any object with a :func:`snapshot`, for example a map.
    """
    before = snapshot(estimator)
    try:
        yield
    except BaseException:
        resume(estimator, before)
        raise


# --------------------------------------------------------------------------------------
# Read the map of any filter, as fast as the filter allows.


def view_map(slam: SlamEstimator) -> MapView:
    """Return a view of the whole map of a filter, without a copy where possible."""
    if hasattr(slam, "map_view") and not hides_its_belief(slam):
        view: MapView = slam.map_view()
        return view
    belief = slam.belief()
    return MapView(belief.mean, belief.covariance, belief.landmark_ids)


def mapped_ids(slam: SlamEstimator) -> tuple[int, ...]:
    """Return the landmarks in the map of a filter, in the order of its belief."""
    ids = None if hides_its_belief(slam) else getattr(slam, "landmark_ids", None)
    return slam.belief().landmark_ids if ids is None else tuple(ids)


def marginal(slam: SlamEstimator, ids: Sequence[int]) -> Belief:
    """Return the belief over the pose and some landmarks, in this order.

    Examples
    --------
    >>> from slamgym.estimator import EkfSlam
    >>> slam = EkfSlam((0.1, 0.1, 0.1), (0.1, 0.1))
    >>> _ = slam.update([(0.0, 2.0), (0.0, 3.0)], [5, 6])
    >>> marginal(slam, [6]).landmarks
    array([[3., 0.]])
    """
    if _takes_landmark_ids(getattr(slam.belief, "__func__", slam.belief)):
        belief: Belief = slam.belief(landmark_ids=ids)  # type: ignore[call-arg]
        return belief
    whole = slam.belief()
    return part_of(whole, ids, whole.frame)


def joins_its_map(slam: object) -> bool:
    """Return whether a filter keeps parts of its map apart until it joins them."""
    return hasattr(slam, "join") and hasattr(slam, "local_view")


def marginal_without_joining(slam: SlamEstimator, ids: Sequence[int]) -> Belief:
    """Return a marginal as the filter has it without joining the parts of its map.

    For a filter that joins its map, it is taken from ``local_view``, if that holds
    these landmarks; its error is then judged in the invariant frame.
    """
    if not joins_its_map(slam):
        return marginal(slam, ids)
    view: MapView = slam.local_view(0.0)  # type: ignore[attr-defined]
    if not set(ids) <= set(view.ids):
        return marginal(slam, ids)
    return part_of(view, ids, "invariant")


def hides_its_belief(slam: object) -> bool:
    """Return whether a subclass keeps its belief elsewhere than the class it extends.

    It then overrides ``belief()``, but not the ``map_view()`` that it inherits.  Only
    ``belief()`` and the saved state are valid.
    """
    kind: Any = type(slam)
    return _hides_its_belief(kind)


@lru_cache(maxsize=64)
def _hides_its_belief(kind: Any) -> bool:
    owner = next((base for base in kind.__mro__ if "map_view" in vars(base)), kind)
    return owner is not kind and kind.belief is not getattr(
        owner, "belief", kind.belief
    )


@lru_cache(maxsize=64)
def _takes_landmark_ids(belief: Callable[..., Belief]) -> bool:
    return "landmark_ids" in inspect.signature(belief).parameters


def _of_inside(name: str) -> property:
    """Return a member of a wrapper: that of the filter inside, where this has one."""

    def member(self: Any) -> Any:
        if self.passes_on:
            return getattr(self._inside, name)
        raise AttributeError(f"{type(self).__name__} has no attribute {name!r}")

    return property(member)


class FilterWrapper(Interruptible):
    """A filter around another one: its map is that of the filter inside."""

    #: Whether to pass on the optional members that need no more than the filter inside.
    passes_on = True
    observe_truth, local_view, join, smoothed, belief_limit = map(
        _of_inside, ("observe_truth", "local_view", "join", "smoothed", "belief_limit")
    )

    @property
    def _inside(self) -> SlamEstimator:
        raise NotImplementedError

    def belief(self, landmark_ids: Sequence[int] | None = None) -> Belief:
        """Return the present belief, of the whole map or of pose and some landmarks."""
        if landmark_ids is None:
            return self._inside.belief()
        return marginal(self._inside, landmark_ids)

    def map_view(self) -> MapView:
        """Return pose and map, without a copy where possible, until the next step."""
        return view_map(self._inside)

    @property
    def landmark_ids(self) -> tuple[int, ...]:
        """The mapped landmarks, in the order of the belief."""
        return mapped_ids(self._inside)
