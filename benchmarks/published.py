"""Repeat published results: the number of the source, ours, and whether they agree.

    python benchmarks/published.py
    python benchmarks/published.py ukfm bailey --runs 30
    SLAMGYM_DATA=FOLDER python benchmarks/published.py victoria_park
    python benchmarks/published.py --figure docs/images/published.png

A published number agrees if it lies in the interval that contains 95 % of the studies
with as many runs as the source has. The interval is a bootstrap over our runs, and
includes the uncertainty of our own number. For a statement, *published* is a range
that we read from it. It differs if the interval of our number lies outside.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table
from rich.text import Text

from slamgym.arrays import Array
from slamgym.estimator.models.rigid_motion import ErrorFrame, additive_error
from slamgym.evaluation.hypothesis_tests import average_band
from slamgym.evaluation.nees import heading_nees, pose_nees, position_nees
from slamgym.experiments.logs.ground_truth import path_accuracy
from slamgym.experiments.logs.importers import read_log
from slamgym.experiments.logs.slamlog import Scan
from slamgym.experiments.monte_carlo_study.filtered_runs import filter_runs
from slamgym.experiments.run_and_replay.filter_settings import (
    settings_for,
    settings_for_scenario,
)
from slamgym.experiments.run_and_replay.log_replay import replay
from slamgym.experiments.run_and_replay.simulated_runs import (
    SimulatedRuns,
    simulate_runs,
)
from slamgym.sim_configs import Scenario, load_scenario

WORLDS = Path(__file__).parent / "published_worlds"
QUARTER = np.array([[0.0, -1.0], [1.0, 0.0]])


class Row(NamedTuple):
    """One line of the table."""

    what: str
    published: str
    """A number, or the range that a statement allows."""
    ours: float
    low: float
    high: float
    agrees: bool

    @property
    def interval(self) -> str:
        """The interval around our number, empty for an exact one."""
        if self.low == self.high:
            return "exact"
        return f"{self.low:.3g} to {self.high:.3g}"


class Source(NamedTuple):
    """A publication."""

    citation: str
    rows: Callable[[int], Iterator[Row]]
    """Computes the rows from a number of runs."""
    note: str
    """What the source leaves open, and why ours may differ."""


class Filtered(NamedTuple):
    """A filter's beliefs about B runs of T steps, without the first step."""

    truth: Array
    """Of (x, y, θ), shape (B, T, 3)."""
    poses: Array
    covariances: Array
    """Shape (B, T, 3, 3)."""

    def heading_error(self) -> Array:
        """Return the mean square per run [°²]."""
        error = additive_error(self.truth, self.poses)[..., 2]
        return np.asarray((np.rad2deg(error) ** 2).mean(axis=1))

    def position_error(self) -> Array:
        """Return the mean square per run [m²]."""
        error = (self.truth - self.poses)[..., :2]
        return np.asarray((error**2).sum(axis=-1).mean(axis=1))

    def pose_nees(self, frame: ErrorFrame) -> Array:
        """Return the mean NEES of the pose per run, 3 degrees of freedom."""
        return np.asarray(pose_nees(*self, frame=frame).mean(axis=1))

    def heading_nees(self) -> Array:
        """Return the mean NEES of the heading per run."""
        return np.asarray(heading_nees(*self).mean(axis=1))

    def position_nees(self) -> Array:
        """Return the mean NEES of the position per run, 2 degrees of freedom."""
        return np.asarray(position_nees(*self, frame="additive").mean(axis=1))

    def at(self, steps: slice) -> Filtered:
        """Return a part of the steps."""
        return Filtered(*(array[:, steps] for array in self))


def world(name: str) -> Scenario:
    """Load a world of this folder, or a preset."""
    path = WORLDS / f"{name}.toml"
    return load_scenario(path if path.exists() else name)


@cache
def simulated(scenario: Scenario, runs: int) -> SimulatedRuns:
    """Simulate runs once for all filters."""
    return simulate_runs(scenario, runs, 0)


@cache
def filtered(
    scenario: Scenario, estimator: str, runs: int, assumed: Scenario | None = None
) -> Filtered:
    """Run a filter, which assumes the noise of another scenario if given."""
    made = simulated(scenario, runs)
    settings = settings_for_scenario(assumed or scenario, estimator=estimator)
    trace = filter_runs(settings, made, threads=1).trace
    found = Filtered(made.true_poses, trace.poses, trace.pose_covariances)
    return found.at(slice(1, None))


Statistic = Callable[[Array], Array]
"""Of K samples of runs, shape (K, runs) or (K, runs, 2), to K numbers."""


def mean(values: Array) -> Array:
    """Average over runs."""
    return np.asarray(values.mean(axis=1))


def root(values: Array) -> Array:
    """Root of the average over runs."""
    return np.sqrt(mean(values))


def ratio_of_roots(squares: Array) -> Array:
    """Divide the root mean squares of two columns."""
    roots = root(squares)
    return np.asarray(roots[:, 0] / roots[:, 1])


def resampled(of_runs: Array, statistic: Statistic, size: int) -> Array:
    """Compute a statistic of 2000 samples of our runs."""
    rng = np.random.default_rng(size)
    return statistic(of_runs[rng.integers(len(of_runs), size=(2000, size))])


def compare(
    what: str,
    published: float,
    of_runs: Array,
    statistic: Statistic = mean,
    *,
    published_runs: int = 100,
) -> Row:
    """Compare a published number with a statistic of our runs."""
    ours = float(statistic(of_runs[None])[0])
    theirs = resampled(of_runs, statistic, published_runs)
    rng = np.random.default_rng(0)
    again = rng.permutation(resampled(of_runs, statistic, len(of_runs)))
    low, high = (ours * np.quantile(theirs / again, (0.025, 0.975))).tolist()
    return Row(what, f"{published:g}", ours, low, high, low <= published <= high)


def check(
    what: str,
    of_runs: Array,
    low: float = 0.0,
    high: float = np.inf,
    statistic: Statistic = mean,
) -> Row:
    """Compare the range that a statement allows with a statistic of our runs.

    They differ if our whole interval lies outside.
    """
    ours = float(statistic(of_runs[None])[0])
    drawn = resampled(of_runs, statistic, len(of_runs))
    least, most = np.quantile(drawn, (0.025, 0.975)).tolist()
    allowed = f"{low:.3g} to {high:.3g}"
    allowed = f"< {high:.3g}" if low == 0 else allowed
    allowed = f"> {low:.3g}" if high == np.inf else allowed
    return Row(what, allowed, ours, least, most, least <= high and low <= most)


def exact(what: str, published: float, ours: float) -> Row:
    """Compare numbers without randomness."""
    rounding = 0.005 if published % 1 else 1e-9
    agrees = abs(published - ours) <= rounding
    return Row(what, f"{published:g}", ours, ours, ours, agrees)


def ukfm(runs: int) -> Iterator[Row]:
    """Ten laps in a ring of landmarks, with readings of relative positions."""
    published = {"ekf": (3.01, 0.67, 2.76, 2.38), "invariant": (2.58, 0.56, 1.07, 1.14)}
    for name, numbers in published.items():
        yield from four(name, numbers, filtered(world("ukfm"), name, runs), 10)


def localization(runs: int) -> Iterator[Row]:
    """One lap with GPS, without landmarks, from an unknown heading."""
    published = {
        "ekf": (12.00, 0.76, 4.91, 275.28),
        "invariant": (11.35, 0.45, 0.94, 1.01),
    }
    for name, numbers in published.items():
        found = filtered(world("localization"), name, 5 * runs)
        yield from four(name, numbers, found, 2000)


def four(
    name: str, published: tuple[float, ...], found: Filtered, begin: int
) -> Iterator[Row]:
    """Compare the four numbers that the documentation of UKF-M prints of a filter."""
    heading, position, heading_nees, position_nees = published
    yield compare(f"{name}: heading [°]", heading, found.heading_error(), root)
    yield compare(f"{name}: position [m]", position, found.position_error(), root)
    later = found.at(slice(begin, None))
    yield compare(f"{name}: NEES of the heading", heading_nees, later.heading_nees())
    half = later.position_nees() / 2
    yield compare(f"{name}: NEES / 2 of the position", position_nees, half)


def symmetries(runs: int) -> Iterator[Row]:
    """Five laps in a ring of landmarks: far from the start, and at the end.

    The files have columns for every second step k; k = 2 is after the first motion.
    """
    published = {
        "ekf": (0.478, 8.459),
        "observability_constrained": (0.306, 2.091),
        "robocentric": (0.310, 1.960),
        "invariant": (0.317, 1.834),
    }
    for name, (error, nees) in published.items():
        found = filtered(world("symmetries"), name, runs)
        far = found.at(slice(380, 381)).position_error()
        what = f"{name}: position, k = 383 [m]"
        yield compare(what, error, far, root, published_runs=1)
        end = found.at(slice(378, 397, 2)).pose_nees("additive")
        what = f"{name}: NEES, k = 381 to 399"
        yield compare(what, nees, end, published_runs=1)


def bailey(runs: int) -> Iterator[Row]:
    """Vary the uncertainty of the first heading of a car."""
    low, high = average_band(50, 3)
    yield exact("lower end of the band of 50 runs", 2.36, low)
    yield exact("upper end of the band of 50 runs", 3.72, high)
    for degrees in (0.1, 0.5, 1.0, 1.7, 3.0, 5.0, 10.0, 20.0):
        nees = filtered(turned(degrees), "ekf", runs).pose_nees("invariant")
        ends = (0.0, high) if degrees < 1.5 else (high, np.inf)
        yield check(f"ekf: NEES, σθ = {degrees:g}°", nees, *ends)
    wide = turned(10.0)
    nees = filtered(wide, "iterated", runs).pose_nees("invariant")
    yield check("iterated: NEES, σθ = 10°", nees, low=high)
    small = wide.with_changes(landmarks={"count": 8})  # in time O(n³)
    nees = filtered(small, "unscented", min(runs, 10)).pose_nees("invariant")
    yield check("unscented: NEES, σθ = 10°, 8 landmarks", nees, low=high)
    std = tuple(1.4142 * s for s in wide.motion.std)
    more = wide.with_changes(motion={"std": std})
    nees = filtered(wide, "ekf", runs, more).pose_nees("invariant")
    yield check("ekf, twice the motion noise: NEES, σθ = 10°", nees, low=high)
    nees = filtered(wide, "invariant", runs).pose_nees("invariant")
    yield check("invariant: NEES, σθ = 10°", nees, low, high)


def turned(degrees: float) -> Scenario:
    """Return the world of Bailey et al. with an uncertainty of the first heading."""
    std = (0.0, 0.0, float(np.deg2rad(degrees)))
    return world("bailey").with_changes(start={"std": std})


def huang(runs: int) -> Iterator[Row]:
    """Dimension of the unobservable subspace, and what it does to the filters."""
    for name, expected in (("truth", 3), ("ekf", 2), ("first_estimates", 3)):
        what = f"unobservable directions, Jacobians at: {name}"
        yield exact(what, expected, unobservable_directions(name))
    loop = world("loop")
    ekf = filtered(loop, "ekf", runs)
    yield check("ekf: NEES of the heading", ekf.heading_nees(), low=1.5)
    for name in ("first_estimates", "observability_constrained"):
        found = filtered(loop, name, runs)
        ratio = np.column_stack([found.position_error(), ekf.position_error()])
        what = f"{name}: position error / that of ekf"
        yield check(what, ratio, high=1, statistic=ratio_of_roots)
        nees = found.heading_nees()
        yield check(f"{name}: NEES of the heading", nees, low=0.67, high=1.5)


def unobservable_directions(points: str) -> int:
    """Count the directions that the readings of `six_landmarks` do not show.

    The observability matrix has the rows H Φ [Huang et al., section 3], with Jacobians
    at the latest estimates of `ekf`, at its first ones, or at the truth. H is that of
    relative positions, which spans the same rows as that of bearings and ranges.
    """
    made = simulated(world("six_landmarks"), 1)
    slam = settings_for_scenario(world("six_landmarks"), estimator="ekf").make(
        made.initial_poses[0]
    )
    places = made.landmarks[0]
    way, rows = np.eye(3 + 2 * len(places)), []
    before, first = made.true_poses[0, 0], places
    for step, odometry in enumerate(made.odometry[0]):
        truth = made.true_poses[0, step]
        if step:
            slam.predict(odometry)
        predicted = truth if points == "truth" else slam.belief().pose
        landmarks = {"truth": places, "first_estimates": first}.get(points)
        if landmarks is None:
            landmarks = slam.belief().landmarks if step else first
        if step:
            way[:2] += np.outer(QUARTER @ (predicted[:2] - before[:2]), way[2])
            rows.append(relative_positions(predicted, landmarks) @ way)
        slam.update(made.measurements[0, step], list(range(len(places))))
        if not step and points != "truth":
            first = slam.belief().landmarks
        before = slam.belief().pose if points == "ekf" else predicted
    values = np.linalg.svd(np.concatenate(rows), compute_uv=False)
    return int((values < 1e-9 * values[0]).sum())


def relative_positions(pose: Array, landmarks: Array) -> Array:
    """Return the Jacobian of the landmarks' positions in the frame of the robot."""
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    back = np.array([[cos, sin], [-sin, cos]])
    jacobian = np.zeros((2 * len(landmarks), 3 + 2 * len(landmarks)))
    for i, place in enumerate(landmarks):
        rows, columns = slice(2 * i, 2 * i + 2), slice(3 + 2 * i, 5 + 2 * i)
        jacobian[rows, :2], jacobian[rows, columns] = -back, back
        jacobian[rows, 2] = -back @ QUARTER @ (place - pose[:2])
    return jacobian


def castellanos(runs: int) -> Iterator[Row]:
    """Robocentric mapping, from a known and from an uncertain heading."""
    low, high = (end / 3 for end in average_band(runs, 3))
    known, unknown = world("anchored"), world("unknown_heading")
    for name in ("ekf", "robocentric"):
        nees = filtered(known, name, runs).pose_nees("additive") / 3
        yield check(f"{name}: NEES / 3, heading known", nees, low, high)
    ekf = filtered(unknown, "ekf", runs).heading_nees()
    yield check("ekf: NEES of the heading, σθ = 29°", ekf, low=10)
    nees = filtered(unknown, "robocentric", runs).heading_nees()
    yield check("robocentric: NEES of the heading, σθ = 29°", nees, 0.5, 1.5)


def julier(runs: int) -> Iterator[Row]:
    """Look at the heading of a robot at rest that reads one landmark."""
    yield from heading_std("standing", runs)


def barrau(runs: int) -> Iterator[Row]:
    """Look at the heading of a robot that drives without noise."""
    yield from heading_std("quiet", runs)


def heading_std(name: str, runs: int) -> Iterator[Row]:
    """Compare the deviation of the heading at the end with that at the start.

    No reading shows the heading, and the motion has no noise: the ratio is 1.
    """
    quiet = world("six_landmarks").with_changes(motion={"std": (0.0, 0.0, 0.0)})
    scenario = quiet if name == "quiet" else world(name)
    for filter_ in (
        "ekf",
        "iterated",
        "invariant",
        "first_estimates",
        "observability_constrained",
    ):
        variance = filtered(scenario, filter_, runs).covariances[:, -1, 2, 2]
        ratio = np.sqrt(variance) / scenario.start.std[2]
        what = f"{filter_}: σθ, end / start"
        if filter_ in ("ekf", "iterated"):
            yield check(what, ratio, high=0.9)
        else:
            yield exact(what, 1, float(ratio[np.abs(ratio - 1).argmax()]))


def victoria_park(_: int) -> Iterator[Row]:
    """Replay the log of a car among trees; see docs/landmark_management.md."""
    log = read_log(Path(os.environ.get("SLAMGYM_DATA", ".")) / "victoria_park.csv")
    view = {"max_range": 20.0, "angle": 3.14159, "shadow": 0.05, "range_margin": 0.0}
    policy = {"association": "nearest", "backdate": False, "confirm": [3, 19]}
    settings = settings_for(
        log,
        estimator="ekf",
        motion_std=(0.075, 0.15, 0.0318),
        measurement_std=(0.0098, 0.04),
        options={
            "range_std_per_metre": 0.009,
            "management": {**policy, "view": view, "remove_after": 20},
        },
    )
    blind = tuple(event for event in log.events if not isinstance(event, Scan))
    found = []
    for events in (blind, log.events):
        trace = replay(replace(log, events=events), settings.make(log.start)).trace
        accuracy = path_accuracy(log, trace.t, trace.poses)
        assert accuracy is not None
        found.append(accuracy.aligned_rmse)
    odometry, ekf = found
    what = f"path error: ekf {ekf:.2f} m, odometry {odometry:.2f} m; ratio"
    yield Row(what, "< 1", ekf / odometry, 0.0, 0.0, ekf < odometry)


SOURCES = {
    "ukfm": Source(
        "Brossard, Barrau, Bonnabel: UKF-M, ICRA 2020; 2D Robot SLAM - Benchmark",
        ukfm,
        "The source reads no scan before the first motion; so does this world, whose "
        "start has the noise of one motion. With one more scan, the heading errors "
        "are half as large.",
    ),
    "localization": Source(
        "Brossard, Barrau, Bonnabel: UKF-M, ICRA 2020; 2D Robot Localization",
        localization,
        "Published numbers beside `invariant` are those of the right SE(2) UKF, which "
        "has the same error and sigma points in place of Jacobians. Noise disturbs "
        "the motion here, and the odometry in the source. The NEES of the position has "
        "a heavy tail: few runs make most of its mean. So ours are 5 times as many "
        "runs.",
    ),
    "symmetries": Source(
        "Brossard, Barrau, Bonnabel: Exploiting symmetries, IEEE Sensors J. 2019",
        symmetries,
        "From the published data of figures 2 and 3. The NEES there jumps between 0.4 "
        "and 5 from one step to the next, so the data show one run, not 100: the "
        "interval is that of a single run.",
    ),
    "bailey": Source(
        "Bailey et al.: Consistency of the EKF-SLAM algorithm, IROS 2006",
        bailey,
        "The statements are those of the abstract: consistent while σθ is small, "
        "not beyond a limit, and no cure by iterations, sigma points or noise. The "
        "limit that the rows assume, 1.5°, is ours. Open are map and path. The NEES is "
        "that of the invariant error: the additive one, of the paper, rejects even "
        "a consistent filter where σθ bends the errors along an arc.",
    ),
    "huang": Source(
        "Huang, Mourikis, Roumeliotis: Observability-based rules, IJRR 29(5), 2010",
        huang,
        "Dimensions are those that the paper proves; the statements are those of the "
        "abstract. Open is the map: the preset `loop` has the path of the paper.",
    ),
    "castellanos": Source(
        "Castellanos et al.: Robocentric map joining, RAS 55, 2007",
        castellanos,
        "The statement is that inconsistency comes from an uncertain first pose, and "
        "that robocentric maps avoid it. Open are map, path and noise.",
    ),
    "julier": Source(
        "Julier, Uhlmann: A counter example to the theory of SLAM, ICRA 2001",
        julier,
        "The theorem: a robot at rest learns nothing about its heading. Distance and "
        "noise are ours (preset `standing`).",
    ),
    "barrau": Source(
        "Barrau, Bonnabel: An EKF-SLAM algorithm with consistency properties, 2015",
        barrau,
        "The theorem: the invariant filter gains no information about the frame, "
        "whatever the path. World and noise are ours (`six_landmarks`, no slip).",
    ),
    "victoria_park": Source(
        "Montemerlo, Thrun: FastSLAM, figures of Victoria Park, 2003",
        victoria_park,
        "The figures show that SLAM follows GPS where odometry does not. Noise and "
        "association are ours. Errors are those after the best fit to GPS.",
    ),
}
NEED_DATA = ("victoria_park",)  # of the folder SLAMGYM_DATA


def print_table(name: str, rows: list[Row]) -> None:
    """Print the rows of one source."""
    source = SOURCES[name]
    title = f"{name}. {source.citation}"
    table = Table(title=title, caption=source.note, caption_justify="left", box=None)
    for column in ("", "published", "ours", "95 % interval", ""):
        table.add_column(column, justify="right" if column else "left")
    for row in rows:
        verdict = "agrees" if row.agrees else "differs"
        table.add_row(
            Text(row.what), row.published, f"{row.ours:.3g}", row.interval, verdict
        )
    Console(width=96).print(table, "")


def picture(found: dict[str, list[Row]]) -> Figure:
    """Draw each published number divided by ours, with the interval."""
    rows = [
        (name, row)
        for name, table in found.items()
        for row in table
        if row.low < row.high and row.published.replace(".", "").isdigit()
    ]
    figure = Figure(figsize=(8, 0.2 * len(rows) + 0.8), layout="constrained")
    axes = figure.subplots()
    for y, (_, row) in enumerate(rows):
        axes.plot([row.low / row.ours, row.high / row.ours], [y, y], c="0.75", lw=5)
        colour = "C0" if row.agrees else "C3"
        axes.plot(float(row.published) / row.ours, y, "o", c=colour, ms=4)
    axes.axvline(1, c="black", lw=0.8)
    axes.set_xscale("log")
    ticks = (0.05, 0.1, 0.2, 0.5, 1, 2, 5)
    axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.set_yticks(range(len(rows)), [f"{name}, {row.what}" for name, row in rows])
    axes.tick_params(axis="y", labelsize=7)
    axes.invert_yaxis()
    axes.set_xlabel("published / ours; grey: 95 % of studies like the published one")
    return figure


def main() -> None:
    """Print the tables that the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("source", nargs="*", help=", ".join(SOURCES))
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--figure", type=Path, help="also draw the numbers")
    arguments = parser.parse_args()
    if unknown := set(arguments.source) - set(SOURCES):
        parser.error(f"source must be one of {', '.join(SOURCES)}, got {unknown}")
    found = {}
    for name in arguments.source or [n for n in SOURCES if n not in NEED_DATA]:
        found[name] = list(SOURCES[name].rows(arguments.runs))
        print_table(name, found[name])
    rows = [row for table in found.values() for row in table]
    agree = sum(row.agrees for row in rows)
    print(f"{agree} of {len(rows)} agree, {arguments.runs} runs", file=sys.stderr)
    if arguments.figure:
        picture(found).savefig(arguments.figure, dpi=100)


if __name__ == "__main__":
    main()
