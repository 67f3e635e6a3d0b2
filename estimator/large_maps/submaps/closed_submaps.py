"""The closed submaps of a run, joined when a belief asks for them.

`ClosedSubmaps` keeps and joins them, `Neighbourhood` follows the robot in a part of the
joined map, and `merged` merges landmarks within a submap.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from .... import argument_checks
from ....argument_checks import LandmarkIds
from ....arrays import Array, IntArray
from ...filters.ekf import InvariantEkfSlam
from ...filters.gaussian_map import without_landmarks
from ...filters.pose_readings import coincide
from ...guards import saved_states
from ...interface import Belief, MapView, UpdateReport
from ...models.rigid_motion import ErrorFrame
from ..undo import Undo, attributes
from . import joining
from .factor import Gaussian, retract
from .store import LostSubmapError, Submap, SubmapStore

NO_SLOTS: IntArray = np.empty(0, dtype=np.int64)
# For initial frames, Gauss-Newton stops at a decrement up to the first number. Up to
# the second, a step of ten standard deviations, it stops after one more step.
ROUGHLY_CONVERGED, NEARLY_CONVERGED = 0.1, 100.0


class ClosedSubmaps:
    """All closed submaps, and the map joined from them.

    Parameters
    ----------
    store : SubmapStore
    frame : {"additive", "invariant"}
        Coordinates of the submaps' errors.
    renamed : mapping, optional
        Slots of merged landmarks, and the slots that replace them.
    summaries : sequence of SubmapSummary, optional
        Of the submaps in the store.
    initialisation : FrameInitialisation, optional
        Their frames, as far as they are known.
    """

    def __init__(
        self,
        store: SubmapStore,
        frame: ErrorFrame,
        renamed: Mapping[int, int] | None = None,
        summaries: Sequence[joining.SubmapSummary] = (),
        initialisation: joining.FrameInitialisation | None = None,
    ) -> None:
        self.store, self._frame = store, frame
        self.renamed = dict(renamed or {})
        self.summaries = list(summaries)
        #: Slots of the landmarks in the submaps, including links.
        self.slots: set[int] = set().union(*(s.slots.tolist() for s in summaries))
        self._initialisation = initialisation or joining.FrameInitialisation()
        self._joined: joining.JoinedMap | None = None
        #: Landmarks of the last `marginal` to remember, and their marginal if cached.
        self._whole: tuple[IntArray, Gaussian | None] = NO_SLOTS, None

    def __len__(self) -> int:
        return len(self.summaries)

    @property
    def nbytes(self) -> int:
        """Memory of the submaps and the joined map [bytes]."""
        summaries = sum(summary.nbytes for summary in self.summaries)
        joined = 0 if self._joined is None else self._joined.nbytes
        whole = 0 if self._whole[1] is None else self._whole[1].covariance.nbytes
        return self.store.nbytes + summaries + joined + whole

    def load(self, index: int) -> Submap:
        """Return a submap; its arrays must not be modified."""
        submap = self.store.load(index)
        return merged(submap, self.renamed, self._frame) if self.renamed else submap

    def with_appended(self, submap: Submap) -> ClosedSubmaps:
        """Return the same submaps with one more, which is stored."""
        self.store.append(submap)
        summaries = [*self.summaries, joining.summarise(submap)]
        frames = joining.FrameInitialisation(self._initialisation.blocks)
        return ClosedSubmaps(self.store, self._frame, self.renamed, summaries, frames)

    def checkpoint(self) -> Undo:
        """Return what takes back which submaps are stored."""
        return partial(self.store.truncate, len(self))

    def with_merged(self, kept: int, gone: int) -> ClosedSubmaps:
        """Return the same submaps with one slot replaced by another.

        Raises
        ------
        numpy.linalg.LinAlgError
            If the covariance of the landmarks' distance is singular in a submap.
        """
        if gone not in self.slots:
            return self
        earlier = {old: kept for old, new in self.renamed.items() if new == gone}
        renamed = self.renamed | earlier | {gone: kept}
        summaries = [
            joining.summarise(merged(self.store.load(k), renamed, self._frame))
            if gone in summary.slots
            else summary
            for k, summary in enumerate(self.summaries)
        ]
        return ClosedSubmaps(self.store, self._frame, renamed, summaries)

    def join(self, known: Array) -> joining.JoinedMap:
        """Return the joined map; it is cached until a submap is appended.

        Parameters
        ----------
        known : ndarray, shape (J + 1, 3)
            The first frames, at least the start: initial values of Gauss-Newton.
        """
        if self._joined is None:
            frames = self._initialisation.frames(self.summaries, known, self._refined)
            self._joined = joining.JoinedMap(
                self.load, self.summaries, self._frame, frames
            )
        return self._joined

    def marginal(
        self, slots: IntArray, known: Array, *, remember: bool = False
    ) -> Gaussian:
        """Return the last frame and some landmarks, given the first frame.

        The caller may overwrite the covariance.

        Parameters
        ----------
        slots : ndarray, shape (n,)
            Of the landmarks.
        known : ndarray, shape (J + 1, 3)
            As for :meth:`join`.
        remember : bool
            Whether to cache the result until a submap is appended. It is cached at the
            second successive call for these landmarks.
        """
        if not self.summaries:
            return Gaussian(known[0], np.zeros((3, 3)))
        before, found = self._whole
        if not remember or not np.array_equal(before, slots):
            self._whole = (slots, None) if remember else self._whole
            return self.join(known).marginal(slots)
        if found is None:
            found = self.join(known).marginal(slots)
            self._whole = slots, found
        return found._replace(covariance=found.covariance.copy())

    def near(
        self, slots: IntArray, count: int, region: Region, known: Array
    ) -> tuple[IntArray, Region]:
        """Return which of some landmarks lie within a region, and the actual region.

        Parameters
        ----------
        slots : ndarray, shape (n,)
            Of these landmarks.
        count : int
            Number of all slots.
        region : Region
        known : ndarray, shape (J + 1, 3)
            As for :meth:`join`.
        """
        if not len(slots):
            return slots, region
        points = joining.points_seen(self.summaries, self.join(known).frames, count)
        chosen, region = region.chosen(points[slots])
        return slots[chosen], region

    def discard_frames(self) -> None:
        """Discard the cached frames and the joined map."""
        self._initialisation = joining.FrameInitialisation()
        self._joined, self._whole = None, (NO_SLOTS, None)

    def _refined(self, first: int, last: int, frames: Array) -> Array:
        """Return the frames of some submaps, joined with a coarse tolerance."""
        return joining.JoinedMap(
            lambda index: self.load(first + index),
            self.summaries[first:last],
            self._frame,
            frames,
            ROUGHLY_CONVERGED,
            NEARLY_CONVERGED,
        ).frames


# --------------------------------------------------------------------------------------
# Pose and near landmarks of the joined map, followed by an ordinary filter.
#
# Data association and merging need the covariance of the pose and the landmarks around
# it in every step, and joining the submaps in every step would be too slow.  The part
# of the joined map around the robot is therefore copied into an invariant filter, which
# then processes each step too.  The copy is replaced whenever a submap is closed.

LARGEST_COUNT = 1000  # largest number of landmarks of closed submaps in a neighbourhood
# Ratio of the copied to the required distance, so that a copy lasts for a while.
MARGIN = 2.0
# Number of scans whose ranges determine the required distance of the next copy.
RECENT_SCANS = 10


class Region(NamedTuple):
    """The disc that a neighbourhood covers."""

    centre: Array  # position of the robot when the copy was made, shape (2,) [m]
    reach: float  # required distance from the robot [m]
    slack: float  # uncertainty of the distances [m]
    is_all: bool = False  # whether the copy holds all landmarks
    # Distance of the last landmark, if their number was limited [m].
    farthest: float = np.inf

    @property
    def radius(self) -> float:
        """Radius of the disc [m]."""
        wanted = np.inf if self.is_all else MARGIN * (self.reach + self.slack)
        return min(wanted, self.farthest)

    def covers(self, position: Array, within: float) -> bool:
        """Return whether the disc holds all within a distance of a position (2,)."""
        away = float(np.hypot(*(position - self.centre)))
        return away + within + self.slack <= self.radius

    def chosen(self, points: Array) -> tuple[IntArray, Region]:
        """Return which landmarks (n, 2) lie in the disc, and the disc.

        If there are too many, the nearest and a smaller disc.
        """
        distance = np.hypot(*(points - self.centre).T)
        inside = np.flatnonzero(distance <= self.radius)
        if len(inside) <= LARGEST_COUNT:
            return inside, self
        nearest = inside[np.argsort(distance[inside], kind="stable")[:LARGEST_COUNT]]
        farthest = float(distance[nearest[-1]])
        return np.sort(nearest), self._replace(farthest=farthest)


JoinedRegion = Callable[[float], tuple[Belief, Region]]


class _Copy(NamedTuple):
    """A part of the joined map, and the filter that follows the robot in it."""

    slam: InvariantEkfSlam
    region: Region


class Neighbourhood:
    """A part of the joined map; empty until :meth:`view` is called.

    Parameters
    ----------
    make : callable
        Returns a filter without a gate.
    joined_region : callable
        Returns the joined belief around the robot within at least a distance [m].
    saved : tuple, optional
        Copy and distances to continue from.
    """

    def __init__(
        self,
        make: Callable[[], InvariantEkfSlam],
        joined_region: JoinedRegion,
        saved: tuple[_Copy, list[float]] | None = None,
    ) -> None:
        self._make, self._joined_region = make, joined_region
        self._copy: _Copy | None = None
        self.forget()
        if saved is not None:
            self._copy, self._reaches = saved

    def forget(self) -> None:
        """Discard the copy, for a new run."""
        self._copy = None
        # Largest distance asked for or measured with each recent scan; the last entry
        # is for the time since the last scan [m].
        self._reaches = RECENT_SCANS * [0.0]

    @property
    def nbytes(self) -> int:
        """Memory of the covariance [bytes]."""
        return 0 if self._copy is None else self._copy.slam.map.covariance.nbytes

    def view(self, within: float) -> MapView:
        """Return pose and near landmarks, without copying arrays.

        Parameters
        ----------
        within : float
            Distance from the robot that the view covers at least [m].
        """
        copy = self._copy
        if copy is None or not copy.region.covers(copy.slam.map.mean[:2], within):
            copy = self._renewed(max(within, *self._reaches))
        self._reaches = [*self._reaches[:-1], max(within, self._reaches[-1])]
        return copy.slam.map_view()

    @property
    def viewed(self) -> tuple[_Copy | None, list[float]]:
        """What :meth:`view` changes."""
        return self._copy, self._reaches

    @viewed.setter
    def viewed(self, before: tuple[_Copy | None, list[float]]) -> None:
        self._copy, self._reaches = before

    def checkpoint(self) -> Undo:
        """Return what takes back later changes, but for the steps of the filter."""
        return attributes(self, *([] if self._copy is None else [self._copy.slam.map]))

    def renew(self) -> None:
        """Replace the copy, if there is one and the submaps can be joined."""
        if self._copy is not None:
            with suppress(np.linalg.LinAlgError, LostSubmapError):
                self._renewed(max(self._reaches))

    def predict(self, odometry: ArrayLike, dt: float) -> None:
        """Move the robot."""
        if self._copy is not None:
            self._copy.slam.predict(odometry, dt)

    def update(
        self, measurements: ArrayLike, ids: LandmarkIds | None, report: UpdateReport
    ) -> None:
        """Process the measurements that the active submap has used.

        Parameters
        ----------
        measurements, ids
            The scan.
        report : UpdateReport
            Of the submap's filter, with ``added_ids`` new to the whole map.
        """
        if self._copy is None or ids is None:
            return
        refused = {*report.rejected_ids, *report.skipped_ids}
        used = {k: i for k, i in enumerate(np.ravel(ids).tolist()) if i not in refused}
        if used:
            readings = np.asarray(measurements)[list(used)]
            self._correct(self._copy, readings, list(used.values()), report.added_ids)

    def _correct(
        self, before: _Copy, readings: Array, ids: list[int], new: Sequence[int]
    ) -> None:
        """Correct the copy; replace it if it lacks a landmark or the update fails."""
        farthest = max(float(readings[:, 1].max()), self._reaches[-1])
        self._reaches = [*self._reaches[1:-1], farthest, 0.0]
        if not before.slam.map.slots.keys() | set(new) >= set(ids):
            self.renew()
        if self._copy is before:  # a new copy contains the scan already
            try:
                before.slam.update(readings, ids)
            except np.linalg.LinAlgError:
                self.renew()

    def remove(self, ids: Sequence[int]) -> None:
        """Marginalise landmarks, as far as the copy holds them."""
        if self._copy is None:
            return
        slam = self._copy.slam
        if held := [i for i in ids if i in slam.map.slots]:
            slam.remove(held)

    def merge_pairs(self, pairs: Sequence[tuple[int, int]]) -> None:
        """Condition on pairs of landmarks being one, after the submaps have been.

        Several pairs close a loop: the copy is replaced, since joining the submaps is
        more accurate than a linear step.
        """
        if self._copy is None:
            return
        slam, ids = self._copy.slam, {i for pair in pairs for i in pair}
        held = ids.intersection(slam.map.slots)
        if len(held) == 2 == len(ids):
            with suppress(np.linalg.LinAlgError):
                slam.merge_pairs(pairs)
        elif held:
            self.renew()
        self.remove([gone for _, gone in pairs])

    def state_dict(self) -> dict[str, Any]:
        """Return copies of the whole state as arrays; empty without a copy."""
        if self._copy is None:
            return {}
        slam, region = self._copy
        limits = [*region.centre, region.reach, region.slack, region.is_all]
        numbers = np.array([*limits, region.farthest, *self._reaches])
        return slam.state_dict() | {"extent": numbers}

    def restored(self, state: Mapping[str, Any]) -> Neighbourhood:
        """Return a neighbourhood that continues from a saved state."""
        if not state:
            return Neighbourhood(self._make, self._joined_region)
        saved_states.refuse_other_state(state, ["extent"])
        numbers = argument_checks.as_floats("state['extent']", state["extent"])
        if numbers.shape != (6 + RECENT_SCANS,) or not _is_extent(numbers):
            raise ValueError(
                f"state['extent'] must be a finite position and {4 + RECENT_SCANS} "
                f"numbers >= 0, the third of them 0 or 1, got {numbers}"
            )
        x, y, reach, slack, is_all, farthest, *reaches = numbers.tolist()
        region = Region(np.array([x, y]), reach, slack, bool(is_all), farthest)
        slam = self._make()
        slam.load_state_dict({k: v for k, v in state.items() if k != "extent"})
        saved = _Copy(slam, region), reaches
        return Neighbourhood(self._make, self._joined_region, saved)

    def _renewed(self, reach: float) -> _Copy:
        """Replace the copy by one that covers at least a distance [m]."""
        belief, region = self._joined_region(reach)
        slam, P = self._make(), belief.covariance
        state = {
            "estimator": np.array(type(slam).__name__),
            "mean": belief.mean,
            "covariance": (P + P.T) / 2,
            "reference": belief.mean,
            "landmark_ids": np.array(belief.landmark_ids, dtype=np.int64),
        }
        slam.restore(state)
        self._copy = copy = _Copy(slam, region)
        return copy


def _is_extent(numbers: Array) -> bool:
    """Return whether numbers may be a region and the distances after it."""
    return bool(
        np.isfinite(numbers[:2]).all()
        and (numbers[2:] >= 0).all()
        and numbers[4] in (0, 1)
    )


# --------------------------------------------------------------------------------------
# Merging of landmarks within a submap: a measurement of zero distance.
#
# A closed submap is never rewritten.  Landmarks are merged whenever the submap is read,
# so that the result depends only on the submap and on the list of merged landmarks.


def merged(submap: Submap, renamed: Mapping[int, int], frame: ErrorFrame) -> Submap:
    """Return a submap with merged landmarks in one slot.

    If the submap holds both landmarks, it is conditioned on l_i = l_j.  This is linear
    in the coordinates of its error, with H = [… I … −I …] in either frame::

        0 = l_i − l_j = R(t) (l̂_i − l̂_j) + V(t) (ξ_i − ξ_j)

    where t is the error of the heading, about which the measurement has no information.

    Parameters
    ----------
    submap : Submap
        As stored.
    renamed : mapping
        Slots of merged landmarks, and the slots that replace them.
    frame : {"additive", "invariant"}
        Coordinates of the submap's error.

    Raises
    ------
    numpy.linalg.LinAlgError
        If the covariance of the distance of two landmarks is singular.

    Examples
    --------
    >>> P = np.diag([1.0, 1.0, 0.0, 1.0, 1.0, 1.0, 1.0])
    >>> twice = Submap(np.array([3, 8]), np.array([0, 0, 0, 4.0, 0, 6.0, 0]), P)
    >>> once = merged(twice, {8: 3}, "additive")
    >>> once.slots, once.mean[3:], once.covariance.diagonal()[3:]
    (array([3]), array([5., 0.]), array([0.5, 0.5]))
    """
    before = submap.slots.tolist()
    slots = [renamed.get(slot, slot) for slot in before]
    if slots == before:
        return submap
    mean, covariance = submap.mean, submap.covariance
    first: dict[int, int] = {}
    gone: list[int] = []
    for place, slot in enumerate(slots):
        kept = first.setdefault(slot, place)
        if kept != place:
            corrected = coincide(mean, covariance, kept, place)
            mean = retract(mean, corrected.mean - mean, frame)
            covariance = corrected.covariance
            gone.append(place)
    return Submap(
        np.array(list(first), dtype=np.int64),
        without_landmarks(mean, gone),
        without_landmarks(covariance, gone),
    )
