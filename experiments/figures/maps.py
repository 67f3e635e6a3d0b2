"""Figures of maps: after one step, after every step, for each noise, and smoothed."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon
from matplotlib.text import Text
from numpy.typing import NDArray
from PIL import Image

from ...arrays import Array
from ...envs.rendering import BlittedFigure, scene
from ...sim_configs.scenario_files import replace_when_written
from ...suggestions import counted
from ..run_and_replay.trace import RunTrace
from . import style


def map_figure(trace: RunTrace, step: int | None = None, walls: Walls = ()) -> Figure:
    """Draw poses and landmarks up to a step, with their 3σ ellipses.

    Predicted poses are magenta and updated ones blue, first landmarks red and later
    ones green, as in section 2 of the CMU 16-833 EKF-SLAM homework. Long runs show
    every second, third, … pose. All steps share the limits of the whole run.

    Parameters
    ----------
    trace : RunTrace
        The run.
    step : int, optional
        Step in 0 … K; the last one by default.
    walls : sequence of (x0, y0, x1, y1)
        Walls to draw [m].

    Raises
    ------
    ValueError
        If the run has no such step.
    """
    last = trace.last_step
    step = last if step is None else step
    if not 0 <= step <= last:
        raise ValueError(f"step must be in 0 … {last}, got {step}")
    parts = _map_parts(trace, walls)
    parts.show(step)
    return parts.figure


def map_sequence(
    trace: RunTrace, folder: str | Path, *, dpi: float = 100, walls: Walls = ()
) -> list[Path]:
    """Save one map picture after every step, step_000.png, step_001.png, ….

    Only the artists that differ between the steps are drawn again.

    Parameters
    ----------
    trace : RunTrace
        The run.
    folder : str or Path
        The folder; it is made if it does not exist.
    dpi : float, default 100
        Pixels per inch.
    walls : sequence of (x0, y0, x1, y1)
        Walls to draw [m].

    Returns
    -------
    list of Path
        The files, in the order of the steps.
    """
    place = Path(folder)
    place.mkdir(parents=True, exist_ok=True)
    parts = _map_parts(trace, walls)
    parts.figure.set_dpi(dpi)
    blitted = BlittedFigure(parts.figure, [*parts.picture.moving, *parts.titles])
    digits = max(3, len(str(trace.last_step)))
    files = [
        place / f"step_{step:0{digits}d}.png" for step in range(trace.last_step + 1)
    ]
    for step, file in enumerate(files):
        parts.show(step)
        with replace_when_written(file) as partial:
            Image.fromarray(blitted.frame()).save(partial, "PNG", compress_level=1)
    return files


def noise_study_figure(runs: Sequence[tuple[str, RunTrace]]) -> Figure:
    """Compare the maps of runs that differ in their noise.

    The reference comes first, beside the legend; the others follow, four to a row, for
    example each of σx, σy, σα, σβ, σr times 10 and divided by 10. All panels show the
    same area, at most twice as wide as that of the reference.

    Parameters
    ----------
    runs : sequence of (str, RunTrace)
        Title and trace of the unchanged reference, then of the variations in reading
        order.

    Raises
    ------
    ValueError
        If there is no variation to compare.
    """
    if len(runs) < 2:
        raise ValueError(f"runs must hold a reference and a variation, got {len(runs)}")
    limits = shared_limits([map_limits(trace) for _, trace in runs])
    rows = -(-(len(runs) + 1) // 4)
    width, height = limits[1] - limits[0]
    figure = style.new_figure(13.0, (2.4 * height / width + 0.55) * rows + 0.4)
    grid = figure.subplots(rows, 4, squeeze=False)
    reference, beside, *others = grid.flat
    picture = _draw_panel(reference, *runs[0], limits)
    beside.set_axis_off()
    beside.legend(
        handles=picture.legend_keys(),
        handler_map=scene.ELLIPSE_HANDLER,
        loc="center left",
        frameon=False,
        fontsize=10,
        labelspacing=0.9,
        title="All panels show the same area.",
        title_fontsize=10,
        alignment="left",
    )
    for axes, run in zip(others, runs[1:], strict=False):
        _draw_panel(axes, *run, limits)
    for axes in others[len(runs) - 1 :]:
        axes.set_axis_off()
    _label_outer_axes(grid, len(runs))
    return figure


class _MapParts(NamedTuple):
    """A map figure that can show any step."""

    figure: Figure
    picture: MapPicture
    titles: tuple[Text, Text]
    trace: RunTrace

    def show(self, step: int) -> None:
        self.picture.show(step)
        titles = _title(self.trace, step, self.picture.stride)
        for artist, text in zip(self.titles, titles, strict=True):
            artist.set_text(text)


def _map_parts(trace: RunTrace, walls: Walls) -> _MapParts:
    limits = map_limits(trace, walls)
    width, height = limits[1] - limits[0]
    figure = style.new_figure(7.2, 6.4 * height / width + 1.5)
    axes = figure.add_subplot()
    style.dress_map(axes, limits)
    picture = MapPicture(axes, trace)
    keys = picture.legend_keys() + draw_walls(axes, walls)
    style.legend(figure, keys, columns=3)
    titles = style.write_title(axes, *_title(trace, 0, picture.stride))
    figure.draw_without_rendering()  # equal axes need a second layout
    return _MapParts(figure, picture, titles, trace)


def _title(trace: RunTrace, step: int, stride: int) -> tuple[str, str]:
    """Return title and subtitle: the step, and the size of the landmarks' ellipses."""
    now = trace.map_at(step)
    thinned = f"  ·  1 pose in {stride} drawn" if stride > 1 else ""
    radius = 3 * np.sqrt(np.linalg.eigvalsh(now.covariances)[:, -1])
    size = f", 3σ within {radius.max():.2g} m" if len(now.ids) else ""
    name = style.short_name(trace.estimator)
    return (
        f"Map and poses after step {step} of {trace.last_step}",
        f"{name}  ·  t = {trace.t[step]:.4g} {trace.time_unit}  ·  "
        f"{counted(len(now.ids), 'landmark')}{size}{thinned}",
    )


def _outcome(trace: RunTrace) -> str:
    """Write the size of the final map's ellipses and errors."""
    largest = np.linalg.eigvalsh(trace.landmark_covariances)[:, -1]
    size = (
        f"landmarks: 3σ within {3 * np.sqrt(largest.max()):.2g} m"
        if len(largest)
        else ""
    )
    if trace.true_landmarks is None:
        return size
    error = np.linalg.norm(trace.landmarks - trace.true_landmarks, axis=1)
    if np.isnan(error).all():
        return size
    return f"{size}, errors {np.sqrt(np.nanmean(error**2)):.2g} m RMS"


def _draw_panel(axes: Axes, title: str, trace: RunTrace, limits: Array) -> MapPicture:
    style.dress_map(axes, limits, size=9, labels=("", ""))
    picture = MapPicture(axes, trace, scale=0.75)
    picture.show(trace.last_step)
    style.write_title(axes, title, _outcome(trace), size=10)
    return picture


def shared_limits(limits: Sequence[Array]) -> Array:
    """Return a box around boxes, but at most twice as wide as the first one."""
    boxes = np.array(limits)
    low, high = boxes[0]
    room = 0.5 * float((high - low).max())
    return np.stack(
        [
            np.maximum(boxes[:, 0].min(axis=0), low - room),
            np.minimum(boxes[:, 1].max(axis=0), high + room),
        ]
    )


def _label_outer_axes(grid: NDArray[np.object_], panels: int) -> None:
    """Label x below the lowest panel of each column, and y at the left."""
    shown = np.arange(grid.size).reshape(grid.shape) <= panels
    for i, row in enumerate(grid):
        for j, axes in enumerate(row):
            last = not shown[i + 1 :, j].any()
            axes.tick_params(labelbottom=last, labelleft=j == 0)
            axes.set_xlabel("x [m]" if last else "")
            axes.set_ylabel("y [m]" if j == 0 else "")


# --------------------------------------------------------------------------------------
# The map picture of the EKF-SLAM homework: poses and landmarks with their ellipses.
#
# Predicted poses are magenta and updated ones blue, first landmarks red and later ones
# green, each with its 3σ ellipse. The kinds also differ by line style, for colour-blind
# readers.

PREDICTED = scene.EllipseKind("predicted pose, 3σ", "#d216c6", (0, (4, 3)), width=1.2)
UPDATED = scene.EllipseKind("updated pose, 3σ", "#1d4ed8", fill=0.12, width=1.3)
FIRST = scene.EllipseKind("landmark at first, 3σ", "#dc1f26", (0, (5, 1.5, 1, 1.5)))
LATER = scene.EllipseKind("landmark later, 3σ", "#128a3a", fill=0.16, width=1.5)
_FORMER = scene.EllipseKind("landmark in between", LATER.colour, width=0.6, alpha=0.35)

_MOST_POSES = 60  # ellipses along the path; longer runs show every second, third, …
_FEWEST_POSES = 12  # of a longer run
_COVERED = 0.35  # sum of their areas, relative to that of the map
_MOST_FORMER = 300  # green ellipses of earlier steps; large maps show fewer steps
_SHORTEST_SIDE = 0.55  # of a map, as a share of its longest


class _Artists(NamedTuple):
    """The artists that change with the step, from back to front."""

    former: EllipseCollection
    later: EllipseCollection
    first: EllipseCollection
    estimates: Line2D
    updated: EllipseCollection
    predicted: EllipseCollection
    path: Line2D
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
        #: Steps between two drawn ellipses of the pose.
        self.stride = pose_stride(trace)
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
        steps = np.append(np.arange(0, step, self.stride), step)
        artists.path.set_data(*trace.poses[: step + 1, :2].T)
        prior, P = trace.predicted_poses[steps], trace.predicted_pose_covariances[steps]
        scene.set_ellipses(artists.predicted, prior[:, :2], P[:, :2, :2])
        poses, P = trace.poses[steps], trace.pose_covariances[steps]
        scene.set_ellipses(artists.updated, poses[:, :2], P[:, :2, :2])
        (left, right), (low, high) = self._axes.get_xlim(), self._axes.get_ylim()
        size = 0.018 * max(right - left, high - low)
        artists.robot.set_xy(scene.arrow_at(trace.poses[step], size))
        self._show_landmarks(step)

    def legend_keys(self) -> list[Artist]:
        """Return the keys of a legend, to be drawn with `ELLIPSE_HANDLER`."""
        kinds = [PREDICTED, UPDATED, FIRST, LATER]
        keys: list[Artist] = [kind.legend_key() for kind in kinds]
        truth = [self._truth] if len(self._trace.every_true_landmark) else []
        return [*keys, self._artists.path, *truth]

    def _show_landmarks(self, step: int) -> None:
        artists, trace = self._artists, self._trace
        seen = self._first_steps <= step
        means, P = trace.first_landmarks[seen], trace.first_landmark_covariances[seen]
        scene.set_ellipses(artists.first, means, P)
        now = trace.map_at(step)
        scene.set_ellipses(artists.later, now.means, now.covariances)
        artists.estimates.set_data(*now.means.T)
        stride = -(-trace.last_step * len(self._first_steps) // _MOST_FORMER)
        former = [trace.map_at(k) for k in range(0, step, max(1, stride))]
        scene.set_ellipses(
            artists.former,
            np.concatenate([np.empty((0, 2)), *(m.means for m in former)]),
            np.concatenate([np.empty((0, 2, 2)), *(m.covariances for m in former)]),
        )

    def _add_truth(self, scale: float) -> Line2D:
        points = self._trace.every_true_landmark
        (crosses,) = self._axes.plot(*points.T, "+", color=style.INK, zorder=5)
        crosses.set_label("true landmark")
        size, width = (9.0, 1.3) if len(points) <= 60 else (5.0, 0.9)
        crosses.set(markersize=size * scale, markeredgewidth=width * scale)
        return crosses

    def _add_artists(self, scale: float) -> _Artists:
        axes = self._axes
        artists = _Artists(
            former=_FORMER.add_to(axes, scale),
            later=LATER.add_to(axes, scale),
            first=FIRST.add_to(axes, scale),
            estimates=Line2D([], [], ls="", marker=".", ms=3 * scale, c=LATER.colour),
            updated=UPDATED.add_to(axes, scale),
            predicted=PREDICTED.add_to(axes, scale),
            path=Line2D(
                [], [], color=style.GREY, lw=1.1 * scale, label="estimated path"
            ),
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
    """Return the number of steps between two drawn ellipses of the pose.

    All of a short run are drawn. Of a long one, fewer are drawn where they are large,
    so that they do not hide the map.
    """
    if len(trace.t) <= _MOST_POSES:
        return 1
    low, high = map_limits(trace)
    (xx, xy), (_, yy) = trace.pose_covariances[:, :2, :2].transpose(1, 2, 0)
    areas = 9 * np.pi * np.sqrt(np.fmax(xx * yy - xy**2, 0.0))  # 0 where unknown
    fitting = _COVERED * np.prod(high - low) / max(areas.mean(), 1e-12)
    return -(-len(trace.t) // int(np.clip(fitting, _FEWEST_POSES, _MOST_POSES)))


def map_limits(trace: RunTrace, walls: Walls = ()) -> Array:
    """Return a box around a run's poses, landmarks, 3σ ellipses and walls.

    See `box_around`.

    Returns
    -------
    ndarray, shape (2, 2)
        Lower left and upper right corner [m].
    """
    points = [trace.poses[:, :2], trace.landmarks, wall_ends(walls)]
    points.append(trace.every_true_landmark)
    poses = np.concatenate([trace.poses, trace.predicted_poses])
    covariances = np.concatenate(
        [trace.pose_covariances, trace.predicted_pose_covariances]
    )
    return box_around(
        np.concatenate(points),
        np.concatenate([poses[:, :2], trace.first_landmarks]),
        np.concatenate([covariances[:, :2, :2], trace.first_landmark_covariances]),
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
    reach = 3 * style.deviations(covariances)
    lowest = (means - reach).min(axis=0, initial=np.inf)
    highest = (means + reach).max(axis=0, initial=-np.inf)
    low = np.maximum(np.minimum(low, lowest), low - span / 3)
    high = np.minimum(np.maximum(high, highest), high + span / 3)
    size = np.maximum(high - low, (high - low).max() * _SHORTEST_SIDE) + 0.06 * span
    centre = (low + high) / 2
    return np.stack([centre - size / 2, centre + size / 2])


#: Rows (x0, y0, x1, y1) [m].
Walls = Sequence[Sequence[float]]


def wall_ends(walls: Walls) -> Array:
    """Return the end points of walls, shape (2n, 2) [m]."""
    return np.reshape(np.asarray(walls, dtype=float), (-1, 2))


def draw_walls(axes: Axes, walls: Walls) -> list[Artist]:
    """Draw walls, and return the keys of a legend: none without walls."""
    if not len(walls):
        return []
    lines = scene.wall_lines(wall_ends(walls), 2.2, zorder=1.5)
    axes.add_collection(lines)
    return [lines]
