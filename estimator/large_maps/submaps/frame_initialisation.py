"""Where the frames of submaps are, roughly: a first guess, by divide and conquer.

Gauss-Newton needs a start from which it finds the right minimum, and composing the
frames one by one drifts too far from it.  So blocks of submaps are joined first, and
blocks of blocks, each in its own frame; a block then moves as a rigid body to where the
landmarks that it shares with the blocks before it want it.  Blocks are aligned like the
digits of a binary number, so that most of them are there already when the map has grown
by one.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .factor import compose, floor
from .store import Submap

Array = NDArray[np.float64]
Int = NDArray[np.int64]
Settle = Callable[[int, int, Array], Array]

FEW = 4
"""Submaps whose frames may simply be composed."""


class Outline(NamedTuple):
    """What is kept at hand of a closed submap."""

    slots: Int
    """Its landmarks, shape (n,)."""
    mean: Array
    """As in the submap, shape (3 + 2n,)."""
    spread: Array
    """Covariance of its last pose, shape (3, 3)."""

    @property
    def nbytes(self) -> int:
        """Memory that it takes [bytes]."""
        return sum(part.nbytes for part in self)


def outline_of(submap: Submap) -> Outline:
    """Return what is kept at hand of a submap."""
    return Outline(submap.slots, submap.mean, submap.covariance[:3, :3].copy())


class Placing:
    """Guesses frames, and remembers the blocks that it joined.

    What it answers depends on its arguments alone, not on what it remembers.
    """

    def __init__(self) -> None:
        self._blocks: dict[tuple[int, int], Array] = {}

    def frames(
        self, outlines: Sequence[Outline], known: Array, settle: Settle
    ) -> Array:
        """Return a guess of all frames in the world, shape (K + 1, 3).

        Parameters
        ----------
        outlines : sequence of Outline
            The K closed submaps.
        known : ndarray, shape (J + 1, 3)
            The first frames, which have been joined before; at least that of the start.
        settle : callable
            Improves the frames a to b of some submaps, given (a, b, frames).
        """
        first = len(known) - 1
        frames, size = known, 1
        while 2 * size <= len(outlines) - first:
            size *= 2
        begin = first
        while begin < len(outlines):
            while begin + size > len(outlines):
                size //= 2
            block = self._block(outlines, begin, begin + size, settle)
            frames = _merged(outlines, begin - len(frames) + 1, frames, block)
            begin += size
        return frames

    def _block(
        self, outlines: Sequence[Outline], a: int, b: int, settle: Settle
    ) -> Array:
        """Return the frames a to b as frame a sees them."""
        if (a, b) not in self._blocks:
            if b - a <= FEW:
                frames = [np.zeros(3)]
                for outline in outlines[a:b]:
                    frames.append(compose(frames[-1], outline.mean[:3])[0])
                rough = np.array(frames)
            else:
                middle = (a + b) // 2
                left = self._block(outlines, a, middle, settle)
                right = self._block(outlines, middle, b, settle)
                rough = _merged(outlines, a, left, right)
                del self._blocks[a, middle], self._blocks[middle, b]
            self._blocks[a, b] = settle(a, b, rough)
        return self._blocks[a, b]


def points_seen(outlines: Sequence[Outline], frames: Array, count: int) -> Array:
    """Return the landmarks where the first submap that holds each has them.

    Parameters
    ----------
    outlines : sequence of Outline
    frames : ndarray, shape (K, 3) or more
        Of these submaps.
    count : int
        Of slots.

    Returns
    -------
    ndarray, shape (count, 2)
        NaN where none holds it [m].
    """
    points = np.full((count, 2), np.nan)
    for outline, frame in zip(reversed(outlines), frames[len(outlines) - 1 :: -1]):  # noqa: B905
        mean = outline.mean
        seen = complex(*frame[:2]) + np.exp(1j * frame[2]) * (
            mean[3::2] + 1j * mean[4::2]
        )
        points[outline.slots] = seen.view(np.float64).reshape(-1, 2)
    return points


def _merged(
    outlines: Sequence[Outline], first: int, left: Array, right: Array
) -> Array:
    """Let the frames on the right follow those on the left, from submap ``first``."""
    middle = first + len(left) - 1
    start = left[-1]
    if middle > first:
        before = outlines[first:middle]
        after = outlines[middle : middle + len(right) - 1]
        count = 1 + max(int(o.slots.max(initial=0)) for o in [*before, *after])
        goal = points_seen(before, left, count)
        seen = points_seen(after, right, count)
        common = np.flatnonzero(~np.isnan(goal[:, 0] + seen[:, 0]))
        start = place(start, before[-1].spread, seen[common], goal[common])
    moved = np.array([compose(start, frame)[0] for frame in right])
    return np.concatenate([left[:-1], moved])


def place(start: Array, covariance: Array, seen: Array, landmarks: Array) -> Array:
    """Place a block among landmarks by least squares.

    The frame is expected at ``start``, and sees the landmarks, each of which counts as
    much as the position of the frame does.

    Parameters
    ----------
    start, covariance : ndarray, shapes (3,) and (3, 3)
        Where the frame is expected.
    seen : ndarray, shape (n, 2)
        Landmarks as the frame sees them [m].
    landmarks : ndarray, shape (n, 2)
        The same where they are [m].

    Returns
    -------
    ndarray, shape (3,)

    Examples
    --------
    >>> seen = np.array([[1.0, 0.0], [2.0, 0.0], [3.0, 1.0]])
    >>> place(np.zeros(3), np.diag([1.0, 1.0, 1e-9]), seen, seen + [0.0, 1.0]).round(2)
    array([0.  , 0.75, 0.  ])
    """
    prior = np.linalg.inv(covariance + floor(covariance))
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
