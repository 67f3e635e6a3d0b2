"""The closed submaps of a run: kept as they were closed, joined when somebody asks."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from ...error_frames import ErrorFrame
from .frame_initialisation import Outline, Placing, outline_of, points_seen
from .joining import Gaussian, JoinedMap
from .merging import merged
from .neighbourhood import Extent
from .store import Submap, SubmapStore

Array = NDArray[np.float64]
Int = NDArray[np.int64]

ROUGHLY = 0.1


class ClosedSubmaps:
    """All closed submaps, and the map that they make together.

    Parameters
    ----------
    store : SubmapStore
        Where they are.
    frame : {"additive", "invariant"}
        Coordinates of their errors.
    renamed : mapping, optional
        Slots of landmarks found to be others, and the slots of these.
    outlines : sequence of Outline, optional
        Of the submaps that the store holds already.
    """

    def __init__(
        self,
        store: SubmapStore,
        frame: ErrorFrame,
        renamed: Mapping[int, int] | None = None,
        outlines: Sequence[Outline] = (),
    ) -> None:
        self.store, self._frame = store, frame
        self.renamed = dict(renamed or {})
        self.outlines = list(outlines)
        self.slots: set[int] = set().union(*(o.slots.tolist() for o in outlines))
        """Of the landmarks that they hold, links included."""
        self._placing = Placing()
        self._joined: JoinedMap | None = None
        self._whole: tuple[Int, Gaussian] | None = None

    def __len__(self) -> int:
        return len(self.outlines)

    @property
    def nbytes(self) -> int:
        """Memory that submaps and what joins them take [bytes]."""
        outlines = sum(outline.nbytes for outline in self.outlines)
        joined = 0 if self._joined is None else self._joined.nbytes
        whole = 0 if self._whole is None else self._whole[1].covariance.nbytes
        return self.store.nbytes + outlines + joined + whole

    def load(self, index: int) -> Submap:
        """Return a submap; its arrays are not to be written to."""
        submap = self.store.load(index)
        return merged(submap, self.renamed, self._frame) if self.renamed else submap

    def append(self, submap: Submap) -> None:
        """Keep one more."""
        self.store.append(submap)
        self.outlines.append(outline_of(submap))
        self.slots.update(submap.slots.tolist())
        self._forget_joined()

    def with_merged(self, kept: int, gone: int) -> "ClosedSubmaps":
        """Return the same submaps, one slot standing for another from now on.

        Raises
        ------
        numpy.linalg.LinAlgError
            Where a submap can say nothing of their distance.
        """
        if gone not in self.slots:
            return self
        earlier = {old: kept for old, new in self.renamed.items() if new == gone}
        renamed = self.renamed | earlier | {gone: kept}
        outlines = [
            outline_of(merged(self.store.load(k), renamed, self._frame))
            if gone in outline.slots
            else outline
            for k, outline in enumerate(self.outlines)
        ]
        return ClosedSubmaps(self.store, self._frame, renamed, outlines)

    def join(self, known: Array) -> JoinedMap:
        """Join them, given the first frames; what is joined holds until one is added.

        Parameters
        ----------
        known : ndarray, shape (J + 1, 3)
            At least that of the start, where Gauss-Newton begins.
        """
        if self._joined is None:
            frames = self._placing.frames(self.outlines, known, self._settle)
            self._joined = JoinedMap(self.load, self.outlines, self._frame, frames)
        return self._joined

    def marginal(self, slots: Int, known: Array) -> Gaussian:
        """Return the last frame and some of their landmarks, given the first frame."""
        if not self.outlines:
            return Gaussian(known[0], np.zeros((3, 3)))
        return self.join(known).marginal(slots)

    def near(
        self, slots: Int, count: int, extent: Extent, known: Array
    ) -> tuple[Int, Extent]:
        """Return which of some landmarks lie within an extent, and what it is then.

        Parameters
        ----------
        slots : ndarray, shape (n,)
            Of these landmarks.
        count : int
            Of all slots.
        extent : Extent
        known : ndarray, shape (J + 1, 3)
            As for :meth:`join`.
        """
        if not len(slots):
            return slots, extent
        points = points_seen(self.outlines, self.join(known).frames, count)[slots]
        chosen, extent = extent.chosen(points)
        return slots[chosen], extent

    def everything(self, slots: Int, known: Array) -> Gaussian:
        """Return the same of so many landmarks that it is worth to be remembered."""
        if self._whole is None or not np.array_equal(self._whole[0], slots):
            self._whole = slots, self.marginal(slots, known)
        return self._whole[1]

    def forget_frames(self) -> None:
        """Begin with placing the frames from the start."""
        self._placing = Placing()
        self._forget_joined()

    def _forget_joined(self) -> None:
        self._joined = self._whole = None

    def _settle(self, first: int, last: int, frames: Array) -> Array:
        """Join some submaps by themselves, roughly; return their frames."""
        return JoinedMap(
            lambda index: self.load(first + index),
            self.outlines[first:last],
            self._frame,
            frames,
            ROUGHLY,
        ).frames
