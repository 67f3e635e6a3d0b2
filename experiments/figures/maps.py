"""Figures of maps: after one step, after every step, and for different noise."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.text import Text
from numpy.typing import NDArray
from PIL import Image

from ...arrays import Array
from ...envs.rendering import BlittedFigure
from ...envs.rendering.scene import ELLIPSE_HANDLER
from ...sim_configs.atomic_file import replace_when_written
from ..runs.trace import RunTrace
from .map_picture import MapPicture, map_limits, pose_stride
from .style import dress, legend_below, new_figure, write_title
from .walls import Walls, draw_walls


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

    The reference comes first; the others follow below, two to a row, for example each
    of σx, σy, σα, σβ, σr times 10 (left) and divided by 10 (right). All panels show the
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
    limits = _shared_limits([trace for _, trace in runs])
    rows = 1 + len(runs) // 2
    width, height = limits[1] - limits[0]
    figure = new_figure(7.6, (3.15 * height / width + 0.55) * rows + 0.4)
    grid = figure.subplots(rows, 2, squeeze=False)
    reference, beside, *others = grid.flat
    picture = _draw_panel(reference, *runs[0], limits)
    beside.set_axis_off()
    beside.legend(
        handles=picture.legend_keys(),
        handler_map=ELLIPSE_HANDLER,
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
        for artist, text in zip(self.titles, _title(self.trace, step), strict=True):
            artist.set_text(text)


def _map_parts(trace: RunTrace, walls: Walls) -> _MapParts:
    limits = map_limits(trace, walls)
    width, height = limits[1] - limits[0]
    figure = new_figure(7.2, 6.4 * height / width + 1.5)
    axes = figure.add_subplot()
    _prepare(axes, limits)
    axes.set(xlabel="x [m]", ylabel="y [m]")
    picture = MapPicture(axes, trace)
    keys = picture.legend_keys() + draw_walls(axes, walls)
    legend_below(figure, keys, columns=3)
    titles = write_title(axes, *_title(trace, 0))
    figure.draw_without_rendering()  # equal axes need a second layout
    return _MapParts(figure, picture, titles, trace)


def _title(trace: RunTrace, step: int) -> tuple[str, str]:
    """Return title and subtitle: the step, and the size of the landmarks' ellipses."""
    now = trace.map_at(step)
    stride = pose_stride(trace)
    thinned = f"  ·  1 pose in {stride} drawn" if stride > 1 else ""
    radius = 3 * np.sqrt(np.linalg.eigvalsh(now.covariances)[:, -1])
    size = f", 3σ within {radius.max():.2g} m" if len(now.ids) else ""
    many = "landmark" if len(now.ids) == 1 else "landmarks"
    return (
        f"Map and poses after step {step} of {trace.last_step}",
        f"{trace.estimator}  ·  t = {trace.t[step]:.4g} {trace.time_unit}  ·  "
        f"{len(now.ids)} {many}{size}{thinned}",
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


def _prepare(axes: Axes, limits: Array, *, size: float = 10.0) -> None:
    dress(axes, size=size)
    axes.set(aspect="equal", xlim=limits[:, 0], ylim=limits[:, 1])


def _draw_panel(axes: Axes, title: str, trace: RunTrace, limits: Array) -> MapPicture:
    _prepare(axes, limits, size=9)
    picture = MapPicture(axes, trace, scale=0.75)
    picture.show(trace.last_step)
    write_title(axes, title, _outcome(trace), size=10)
    return picture


def _shared_limits(traces: Sequence[RunTrace]) -> Array:
    """Return a box around all maps, but at most twice as wide as the reference."""
    low, high = map_limits(traces[0])
    room = 0.5 * float((high - low).max())
    boxes = np.array([map_limits(trace) for trace in traces])
    return np.stack(
        [
            np.maximum(boxes[:, 0].min(axis=0), low - room),
            np.minimum(boxes[:, 1].max(axis=0), high + room),
        ]
    )


def _label_outer_axes(grid: NDArray[np.object_], panels: int) -> None:
    """Label x below the lowest panel of each column, and y at the left."""
    shown = [[True, False], *([True, True] for _ in range(len(grid) - 1))]
    if panels % 2 == 0:
        shown[-1][1] = False
    for i, row in enumerate(grid):
        for j, axes in enumerate(row):
            last = not any(below[j] for below in shown[i + 1 :])
            axes.tick_params(labelbottom=last, labelleft=j == 0)
            axes.set_xlabel("x [m]" if last else "")
            axes.set_ylabel("y [m]" if j == 0 else "")
