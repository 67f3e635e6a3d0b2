"""Full, compressed, submaps and sparse information filters on the same drives.

``growing_maps.py --overview`` calls this module. The drives are those of submaps.py,
row by row over an initially unknown map. The other table of growing_maps.py has a known
map that is seen from one known pose. Such a map has no links between its landmarks, and
the sparse information filter would look faster than it is.
"""

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from growing_maps_timing import Reading, measure, step_of
from matplotlib.axes import Axes
from numpy.typing import NDArray
from submaps import MEASUREMENT_STD, MOTION_STD, drive, print_table

from slamgym.estimator import (
    Belief,
    CompressedEkfSlam,
    EkfSlam,
    SparseInformationSlam,
    SubmapSlam,
)
from slamgym.evaluation.hypothesis_tests import average_band
from slamgym.evaluation.nees import pose_nees
from slamgym.experiments.figures.style import (
    GREY,
    PALE,
    dress,
    new_figure,
    save_figure,
    write_title,
)
from slamgym.experiments.monte_carlo_study.figures import log_ticks, look_of

Array = NDArray[np.float64]

SIZES = (300, 1000, 3000, 10_000)
SMALLEST = 100
DRIVES = {300: 20, 1000: 10, 3000: 3}  # up to so many landmarks; over larger maps one


class Kind(NamedTuple):
    """A filter, and the largest map on which the overview measures it."""

    make: Callable[[Array], Any]
    largest: int


def _kind(filter_: Callable[..., Any], largest: int, **options: Any) -> Kind:
    """Make filters that start at a given pose."""
    return Kind(
        lambda start: filter_(
            MOTION_STD, MEASUREMENT_STD, initial_pose=start, **options
        ),
        largest,
    )


KINDS = {
    "ekf": _kind(EkfSlam, 3000),
    "compressed": _kind(CompressedEkfSlam, 10_000),
    "compressed, invariant": _kind(CompressedEkfSlam, 3000, base="invariant"),
    "submaps": _kind(SubmapSlam, 100_000, submap_size=50),
    "sparse_information": _kind(SparseInformationSlam, 100_000),
    "sparse_information, constrained": _kind(
        SparseInformationSlam, 3000, base="observability_constrained"
    ),
}


class Drive(NamedTuple):
    """One filter at the end of one drive."""

    steps: list[float]  # s: each of the last tenth of the steps
    asking: float  # s: the pose and its covariance
    nbytes: int  # afterwards
    error: float  # m, of the position
    nees: float  # of the pose, in the filter's own frame


class Row(NamedTuple):
    """One filter on the drives over maps of one size."""

    landmarks: int
    filter: str
    median: float  # ms, of a step
    mean: float  # ms
    slow: float  # ms, percentile 99
    slowest: float  # ms, percentile 99.9
    worst: float  # ms
    asking: float  # ms, median over the drives
    megabytes: float
    error: float  # m, root mean square over the drives
    nees: float  # per degree of freedom, mean over the drives
    drives: int


COLUMNS = (
    ("landmarks", "{}"),
    ("filter", "{}"),
    ("median ms", "{:.3f}"),
    ("mean ms", "{:.3f}"),
    ("99 %", "{:.2f}"),
    ("99.9 %", "{:.2f}"),
    ("worst", "{:.2f}"),
    ("asking, ms", "{:.2f}"),
    ("MB", "{:.1f}"),
    ("error, m", "{:.2f}"),
    ("pose NEES / 3", "{:.2f}"),
    ("drives", "{}"),
)


def overview(count: int) -> list[Row]:
    """Drive every filter over maps of ``count`` landmarks."""
    runs = next((runs for most, runs in DRIVES.items() if count <= most), 1)
    drives = [_drive(count, seed) for seed in range(runs)]
    return [_row(count, name, [each[name] for each in drives]) for name in drives[0]]


def _drive(count: int, seed: int) -> dict[str, Drive]:
    """Give the same readings to all filters, and request their beliefs at the end."""
    half = np.sqrt(25.0 * count) / 2
    landmarks = np.random.default_rng(seed).uniform(-half, half, (count, 2))
    start = np.array([-half, -half, 0.0])
    steps = list(drive(landmarks, half, start, seed=seed + 1))
    data = [Reading(step.odometry, step.readings, step.ids.tolist()) for step in steps]
    filters = {
        name: kind.make(start) for name, kind in KINDS.items() if count <= kind.largest
    }
    cases = {name: (step_of(slam), len(data)) for name, slam in filters.items()}
    costs = measure(cases, data)
    last = len(data) // 10
    return {
        name: _at_the_end(slam, costs[name].steps[-last:], steps[-1].pose)
        for name, slam in filters.items()
    }


def _at_the_end(slam: Any, steps: list[float], true_pose: Array) -> Drive:
    full = isinstance(slam, EkfSlam)  # which has one answer: all
    began = time.thread_time()
    belief: Belief = slam.belief() if full else slam.belief([])
    asking = time.thread_time() - began
    nees = pose_nees(true_pose, belief.pose, belief.pose_covariance, frame=belief.frame)
    return Drive(
        steps,
        asking,
        belief.covariance.nbytes if full else slam.nbytes,
        float(np.hypot(*(belief.pose - true_pose)[:2])),
        float(nees),
    )


def _row(count: int, name: str, drives: Sequence[Drive]) -> Row:
    times = 1e3 * np.concatenate([each.steps for each in drives])
    return Row(
        count,
        name,
        float(np.median(times)),
        float(np.mean(times)),
        float(np.percentile(times, 99)),
        float(np.percentile(times, 99.9)),
        float(np.max(times)),
        1e3 * float(np.median([each.asking for each in drives])),
        float(np.mean([each.nbytes for each in drives])) / 1e6,
        float(np.sqrt(np.mean([each.error**2 for each in drives]))),
        float(np.mean([each.nees for each in drives])) / 3,
        len(drives),
    )


def show_overview(
    sizes: Sequence[int], *, markdown: bool, figure: Path | None = None
) -> None:
    """Print the table, and draw it where a path is given."""
    rows = [row for count in sizes for row in overview(count)]
    cells = [
        [form.format(value) for (_, form), value in zip(COLUMNS, row, strict=True)]
        for row in rows
    ]
    print_table([name for name, _ in COLUMNS], cells, markdown=markdown)
    for drives in sorted({row.drives for row in rows}, reverse=True):
        low, high = average_band(drives, 3)
        print(f"drives: {drives}, honest NEES / 3: {low / 3:.2f} … {high / 3:.2f}")
    for name, kind in KINDS.items():
        if kind.largest < max(sizes):
            print(f"{name} left out above {kind.largest} landmarks")
    if figure:
        draw_overview(rows, figure)


PANELS = (
    ("mean", "Mean of a step", "CPU time [ms]"),
    ("median", "Median of a step", "CPU time [ms]"),
    ("asking", "Pose and covariance", "CPU time when asked for [ms]"),
    ("megabytes", "Memory", "of the filter [MB]"),
    ("error", "Position error", "at the end of the drive [m]"),
    ("nees", "Pose NEES / 3", "grey: 95 % of the means of a consistent filter"),
)


def draw_overview(rows: Sequence[Row], path: Path) -> None:
    """Draw every measure against the size of the map."""
    figure = new_figure(10.5, 6.4)
    panels = figure.subplots(2, 3).ravel()
    for axes, (field, title, unit) in zip(panels, PANELS, strict=True):
        _panel(axes, rows, field)
        write_title(axes, title, unit)
    for axes in panels[3:]:
        axes.set_xlabel("landmarks")
    figure.legend(
        *panels[0].get_legend_handles_labels(),
        loc="outside upper left",
        ncols=len(KINDS),
        frameon=False,
        fontsize=9.5,
    )
    save_figure(figure, path, dpi=110)


def _panel(axes: Axes, rows: Sequence[Row], field: str) -> None:
    dress(axes, size=9)
    drives = dict(sorted((row.landmarks, row.drives) for row in rows))
    for place, name in enumerate(KINDS):
        mine = [row for row in rows if row.filter == name]
        look = look_of(place)
        axes.loglog(
            [row.landmarks for row in mine],
            [getattr(row, field) for row in mine],
            marker=look.marker,
            ms=9 if name == "ekf" else 5,  # compressed has the same errors
            mfc="white",
            **look.line(name),
        )
    if field == "nees":
        low, high = zip(*(average_band(n, 3) for n in drives.values()), strict=True)
        axes.fill_between(
            list(drives), np.array(low) / 3, np.array(high) / 3, color=PALE, zorder=0
        )
        axes.axhline(1.0, color=GREY, lw=1.0, ls=(0, (4, 3)), zorder=0.5)
    log_ticks(axes, "y")
    axes.set_xticks(list(drives), [f"{size:,}" for size in drives])
    axes.minorticks_off()
