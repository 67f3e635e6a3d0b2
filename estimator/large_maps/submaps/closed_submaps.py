"""The closed submaps of a run, joined when a belief asks for them."""

from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np

from ....arrays import Array, IntArray
from ...models.rigid_motion import ErrorFrame
from ...support.undo import Undo
from .frame_initialisation import (
    FrameInitialisation,
    SubmapSummary,
    points_seen,
    summarise,
)
from .gaussian import Gaussian
from .joining import JoinedMap
from .merging import merged
from .neighbourhood import Region
from .store import Submap, SubmapStore

ROUGHLY_CONVERGED = 0.1
"""Decrement at which to stop while computing initial frames."""


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
    """

    def __init__(
        self,
        store: SubmapStore,
        frame: ErrorFrame,
        renamed: Mapping[int, int] | None = None,
        summaries: Sequence[SubmapSummary] = (),
    ) -> None:
        self.store, self._frame = store, frame
        self.renamed = dict(renamed or {})
        self.summaries = list(summaries)
        self.slots: set[int] = set().union(*(s.slots.tolist() for s in summaries))
        """Slots of the landmarks in the submaps, including links."""
        self._initialisation = FrameInitialisation()
        self._joined: JoinedMap | None = None
        self._whole: tuple[IntArray, Gaussian] | None = None

    def __len__(self) -> int:
        return len(self.summaries)

    @property
    def nbytes(self) -> int:
        """Memory of the submaps and the joined map [bytes]."""
        summaries = sum(summary.nbytes for summary in self.summaries)
        joined = 0 if self._joined is None else self._joined.nbytes
        whole = 0 if self._whole is None else self._whole[1].covariance.nbytes
        return self.store.nbytes + summaries + joined + whole

    def load(self, index: int) -> Submap:
        """Return a submap; its arrays must not be modified."""
        submap = self.store.load(index)
        return merged(submap, self.renamed, self._frame) if self.renamed else submap

    def with_appended(self, submap: Submap) -> "ClosedSubmaps":
        """Return the same submaps with one more, which is stored."""
        self.store.append(submap)
        summaries = [*self.summaries, summarise(submap)]
        longer = ClosedSubmaps(self.store, self._frame, self.renamed, summaries)
        longer._initialisation = self._initialisation.copy()
        return longer

    def checkpoint(self) -> Undo:
        """Return what takes back which submaps are stored."""
        return partial(self.store.truncate, len(self))

    def with_merged(self, kept: int, gone: int) -> "ClosedSubmaps":
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
            summarise(merged(self.store.load(k), renamed, self._frame))
            if gone in summary.slots
            else summary
            for k, summary in enumerate(self.summaries)
        ]
        return ClosedSubmaps(self.store, self._frame, renamed, summaries)

    def join(self, known: Array) -> JoinedMap:
        """Return the joined map; it is cached until a submap is appended.

        Parameters
        ----------
        known : ndarray, shape (J + 1, 3)
            The first frames, at least the start: initial values of Gauss-Newton.
        """
        if self._joined is None:
            frames = self._initialisation.frames(self.summaries, known, self._refined)
            self._joined = JoinedMap(self.load, self.summaries, self._frame, frames)
        return self._joined

    def marginal(
        self, slots: IntArray, known: Array, *, remember: bool = False
    ) -> Gaussian:
        """Return the last frame and some landmarks, given the first frame.

        Parameters
        ----------
        slots : ndarray, shape (n,)
            Of the landmarks.
        known : ndarray, shape (J + 1, 3)
            As for :meth:`join`.
        remember : bool
            Whether to cache the result until a submap is appended.
        """
        if not self.summaries:
            return Gaussian(known[0], np.zeros((3, 3)))
        if not remember:
            return self.join(known).marginal(slots)
        if self._whole is None or not np.array_equal(self._whole[0], slots):
            self._whole = slots, self.join(known).marginal(slots)
        return self._whole[1]

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
        points = points_seen(self.summaries, self.join(known).frames, count)[slots]
        chosen, region = region.chosen(points)
        return slots[chosen], region

    def discard_frames(self) -> None:
        """Discard the cached frames and the joined map."""
        self._initialisation = FrameInitialisation()
        self._joined = self._whole = None

    def _refined(self, first: int, last: int, frames: Array) -> Array:
        """Return the frames of some submaps, joined with a coarse tolerance."""
        return JoinedMap(
            lambda index: self.load(first + index),
            self.summaries[first:last],
            self._frame,
            frames,
            ROUGHLY_CONVERGED,
        ).frames
