"""Edit the map of any filter: remove landmarks, merge two of them, read parts of it.

`MapEditor` edits the map; :func:`.interface.view_map` reads it.  Filters that keep the
arrays of :class:`EkfSlam` are edited in place, without a copy of the whole covariance.
Others may support some of these, each by itself:

* ``belief(landmark_ids)`` returns the marginal of the pose and these landmarks;
* ``landmark_ids`` lists the mapped landmarks in the order of the belief;
* ``remove(landmark_ids)`` marginalises landmarks and changes nothing else;
* ``merge(kept, gone)`` conditions on two landmarks being one, and removes the second;
* ``merge_pairs(pairs)`` does so with several pairs by one measurement;
* ``local_view(within)`` returns the pose and at least those landmarks that are within
  this many metres of it, where a view of all of them takes long;
* ``viewed``, beside it, is what such views change, and takes an earlier value back.

What a filter lacks goes through ``belief()``, ``state_dict()`` and
``load_state_dict()``.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np

from ...arrays import Array
from ..filters.gaussian_map import without_landmarks
from ..filters.pose_readings import coincide
from ..interface import (
    MapView,
    SlamEstimator,
    hides_its_belief,
    restore,
    returned_on_error,
    view_map,
)

#: What the saved state of a filter must hold so that its belief can be changed.
DENSE = "mean", "covariance", "landmark_ids"


class MapEditor:
    """Reads and edits the map of a filter; keeps its view of the map until it expires.

    It calls the fastest methods that the filter has.

    Parameters
    ----------
    slam : SlamEstimator
    merging : bool
        Whether landmarks have to be merged, too.

    Raises
    ------
    TypeError
        If the filter has neither these methods nor a state that can be edited.
    """

    def __init__(self, slam: SlamEstimator, *, merging: bool = True) -> None:
        self._slam: Any = slam
        self._view: MapView | None = None
        self._within = 0.0
        #: Whether the filter can show only the landmarks around the robot.
        self.is_local = hasattr(slam, "local_view")
        # That of a wrapper is a method of the filter inside.
        self._viewer: Any = getattr(getattr(slam, "local_view", None), "__self__", None)
        wanted = ("remove", "merge") if merging else ("remove",)
        has_all = all(hasattr(slam, name) for name in wanted)
        self._has_methods = has_all and not hides_its_belief(slam)
        if self._has_methods:
            return
        can_save = hasattr(slam, "state_dict") and hasattr(slam, "load_state_dict")
        if not can_save or not {*DENSE} <= set(slam.state_dict()):
            methods = "methods remove and merge" if merging else "method remove"
            raise TypeError(
                f"{type(slam).__name__} cannot be managed, as readings without "
                f"identities require: it needs the {methods}, or state_dict() and "
                f"load_state_dict() with {', '.join(DENSE)}"
            )

    def map_view(self, within: float | None = None) -> MapView:
        """Return a view of pose and map; it is valid until the filter's next step.

        Landmarks farther away than ``within`` [m] may be left out; by default, this is
        the distance of the last time.
        """
        reach = self._within if within is None else within
        if self._view is None or reach > self._within:
            if self._has_methods and self.is_local:
                self._view = self._slam.local_view(reach)
            else:
                self._view = view_map(self._slam)
        self._within = reach
        return self._view

    @property
    def viewed(self) -> tuple[float, Any]:
        """What views change here, and in a filter that notes them."""
        return self._within, getattr(self._viewer, "viewed", None)

    @viewed.setter
    def viewed(self, before: tuple[float, Any]) -> None:
        self._view, (self._within, noted) = None, before
        if noted is not None:
            self._viewer.viewed = noted

    def expire(self) -> None:
        """Forget the view, since the filter has taken a step."""
        self._view = None

    def remove(self, ids: Sequence[int]) -> None:
        """Marginalise landmarks; all else is unchanged to the last bit."""
        self.expire()
        if self._has_methods:
            self._slam.remove(ids)
        else:
            self._load_without(self._slam.state_dict(), ids)

    def merge_pairs(self, pairs: Sequence[tuple[int, int]]) -> None:
        """Condition on pairs of landmarks being one, and remove the second of each."""
        self.expire()
        if not self._has_methods:
            self._merge_in_state(pairs)
        elif hasattr(self._slam, "merge_pairs"):
            self._slam.merge_pairs(pairs)
        elif len(pairs) == 1:
            self._slam.merge(*pairs[0])
        else:
            with returned_on_error(self._slam):
                for kept, gone in pairs:
                    self._slam.merge(kept, gone)

    @cached_property
    def can_move(self) -> bool:
        """Whether :meth:`replace_belief` can change the belief."""
        state = self._slam.state_dict()
        if hasattr(self._slam, "observe_truth") or not {*DENSE} <= set(state):
            return False
        belief = self._slam.belief()
        ids, places = np.array(belief.landmark_ids), belief.mean[3:]
        same = (ids, state["landmark_ids"]), (places, state["mean"][3:])
        return all(np.array_equal(*both) for both in same)

    def replace_belief(self, mean: Array, covariance: Array) -> None:
        """Continue with another belief about the same landmarks, and its pose."""
        self.expire()
        state = self._slam.state_dict() | {"mean": mean, "covariance": covariance}
        if "reference" in state:
            state["reference"][:3] = mean[:3]
        restore(self._slam, state)

    def _merge_in_state(self, pairs: Sequence[tuple[int, int]]) -> None:
        state = self._slam.state_dict()
        order = np.asarray(state["landmark_ids"]).tolist()
        state["mean"], state["covariance"] = coincide(
            np.asarray(state["mean"]),
            np.asarray(state["covariance"]),
            [order.index(kept) for kept, _ in pairs],
            [order.index(gone) for _, gone in pairs],
            frame=self._slam.belief().frame,
        )
        self._load_without(state, [gone for _, gone in pairs])

    def _load_without(self, state: dict[str, Any], ids: Sequence[int]) -> None:
        order = np.asarray(state["landmark_ids"]).tolist()
        slots = [order.index(i) for i in ids]
        for key in {"mean", "covariance", "reference"} & set(state):
            state[key] = without_landmarks(np.asarray(state[key]), slots)
        state["landmark_ids"] = np.delete(np.asarray(state["landmark_ids"]), slots)
        self._slam.load_state_dict(state)
