"""What lies around the robot: pose and near landmarks in an ordinary filter.

To tell what a reading is of, and whether two landmarks are one, takes the covariance of
the pose with the landmarks around it, in every step; to join the submaps in every step
would take far too long.  So whenever a submap is closed, the map is joined and its part
around the robot is copied into an invariant filter, which then takes the steps too.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...filters.invariant import InvariantEkfSlam
from ...interface import Belief, MapView, UpdateReport
from ...support import argument_checks
from ...support.argument_checks import LandmarkIds
from .store import LostSubmapError

Array = NDArray[np.float64]
Int = NDArray[np.int64]

MOST = 1000
"""Landmarks of closed submaps that are looked at, the nearest."""
FARTHER = 2.0
"""How much farther is looked than has been asked for, so that it holds for a while."""
RECENT = 10
"""Scans that tell how far is looked when it is taken anew."""


class Region(NamedTuple):
    """How far a vicinity reaches."""

    centre: Array
    """Where the robot was when it was surveyed, shape (2,) [m]."""
    reach: float
    """How far from the robot landmarks were to be found in it at least [m]."""
    slack: float
    """By how much landmarks may be nearer than they seem to be [m]."""
    is_all: bool = False
    """Whether there is nothing farther away."""
    farthest: float = np.inf
    """Distance of the last landmark in it where there were too many [m]."""

    @property
    def radius(self) -> float:
        """Of the landmarks around the centre that it holds [m]."""
        wanted = np.inf if self.is_all else FARTHER * (self.reach + self.slack)
        return min(wanted, self.farthest)

    def covers(self, position: Array, within: float) -> bool:
        """Tell whether it holds all that is within a distance of a position (2,)."""
        away = float(np.hypot(*(position - self.centre)))
        return away + within + self.slack <= self.radius

    def chosen(self, points: Array) -> tuple[Int, Region]:
        """Return which of some landmarks (n, 2) lie within, the nearest if many.

        Of many, also the extent that those have.
        """
        distance = np.hypot(*(points - self.centre).T)
        inside = np.flatnonzero(distance <= self.radius)
        if len(inside) <= MOST:
            return inside, self
        nearest = inside[np.argsort(distance[inside], kind="stable")[:MOST]]
        farthest = float(distance[nearest[-1]])
        return np.sort(nearest), self._replace(farthest=farthest)


Survey = Callable[[float], tuple[Belief, Region]]


class Neighbourhood:
    """A part of the joined map, which an ordinary filter carries on once it is asked.

    Before that, and after :meth:`forget`, it does nothing.

    Parameters
    ----------
    make : callable
        Makes the filter, whose readings are to pass no gate.
    survey : callable
        Gives the joined belief around the robot, so far as it is asked [m].
    """

    def __init__(self, make: Callable[[], InvariantEkfSlam], survey: Survey) -> None:
        self._make, self._survey = make, survey
        self.forget()

    def forget(self) -> None:
        """Start a new run."""
        self._slam: InvariantEkfSlam | None = None
        self._region = Region(np.zeros(2), 0.0, 0.0)
        # The farthest that was asked for or read with each of the last scans, and
        # since then [m].
        self._reaches = RECENT * [0.0]

    @property
    def nbytes(self) -> int:
        """Memory that its covariance takes [bytes]."""
        return 0 if self._slam is None else self._slam.map.covariance.nbytes

    def view(self, within: float) -> MapView:
        """Look at pose and near landmarks, without a copy.

        Parameters
        ----------
        within : float
            How far from the robot to look at least [m].
        """
        slam = self._slam
        if slam is None or not self._region.covers(slam.map.mean[:2], within):
            slam = self._take(*self._survey(max(within, *self._reaches)))
        self._reaches[-1] = max(within, self._reaches[-1])
        return slam.map_view()

    def renew(self) -> None:
        """Take it anew from the joined map; without one it goes on as it is."""
        if self._slam is not None:
            with suppress(np.linalg.LinAlgError, LostSubmapError):
                self._take(*self._survey(max(self._reaches)))

    def predict(self, odometry: ArrayLike, dt: float) -> None:
        """Move the robot."""
        if self._slam is not None:
            self._slam.predict(odometry, dt)

    def update(
        self, measurements: ArrayLike, ids: LandmarkIds | None, report: UpdateReport
    ) -> None:
        """Take in what a submap has taken in; known landmarks must be told by now.

        Parameters
        ----------
        measurements, ids
            The scan.
        report : UpdateReport
            Of the submap's filter; ``added_ids`` are those new to the whole map.
        """
        if self._slam is None or ids is None:
            return
        given = np.asarray(ids).ravel().tolist()
        refused = {*report.rejected_ids, *report.skipped_ids}
        rows = [row for row, i in enumerate(given) if i not in refused]
        readings, used = np.asarray(measurements)[rows], [given[row] for row in rows]
        if not used:
            return
        before = self._slam
        farthest = max(float(readings[:, 1].max()), self._reaches[-1])
        self._reaches = [*self._reaches[1:-1], farthest, 0.0]
        if not before.map.slots.keys() | set(report.added_ids) >= set(used):
            self.renew()
        if self._slam is before:  # else the scan is in it already
            try:
                before.update(readings, used)
            except np.linalg.LinAlgError:
                self.renew()

    def remove(self, ids: Sequence[int]) -> None:
        """Marginalise those landmarks that it holds."""
        if self._slam is None:
            return
        if held := [i for i in ids if i in self._slam.map.slots]:
            self._slam.remove(held)

    def merge(self, kept: int, gone: int) -> None:
        """Condition on two landmarks being one, after the submaps have been."""
        if self._slam is None:
            return
        held = {kept, gone}.intersection(self._slam.map.slots)
        if len(held) == 2:
            with suppress(np.linalg.LinAlgError):
                self._slam.merge(kept, gone)
        elif held:
            self.renew()
        self.remove([gone])

    def state_dict(self) -> dict[str, Any]:
        """Return copies of everything, as arrays; nothing where nobody has looked."""
        if self._slam is None:
            return {}
        extent = self._region
        numbers = [*extent.centre, extent.reach, extent.slack, extent.is_all]
        limits = np.array([*numbers, extent.farthest, *self._reaches])
        return self._slam.state_dict() | {"extent": limits}

    def restored(self, state: Mapping[str, Any]) -> Neighbourhood:
        """Make another from what :meth:`state_dict` returned."""
        other = Neighbourhood(self._make, self._survey)
        if state:
            argument_checks.refuse_other_state(state, ["extent"])
            limits = argument_checks.as_floats("state['extent']", state["extent"])
            if limits.shape != (6 + RECENT,) or np.isnan(limits).any():
                raise ValueError(
                    f"state['extent'] must be {6 + RECENT} numbers, got {limits}"
                )
            x, y, reach, slack, is_all, farthest, *other._reaches = limits.tolist()
            centre = np.array([x, y])
            other._region = Region(centre, reach, slack, bool(is_all), farthest)
            other._slam = self._make()
            other._slam.load_state_dict(
                {k: v for k, v in state.items() if k != "extent"}
            )
        return other

    def _take(self, belief: Belief, region: Region) -> InvariantEkfSlam:
        slam, P = self._make(), belief.covariance
        state = {
            "estimator": np.array(type(slam).__name__),
            "mean": belief.mean,
            "covariance": (P + P.T) / 2,
            "reference": belief.mean,
            "landmark_ids": np.array(belief.landmark_ids, dtype=np.int64),
        }
        slam.load_state_dict(state)
        self._slam, self._region = slam, region
        return slam
