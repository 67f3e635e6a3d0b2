"""The map picture of the EKF-SLAM homework: poses and landmarks with their ellipses.

Predicted poses are magenta and updated ones blue, first landmarks red and later ones
green, each with its 3σ ellipse. The kinds also differ by line style, for colour-blind
readers.
"""

from typing import NamedTuple

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon

from ...arrays import Array
from ..runs.trace import RunTrace
from .style import GREY, INK, EllipseKind, set_ellipses
from .walls import Walls, wall_ends

PREDICTED = EllipseKind("predicted pose, 3σ", "#d216c6", (0, (4, 3)), width=1.2)
UPDATED = EllipseKind("updated pose, 3σ", "#1d4ed8", fill=0.12, width=1.3)
FIRST = EllipseKind("landmark at first, 3σ", "#dc1f26", (0, (5, 1.5, 1, 1.5)))
LATER = EllipseKind("landmark later, 3σ", "#128a3a", fill=0.16, width=1.5)
_FORMER = EllipseKind("landmark in between", LATER.colour, width=0.6, alpha=0.35)

_MOST_POSES = 60  # ellipses along the path; longer runs show every second, third, …
_MOST_FORMER = 300  # green ellipses of earlier steps
_SHORTEST_SIDE = 0.55  # of a map, as a share of its longest
_ARROW = np.array([[1.0, 0.0], [-0.75, 0.7], [-0.35, 0.0], [-0.75, -0.7]])


class _Artists(NamedTuple):
    """The artists that change with the step, from back to front."""

    former: EllipseCollection
    later: EllipseCollection
    first: EllipseCollection
    estimates: Line2D
    path: Line2D
    updated: EllipseCollection
    predicted: EllipseCollection
    robot: Polygon


class MapPicture:
    """The artists of the map picture of one run on given axes.

    Parameters
    ----------
    axes : Axes
        The axes.
    trace : RunTrace
        The run.
    scale : float, default 1
        Scale of lines and markers, smaller for small panels.
    """

    def __init__(self, axes: Axes, trace: RunTrace, *, scale: float = 1.0) -> None:
        self._trace = trace
        self._axes = axes
        self._first_steps = trace.first_steps()
        self._truth = self._add_truth(scale)
        self._artists = self._add_artists(scale)

    @property
    def moving(self) -> tuple[Artist, ...]:
        """The artists that `show` changes, from back to front."""
        return tuple(self._artists)

    def show(self, step: int) -> None:
        """Draw the run up to and including a step."""
        artists, trace = self._artists, self._trace
        steps = np.append(np.arange(0, step, pose_stride(trace)), step)
        artists.path.set_data(*trace.poses[: step + 1, :2].T)
        set_ellipses(
            artists.predicted,
            trace.predicted_poses[steps, :2],
            trace.predicted_pose_covariances[steps, :2, :2],
        )
        set_ellipses(
            artists.updated,
            trace.poses[steps, :2],
            trace.pose_covariances[steps, :2, :2],
        )
        artists.robot.set_xy(self._arrow_at(trace.poses[step]))
        self._show_landmarks(step)

    def legend_keys(self) -> list[Artist]:
        """Return the keys of a legend, to be drawn with `ELLIPSE_HANDLER`."""
        kinds = [PREDICTED, UPDATED, FIRST, LATER]
        keys: list[Artist] = [kind.legend_key() for kind in kinds]
        truth = [] if self._trace.true_landmarks is None else [self._truth]
        return [*keys, self._artists.path, *truth]

    def _show_landmarks(self, step: int) -> None:
        artists, trace = self._artists, self._trace
        seen = self._first_steps <= step
        set_ellipses(
            artists.first,
            trace.first_landmarks[seen],
            trace.first_landmark_covariances[seen],
        )
        now = trace.map_at(step)
        set_ellipses(artists.later, now.means, now.covariances)
        artists.estimates.set_data(*now.means.T)
        former = [trace.map_at(k) for k in self._former_steps(step)]
        set_ellipses(
            artists.former,
            np.concatenate([np.empty((0, 2)), *(m.means for m in former)]),
            np.concatenate([np.empty((0, 2, 2)), *(m.covariances for m in former)]),
        )

    def _former_steps(self, step: int) -> range:
        """Return the earlier steps whose landmarks are shown too: few in large maps."""
        stride = -(-self._trace.last_step * len(self._first_steps) // _MOST_FORMER)
        return range(0, step, max(1, stride))

    def _arrow_at(self, pose: Array) -> Array:
        (left, right), (low, high) = self._axes.get_xlim(), self._axes.get_ylim()
        cos, sin = np.cos(pose[2]), np.sin(pose[2])
        size = 0.018 * max(right - left, high - low)
        return np.asarray(
            pose[:2] + size * _ARROW @ np.array([[cos, sin], [-sin, cos]])
        )

    def _add_truth(self, scale: float) -> Line2D:
        truth = self._trace.true_landmarks
        points = np.empty((0, 2)) if truth is None else truth
        few = len(points) <= 60
        (crosses,) = self._axes.plot(
            *points.T,
            "+",
            color=INK,
            ms=(9 if few else 5) * scale,
            mew=(1.3 if few else 0.9) * scale,
            zorder=5,
            label="true landmark",
        )
        return crosses

    def _add_artists(self, scale: float) -> _Artists:
        axes = self._axes
        artists = _Artists(
            former=_FORMER.add_to(axes, scale),
            later=LATER.add_to(axes, scale),
            first=FIRST.add_to(axes, scale),
            estimates=Line2D([], [], ls="", marker=".", ms=3 * scale, c=LATER.colour),
            path=Line2D([], [], color=GREY, lw=1.1 * scale, label="estimated path"),
            updated=UPDATED.add_to(axes, scale),
            predicted=PREDICTED.add_to(axes, scale),
            robot=Polygon(
                np.full((1, 2), np.nan), fc=UPDATED.colour, ec="white", lw=0.6
            ),
        )
        for depth, artist in enumerate(artists):
            artist.set_zorder(2 + 0.1 * depth)
            if artist.axes is None:
                axes.add_artist(artist)
        return artists


def pose_stride(trace: RunTrace) -> int:
    """Return the number of steps between two drawn ellipses of the pose."""
    return -(-len(trace.t) // _MOST_POSES)


def map_limits(trace: RunTrace, walls: Walls = ()) -> Array:
    """Return a box around a run's poses, landmarks, 3σ ellipses and walls.

    See `box_around`.

    Returns
    -------
    ndarray, shape (2, 2)
        Lower left and upper right corner [m].
    """
    truth = trace.true_landmarks
    points = [trace.poses[:, :2], trace.landmarks, wall_ends(walls)]
    return box_around(
        np.concatenate(points if truth is None else [*points, truth]),
        np.concatenate(
            [trace.poses[:, :2], trace.predicted_poses[:, :2], trace.first_landmarks]
        ),
        np.concatenate(
            [
                trace.pose_covariances[:, :2, :2],
                trace.predicted_pose_covariances[:, :2, :2],
                trace.first_landmark_covariances,
            ]
        ),
    )


def box_around(points: Array, means: Array, covariances: Array) -> Array:
    """Return a box around points and 3σ ellipses, unless these are much larger.

    Ellipses widen the box of the points by at most a third of its span, so that one
    uncertain landmark does not make all others tiny.

    Parameters
    ----------
    points : ndarray, shape (m, 2)
        Positions [m]; rows of nan are ignored.
    means, covariances : ndarray, shapes (k, 2) and (k, 2, 2)
        Means and covariances of the ellipses [m, m²].

    Returns
    -------
    ndarray, shape (2, 2)
        Lower left and upper right corner [m]; neither side much shorter than the other.
    """
    low, high = np.nanmin(points, axis=0), np.nanmax(points, axis=0)
    span = max(float((high - low).max()), 1e-3)
    reach = 3 * np.sqrt(np.maximum(np.diagonal(covariances, axis1=1, axis2=2), 0))
    lowest = (means - reach).min(axis=0, initial=np.inf)
    highest = (means + reach).max(axis=0, initial=-np.inf)
    low = np.maximum(np.minimum(low, lowest), low - span / 3)
    high = np.minimum(np.maximum(high, highest), high + span / 3)
    size = np.maximum(high - low, (high - low).max() * _SHORTEST_SIDE) + 0.06 * span
    centre = (low + high) / 2
    return np.stack([centre - size / 2, centre + size / 2])
