"""Initial values of the frames of submaps, by divide and conquer.

Gauss-Newton needs initial values near the right minimum, and composing the frames one
by one drifts too far from it.  Blocks of submaps are therefore joined first, then
blocks of blocks, each in its own frame.  A block is then aligned as a rigid body with
the landmarks that it shares with the blocks before it.  Block boundaries follow the
binary digits of the number of submaps, so that most blocks can be reused when the map
grows by one submap.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from ....arrays import Array, IntArray
from ...models.rigid_motion import compose
from .factor import regularised
from .store import Submap

Refine = Callable[[int, int, Array], Array]

LARGEST_COMPOSED = 4
"""Up to this many submaps, composing their frames is accurate enough."""


class SubmapSummary(NamedTuple):
    """The part of a closed submap that stays in memory."""

    slots: IntArray
    """Its landmarks, shape (n,)."""
    mean: Array
    """As in the submap, shape (3 + 2n,)."""
    pose_covariance: Array
    """Covariance of its last pose, shape (3, 3)."""

    @property
    def nbytes(self) -> int:
        """Memory of the arrays [bytes]."""
        return sum(part.nbytes for part in self)


def summarise(submap: Submap) -> SubmapSummary:
    """Return the part of a submap that stays in memory."""
    return SubmapSummary(submap.slots, submap.mean, submap.covariance[:3, :3].copy())


class FrameInitialisation:
    """Initial frames, with a cache of joined blocks.

    The result depends only on the arguments, not on the cache.
    """

    def __init__(self) -> None:
        self._blocks: dict[tuple[int, int], Array] = {}

    def copy(self) -> "FrameInitialisation":
        """Return one with the same cache, for more submaps."""
        copied = FrameInitialisation()
        copied._blocks = dict(self._blocks)
        return copied

    def frames(
        self, summaries: Sequence[SubmapSummary], known: Array, refine: Refine
    ) -> Array:
        """Return initial values of all frames in the world, shape (K + 1, 3).

        Parameters
        ----------
        summaries : sequence of SubmapSummary
            The K closed submaps.
        known : ndarray, shape (J + 1, 3)
            Frames of an earlier join; at least the start.
        refine : callable
            Returns improved frames a to b, given (a, b, frames).
        """
        first = len(known) - 1
        frames, size = known, 1
        while 2 * size <= len(summaries) - first:
            size *= 2
        begin = first
        while begin < len(summaries):
            while begin + size > len(summaries):
                size //= 2
            block = self._block(summaries, begin, begin + size, refine)
            frames = _merged(summaries, begin - len(frames) + 1, frames, block)
            begin += size
        return frames

    def _block(
        self, summaries: Sequence[SubmapSummary], a: int, b: int, refine: Refine
    ) -> Array:
        """Return the frames a to b relative to frame a."""
        if (a, b) not in self._blocks:
            if b - a <= LARGEST_COMPOSED:
                frames = [np.zeros(3)]
                for summary in summaries[a:b]:
                    frames.append(compose(frames[-1], summary.mean[:3])[0])
                rough = np.array(frames)
            else:
                middle = (a + b) // 2
                left = self._block(summaries, a, middle, refine)
                right = self._block(summaries, middle, b, refine)
                rough = _merged(summaries, a, left, right)
                del self._blocks[a, middle], self._blocks[middle, b]
            self._blocks[a, b] = refine(a, b, rough)
        return self._blocks[a, b]


def points_seen(summaries: Sequence[SubmapSummary], frames: Array, count: int) -> Array:
    """Return the landmarks at the positions of the first submap that holds each.

    Parameters
    ----------
    summaries : sequence of SubmapSummary
    frames : ndarray, shape (K, 3) or more
        Of these submaps.
    count : int
        Number of slots.

    Returns
    -------
    ndarray, shape (count, 2)
        NaN for landmarks that no submap holds [m].
    """
    points = np.full((count, 2), np.nan)
    for summary, frame in zip(reversed(summaries), frames[len(summaries) - 1 :: -1]):  # noqa: B905
        mean = summary.mean
        seen = complex(*frame[:2]) + np.exp(1j * frame[2]) * (
            mean[3::2] + 1j * mean[4::2]
        )
        points[summary.slots] = seen.view(np.float64).reshape(-1, 2)
    return points


def _merged(
    summaries: Sequence[SubmapSummary], first: int, left: Array, right: Array
) -> Array:
    """Align the right frames with the left ones, which begin at submap ``first``."""
    middle = first + len(left) - 1
    start = left[-1]
    if middle > first:
        before = summaries[first:middle]
        after = summaries[middle : middle + len(right) - 1]
        count = 1 + max(int(o.slots.max(initial=0)) for o in [*before, *after])
        goal = points_seen(before, left, count)
        seen = points_seen(after, right, count)
        common = np.flatnonzero(~np.isnan(goal[:, 0] + seen[:, 0]))
        start = align(start, before[-1].pose_covariance, seen[common], goal[common])
    moved = np.array([compose(start, frame)[0] for frame in right])
    return np.concatenate([left[:-1], moved])


def align(start: Array, covariance: Array, seen: Array, landmarks: Array) -> Array:
    """Align a frame with landmarks by least squares.

    Each landmark has the same weight as the expected position of the frame.

    Parameters
    ----------
    start, covariance : ndarray, shapes (3,) and (3, 3)
        Expected frame.
    seen : ndarray, shape (n, 2)
        Landmarks in the frame [m].
    landmarks : ndarray, shape (n, 2)
        The same landmarks in the world [m].

    Returns
    -------
    ndarray, shape (3,)

    Examples
    --------
    >>> seen = np.array([[1.0, 0.0], [2.0, 0.0], [3.0, 1.0]])
    >>> align(np.zeros(3), np.diag([1.0, 1.0, 1e-9]), seen, seen + [0.0, 1.0]).round(2)
    array([0.  , 0.75, 0.  ])
    """
    prior = np.linalg.inv(regularised(covariance))
    weight = 2 / max(covariance[0, 0] + covariance[1, 1], 1e-18)
    q, goal = seen[:, 0] + 1j * seen[:, 1], landmarks[:, 0] + 1j * landmarks[:, 1]
    pose = start.copy()
    for _ in range(5):
        turned = np.exp(1j * pose[2]) * q
        error = goal - complex(*pose[:2]) - turned
        rows = np.zeros((2 * len(q), 3))
        rows[0::2, 0] = rows[1::2, 1] = 1.0
        rows[:, 2] = (1j * turned).view(np.float64)
        H = prior + weight * rows.T @ rows
        right = prior @ (start - pose) + weight * rows.T @ error.view(np.float64)
        pose = pose + np.linalg.solve(H, right)
    return pose
