"""The doors through which others see and edit the map of any filter.

Filters that keep the arrays of :class:`EkfSlam` are read and edited in place, without a
copy of the whole covariance.  Others may have doors of their own, each by itself:

* ``belief(landmark_ids)`` answers with the marginal of the pose and these landmarks;
* ``landmark_ids`` are the mapped landmarks in the order of the belief;
* ``remove(landmark_ids)`` marginalises landmarks, all else keeps its last bit;
* ``merge(kept, gone)`` conditions on two landmarks being one, and drops the second;
* ``view_around(within)`` looks at the pose and at least those landmarks that are within
  so many metres of it, where to look at all of them takes long.

What is lacking goes through ``belief()``, ``state_dict()`` and ``load_state_dict()``.
"""

import inspect
from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol, TypeGuard

import numpy as np
from numpy.typing import NDArray

from ..filters.ekf import FRAMES, EkfSlam
from ..interface import Belief, SlamEstimator
from ..kernels.predict import AT_ESTIMATE
from .marginalise_and_merge import coincide, without_landmarks

Array = NDArray[np.float64]


class MapView(NamedTuple):
    """What a filter believes just now: to look at, not to keep or to change."""

    mean: Array
    """In the order of the state; there may be room behind it."""
    covariance: Array
    """Of the additive error; there may be room behind it."""
    ids: Sequence[int]
    """Landmarks in the order of the state."""
    whole: Sequence[int] | None = None
    """All landmarks in the map, where the view holds but those around the robot."""

    @property
    def mapped(self) -> Sequence[int]:
        """All landmarks in the map, in its order."""
        return self.ids if self.whole is None else self.whole

    @property
    def landmarks(self) -> Array:
        """Positions, shape (n, 2) [m]."""
        return self.mean[3 : 3 + 2 * len(self.ids)].reshape(-1, 2)

    @property
    def landmark_covariances(self) -> Array:
        """Marginal covariance of each landmark, shape (n, 2, 2) [m²]."""
        columns = np.arange(3, 3 + 2 * len(self.ids)).reshape(-1, 2)
        return self.covariance[columns[:, :, None], columns[:, None, :]]


class MapAccess(Protocol):
    """What landmark management does with a filter's map."""

    def map_view(self, within: float = 0.0) -> MapView:
        """Look at pose and map; the view ends with the filter's next step.

        Landmarks farther away than ``within`` [m] may be left out.
        """
        ...

    def remove(self, ids: Sequence[int]) -> None:
        """Marginalise landmarks; all else keeps its last bit."""

    def merge(self, kept: int, gone: int) -> None:
        """Condition on two landmarks being one, and drop the second."""


def view_of(slam: SlamEstimator) -> MapView:
    """Look at the whole map of a filter, without a copy where that is possible."""
    if _has_arrays(slam):
        return MapView(slam._mean, slam._covariance, list(slam._slots))
    own = getattr(slam, "map_view", None)
    if own is not None:
        view: MapView = own()
        return view
    belief = slam.belief()
    return MapView(belief.mean, belief.covariance, belief.landmark_ids)


def mapped_ids(slam: SlamEstimator) -> tuple[int, ...]:
    """Return the landmarks in the map of a filter, in the order of its belief."""
    if _has_arrays(slam):
        return tuple(slam._slots)
    own = getattr(slam, "landmark_ids", None)
    return slam.belief().landmark_ids if own is None else tuple(own)


def marginal(slam: SlamEstimator, ids: Sequence[int]) -> Belief:
    """Return the belief over the pose and some landmarks, in this order.

    Examples
    --------
    >>> slam = EkfSlam((0.1, 0.1, 0.1), (0.1, 0.1))
    >>> _ = slam.update([(0.0, 2.0), (0.0, 3.0)], [5, 6])
    >>> marginal(slam, [6]).landmarks
    array([[3., 0.]])
    """
    if _has_arrays(slam):
        order, frame = slam._slots, FRAMES[slam._frame]
        return _part(slam._mean, slam._covariance, order, ids, frame)
    if "landmark_ids" in inspect.signature(slam.belief).parameters:
        belief: Belief = slam.belief(landmark_ids=ids)  # type: ignore[call-arg]
        return belief
    whole = slam.belief()
    order = {i: slot for slot, i in enumerate(whole.landmark_ids)}
    return _part(whole.mean, whole.covariance, order, ids, whole.frame)


def at_once(slam: SlamEstimator, ids: Sequence[int]) -> Belief:
    """Return the same as the filter has it without joining anything, if it can tell.

    Of one that joins its map (``join``) it is what ``view_around`` tells, so far as
    that holds these landmarks; its error is then to be judged in the invariant frame.
    """
    view = _around(slam, 0.0) if joins(slam) else None
    if view is None or not set(ids) <= set(view.ids):
        return marginal(slam, ids)
    order = {i: slot for slot, i in enumerate(view.ids)}
    return _part(view.mean, view.covariance, order, ids, "invariant")


def joins(slam: SlamEstimator) -> bool:
    """Whether a filter has to join its map before it can tell of it."""
    return callable(getattr(slam, "join", None))


def _around(slam: Any, within: float) -> MapView:
    view: MapView = slam.view_around(within)
    return view


def _part(
    mean: Array,
    covariance: Array,
    order: dict[int, int],
    ids: Sequence[int],
    frame: Any,
) -> Belief:
    columns = [0, 1, 2, *(3 + 2 * order[i] + axis for i in ids for axis in (0, 1))]
    P = covariance[np.ix_(columns, columns)]
    return Belief(mean[columns], P, tuple(ids), frame)


def access_to(slam: SlamEstimator, *, merging: bool = True) -> MapAccess:
    """Find the best door to a filter's map.

    Parameters
    ----------
    slam : SlamEstimator
    merging : bool
        Whether landmarks will have to be merged, too.

    Raises
    ------
    TypeError
        If the filter neither has doors of its own nor a state that can be edited.
    """
    if _has_arrays(slam):
        return _ArrayAccess(slam)
    wanted = ("remove", "merge") if merging else ("remove",)
    if all(callable(getattr(slam, name, None)) for name in wanted):
        return _OwnAccess(slam)
    missing = {"mean", "covariance", "landmark_ids"} - set(slam.state_dict())
    if missing:
        raise TypeError(
            f"{type(slam).__name__} cannot be managed so: it has no method "
            f"{' and '.join(wanted)}, and its state_dict() holds no "
            f"{sorted(missing)[0]!r}"
        )
    return _StateAccess(slam)


def _has_arrays(slam: SlamEstimator) -> TypeGuard[EkfSlam]:
    """Whether a filter's arrays are what it believes: an heir may keep it elsewhere."""
    return isinstance(slam, EkfSlam) and type(slam).belief is EkfSlam.belief


class RememberedAccess:
    """A door that looks once and remembers what it saw until told that it is old."""

    def __init__(self, door: MapAccess) -> None:
        self._door = door
        self._view: MapView | None = None
        self._within = 0.0

    def map_view(self, within: float | None = None) -> MapView:
        """Look at pose and map, or remember; as far as the last time where not said."""
        reach = self._within if within is None else within
        if self._view is None or reach > self._within:
            self._view = self._door.map_view(reach)
        self._within = reach
        return self._view

    def expire(self) -> None:
        """Forget the view: the filter has taken a step."""
        self._view = None

    def remove(self, ids: Sequence[int]) -> None:
        """Marginalise landmarks."""
        self.expire()
        self._door.remove(ids)

    def merge(self, kept: int, gone: int) -> None:
        """Condition on two landmarks being one, and drop the second."""
        self.expire()
        self._door.merge(kept, gone)


class _ArrayAccess:
    """In place, in the arrays of the standard filter."""

    def __init__(self, slam: EkfSlam) -> None:
        self._slam = slam

    def map_view(self, within: float = 0.0) -> MapView:
        return view_of(self._slam)

    def remove(self, ids: Sequence[int]) -> None:
        slam, n = self._slam, self._slam._size
        slots = [slam._slots[i] for i in ids]
        for array in (slam._mean, slam._reference):
            _refill(array, without_landmarks(array[:n], slots))
        _refill(slam._covariance, without_landmarks(slam._covariance[:n, :n], slots))
        left = [i for i in slam._slots if i not in set(ids)]
        slam._slots = {i: slot for slot, i in enumerate(left)}
        slam._size = 3 + 2 * len(left)

    def merge(self, kept: int, gone: int) -> None:
        slam, n = self._slam, self._slam._size
        at_estimate = slam.rules.linearisation == AT_ESTIMATE
        slam._mean[:n], slam._covariance[:n, :n] = coincide(
            slam._mean[:n],
            slam._covariance[:n, :n],
            slam._slots[kept],
            slam._slots[gone],
            frame=FRAMES[slam._frame],
            reference=None if at_estimate else slam._reference[:n],
        )
        self.remove([gone])


class _OwnAccess:
    """Through the filter's own methods."""

    def __init__(self, slam: Any) -> None:
        self._slam = slam

    def map_view(self, within: float = 0.0) -> MapView:
        if callable(getattr(self._slam, "view_around", None)):
            return _around(self._slam, within)
        return view_of(self._slam)

    def remove(self, ids: Sequence[int]) -> None:
        self._slam.remove(ids)

    def merge(self, kept: int, gone: int) -> None:
        self._slam.merge(kept, gone)


class _StateAccess:
    """Through the saved state, for filters that are not known from inside."""

    def __init__(self, slam: SlamEstimator) -> None:
        self._slam = slam

    def map_view(self, within: float = 0.0) -> MapView:
        return view_of(self._slam)

    def remove(self, ids: Sequence[int]) -> None:
        self._load_without(self._slam.state_dict(), ids)

    def merge(self, kept: int, gone: int) -> None:
        state = self._slam.state_dict()
        order = np.asarray(state["landmark_ids"]).tolist()
        state["mean"], state["covariance"] = coincide(
            np.asarray(state["mean"]),
            np.asarray(state["covariance"]),
            order.index(kept),
            order.index(gone),
            frame=self._slam.belief().frame,
        )
        self._load_without(state, [gone])

    def _load_without(self, state: dict[str, Any], ids: Sequence[int]) -> None:
        order = np.asarray(state["landmark_ids"]).tolist()
        slots = [order.index(i) for i in ids]
        for key in {"mean", "covariance", "reference"} & set(state):
            state[key] = without_landmarks(np.asarray(state[key]), slots)
        state["landmark_ids"] = np.delete(np.asarray(state["landmark_ids"]), slots)
        self._slam.load_state_dict(state)


def _refill(array: Array, content: Array) -> None:
    """Put a smaller array into a larger one, zeros behind it."""
    array[...] = 0.0
    array[tuple(slice(size) for size in content.shape)] = content
