"""File formats of trajectories: npz, TUM and slamlog here, the others loaded on demand.

A shard of some episodes is one file or one folder. `trajectory_format` returns how a
format is written and read; a `TrajectoryFormat` holds its `write` and `read`, and the
fields that differ from their defaults.
"""

import json
import math
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from importlib import import_module
from itertools import repeat
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np

from ...arrays import Array
from ...envs.spaces import count_rows
from ...estimator.filters.batch import BatchSlam
from ...estimator.filters.ekf import EkfSlam
from ...estimator.models.bearing_range import wrap_angle
from ...estimator.models.motions import UNICYCLE, Motion, find_motion, only_unicycle
from ...estimator.models.rigid_motion import composed
from ...public_names import is_here
from ...sim_configs import Scenario
from ...sim_configs.field_types import unknown_choice
from ...sim_configs.scenario_files import scenario_text
from ..logs import slamlog
from ..logs.decimals import texts
from ..logs.log_lines import (
    LARGEST,
    MAX_ID_DIGITS,
    ReadFile,
    columns_of,
    read_text,
    rows_of,
    table_of,
    to_lines,
)
from ..logs.recording import log_of_episode
from ..run_and_replay.filter_settings import settings_for_scenario
from .trajectory import (
    ARRAYS,
    BELIEFS,
    Trajectory,
    array_of,
    arrays_to_write,
    scenario_from_text,
)


class TrajectoryFormat(NamedTuple):
    """What a module of this package defines."""

    #: Writes a shard: (trajectories, path), and its options by name. The same
    #: trajectories give the same bytes.
    write: Callable[..., None]
    #: Yields the trajectories of a shard, one after the other.
    read: Callable[[Path], Iterator[Trajectory]]
    #: Raises a ValueError for a scenario that the format cannot hold.
    check: Callable[[Scenario], None] = lambda scenario: None
    #: The ending of the names of its shards.
    ENDING: str = ""
    #: The packages besides numpy that write it; their versions determine the bytes.
    LIBRARIES: tuple[str, ...] = ()
    #: Names and defaults of the numbers > 0 that its `write` also takes.
    OPTIONS: Mapping[str, float] = {}
    #: Whether it writes and reads the beliefs of a filter too.
    HOLDS_BELIEFS: bool = False


def trajectory_format(name: str) -> TrajectoryFormat:
    """Load a format by its name.

    Raises
    ------
    ValueError
        If there is no such format.
    ImportError
        If its package is not installed; the message shows how to install it.

    Examples
    --------
    >>> trajectory_format("npz").ENDING
    '.npz'
    >>> trajectory_format("npy")
    Traceback (most recent call last):
    ValueError: format must be one of slamlog, npz, parquet, minari, tum, g2o, got \
'npy'; did you mean 'npz'?
    """
    if name not in FORMATS:
        raise ValueError(unknown_choice("format", name, FORMATS))
    found = FORMATS[name]
    if isinstance(found, TrajectoryFormat):
        return found
    try:
        module = import_module(f".{found}", __package__)
    except ModuleNotFoundError as error:
        raise ImportError(
            f"the format '{name}' needs the package {error.name}: "
            "pip install 'slamgym[trajectories]'"
        ) from None
    known = {n: vars(module)[n] for n in TrajectoryFormat._fields if n in vars(module)}
    return TrajectoryFormat(**known)


# --------------------------------------------------------------------------------------
# Shards as folders of text files, with metadata that the text formats lack.
#
# In addition to the files of its episodes, a shard has ``episodes.jsonl`` with one line
# per episode: its name, seed, controller, and scenario as TOML.

METADATA = "episodes.jsonl"


def write_metadata(
    trajectories: Sequence[Trajectory], folder: Path
) -> list[tuple[str, Trajectory]]:
    """Make the folder of a shard with its metadata, and name the episodes.

    Returns
    -------
    list of (str, Trajectory)
        Names such as ``"seed_00000007"``, prefixes of the names of the episode's files,
        and the trajectories.
    """
    folder.mkdir()
    named = [(f"seed_{each.seed:08d}", each) for each in trajectories]
    tables = [
        {
            "name": name,
            "seed": each.seed,
            "controller": each.controller,
            "scenario": scenario_text(each.scenario),
        }
        for name, each in named
    ]
    write_lines(folder / METADATA, [json.dumps(table) for table in tables])
    return named


def read_metadata(folder: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield for each episode its name, and its scenario, controller and seed."""
    for line in (folder / METADATA).read_text(encoding="utf-8").splitlines():
        table = json.loads(line)
        table["scenario"] = scenario_from_text(table["scenario"])
        yield table.pop("name"), table


def write_lines(path: Path, lines: Sequence[str]) -> None:
    """Write lines as a UTF-8 text file, the same on every system."""
    path.write_text("\n".join([*lines, ""]), encoding="utf-8", newline="\n")


def numbers(values: Iterable[float]) -> str:
    """Write numbers separated by blanks, so that reading gives the same bits.

    Examples
    --------
    >>> numbers([0.1, 2])
    '0.1 2.0'
    """
    return " ".join(repr(float(value)) for value in values)


# --------------------------------------------------------------------------------------
# Shards as npz files of numpy: every array of E episodes stacked, exact.
#
# The arrays are those of `Trajectory` with an additional first axis E:
# ``start_estimate`` has the shape (E, 3). ``seed``, ``controller`` and ``scenario`` (as
# TOML) are (E,).


_NO_DATE = (1980, 1, 1, 0, 0, 0)  # a constant: equal arrays give equal bytes


def _write_npz(trajectories: Sequence[Trajectory], path: Path) -> None:
    """Write a shard, uncompressed; see `TrajectoryFormat`."""
    columns = {
        "scenario": np.array([scenario_text(each.scenario) for each in trajectories]),
        "controller": np.array([each.controller for each in trajectories]),
        "seed": np.array([each.seed for each in trajectories]),
    }
    with zipfile.ZipFile(path, "w") as archive:
        for name, column in columns.items():
            _add(archive, name, column)
        for name in arrays_to_write(trajectories):
            stacked = np.stack([array_of(each, name) for each in trajectories])
            _add(archive, name, stacked)


def _read_npz(path: Path) -> Iterator[Trajectory]:
    """Yield the trajectories of a shard; see `TrajectoryFormat`."""
    with np.load(path, allow_pickle=False) as archive:
        columns = {name: archive[name] for name in archive.files}
    arrays = [name for name in (*ARRAYS, *BELIEFS) if name in columns]
    for k in range(len(columns["seed"])):
        yield Trajectory(
            scenario=scenario_from_text(str(columns["scenario"][k])),
            controller=str(columns["controller"][k]),
            seed=int(columns["seed"][k]),
            **{name: columns[name][k] for name in arrays},
        )


def _add(archive: zipfile.ZipFile, name: str, array: np.ndarray) -> None:
    member = zipfile.ZipInfo(f"{name}.npy", date_time=_NO_DATE)
    with archive.open(member, "w", force_zip64=True) as stream:
        np.lib.format.write_array(stream, array, allow_pickle=False)


# --------------------------------------------------------------------------------------
# Shards as folders of TUM files: the true path and the path by odometry alone.
#
# The lines are ``t x y z qx qy qz qw`` with t in seconds and z = 0, as evo reads them.
# There are two files per episode, ``NAME_truth.tum`` and ``NAME_odometry.tum``; the
# latter integrates odometry from the initial pose of filters.
#
# The files hold the paths alone: no readings, landmarks, actions or collisions.
# Positions are exact; headings read back in [-π, π] within 1e-15, and odometry within
# 1e-15 times the size of the coordinates.


def _write_tum(trajectories: Sequence[Trajectory], path: Path) -> None:
    """Write a shard; see `TrajectoryFormat`."""
    for name, each in write_metadata(trajectories, path):
        dt = each.scenario.dt
        write_lines(path / f"{name}_truth.tum", _lines(each.poses, dt))
        path_by_odometry = dead_reckoning(each.start_estimate, each.odometry)
        write_lines(path / f"{name}_odometry.tum", _lines(path_by_odometry, dt))


def _check_tum(scenario: Scenario) -> None:
    """Refuse odometry that the increments of a path do not determine."""
    only_unicycle(
        find_motion(scenario.models.get("motion", "unicycle")), "the format 'tum'"
    )


def _read_tum(path: Path) -> Iterator[Trajectory]:
    """Yield the trajectories of a shard; see `TrajectoryFormat`."""
    for name, about in read_metadata(path):
        reckoned = _poses(path / f"{name}_odometry.tum")
        yield Trajectory(
            **about,
            start_estimate=reckoned[0],
            odometry=_increments(reckoned),
            poses=_poses(path / f"{name}_truth.tum"),
        )


def _lines(poses: Array, dt: float) -> list[str]:
    return [
        numbers((step * dt, x, y, 0, 0, 0, math.sin(half), math.cos(half)))
        for step, (x, y, half) in enumerate((poses * (1.0, 1.0, 0.5)).tolist())
    ]


def _poses(path: Path) -> Array:
    table: Array = np.loadtxt(path, ndmin=2)
    half = np.arctan2(table[:, 6], table[:, 7])
    heading = [wrap_angle(2.0 * angle) for angle in half.tolist()]
    return np.column_stack([table[:, 1:3], heading])


def _increments(poses: Array) -> Array:
    """Return the odometry of a dead-reckoned path: distances and turns."""
    dx, dy = np.diff(poses[:, :2], axis=0).T
    heading = poses[:-1, 2]
    turns = [wrap_angle(turn) for turn in np.diff(poses[:, 2]).tolist()]
    return np.column_stack([dx * np.cos(heading) + dy * np.sin(heading), turns])


def dead_reckoning(start: Array, odometry: Array, motion: Motion = UNICYCLE) -> Array:
    """Integrate odometry.

    For a unicycle::

        x' = x + d cos θ,    y' = y + d sin θ,    θ' = θ + α

    Parameters
    ----------
    start : ndarray, shape (3,)
        First pose [m, m, rad].
    odometry : ndarray, shape (T, 2)
        Rows (d, α) [m, rad], or the columns of the drive.
    motion : Motion
        The drive.

    Returns
    -------
    ndarray, shape (T + 1, 3)
        Poses (x, y, θ) [m, m, rad], the start first, θ not wrapped.

    Examples
    --------
    >>> turns = np.array([[1.0, np.pi / 2], [2.0, 0.0]])
    >>> dead_reckoning(np.zeros(3), turns).round(2).tolist()
    [[0.0, 0.0, 0.0], [1.0, 0.0, 1.57], [1.0, 2.0, 1.57]]
    """
    x, y, heading = start.tolist()
    dx, dy, turns = motion.displacements(odometry).T
    headings = np.cumsum([heading, *turns])
    step_x, step_y, *_ = composed(0.0, 0.0, headings[:-1], dx, dy, turns)
    return np.column_stack([np.cumsum([x, *step_x]), np.cumsum([y, *step_y]), headings])


_ESTIMATOR = "invariant"


def filtered_path(trajectory: Trajectory) -> tuple[Array, dict[int, Array]]:
    """Return the online poses and the final landmarks of an invariant EKF.

    The errors of odometry alone grow without bounds, and an optimiser that starts there
    often ends in another minimum. Every loop that the filter closes bounds them.

    Returns
    -------
    poses : ndarray, shape (T + 1, 3)
        Poses (x, y, θ), given the readings up to each of them [m, m, rad]; odometry
        alone if the filter fails. The first is the start estimate.
    landmarks : dict of int to ndarray, shape (2,)
        Positions of the mapped landmarks [m].
    """
    mask = array_of(trajectory, "mask")
    start = trajectory.start_estimate
    settings = settings_for_scenario(trajectory.scenario, estimator=_ESTIMATOR)
    batch = BatchSlam(
        cast(EkfSlam, settings.make(start)),
        1,
        mask.shape[1],
        initial_poses=start[None],
        initial_pose_std=settings.initial_pose_std,
        threads=1,
    )
    odometry = np.vstack([np.zeros(2), trajectory.odometry])[None]
    durations = np.append(0.0, np.ones(trajectory.steps))
    measurements = array_of(trajectory, "measurements")[None]
    poses = batch.run(odometry, measurements, mask[None], durations).poses[0]
    belief = batch.belief(0)
    if not (np.isfinite(poses).all() and np.isfinite(belief.mean).all()):
        return dead_reckoning(start, trajectory.odometry, batch.motion), {}
    poses[0] = start
    return poses, dict(zip(belief.landmark_ids, belief.landmarks, strict=True))


# --------------------------------------------------------------------------------------
# Shards as folders of slamlog CSVs, one per episode: the input of a filter, exact.
#
# A log holds the start, odometry, measurements, true poses and landmarks, and the true
# ids of hidden identities; reading gives the same bits. It does not hold the actions
# and the collisions.


def _write_slamlog(trajectories: Sequence[Trajectory], path: Path) -> None:
    """Write a shard; see `TrajectoryFormat`."""
    for name, each in write_metadata(trajectories, path):
        world, seed, start = each.scenario, each.seed, each.start_estimate
        landmarks = array_of(each, "landmarks")
        log = log_of_episode(world, seed, start, landmarks, (), each.poses)
        slamlog.write_events(log, _event_lines(each), path / f"{name}.csv")


def _event_lines(trajectory: Trajectory) -> list[str]:
    """Return the rows of the events of `to_slamlog`, from whole columns."""
    mask, of = array_of(trajectory, "mask"), trajectory.landmark_ids
    (step, row), z = np.nonzero(mask), array_of(trajectory, "measurements")[mask]
    times = texts(np.arange(len(mask), dtype=np.float64))
    at, ids = map(times.__getitem__, step.tolist()), map(str, row.tolist())
    columns: list[Iterable[str]] = [repeat("measurement"), at, ids, *map(texts, z.T)]
    if not trajectory.scenario.sensor.identities:
        columns[2] = repeat("")
        if of is not None:
            columns += [repeat(""), map(str, of[mask].tolist())]
    moves = map(texts, trajectory.odometry.T)
    lines = rows_of(",", *columns)
    lines += rows_of(",", repeat("odometry"), times[1:], *moves, repeat("1.0"))
    order = np.argsort(
        np.append(2 * step, 2 * np.arange(1, len(mask)) - 1), stable=True
    )
    return [lines[k] for k in order.tolist()]


def _read_slamlog(path: Path) -> Iterator[Trajectory]:
    """Yield the trajectories of a shard; see `TrajectoryFormat`."""
    for name, about in read_metadata(path):
        file = ReadFile(path / f"{name}.csv")
        try:
            found = _from_columns(read_text(file), about)
        except (ValueError, LookupError):  # in another form, or damaged
            found = _from_log(slamlog.read_slamlog(file), about)
        yield found


def _from_columns(text: str, about: dict[str, Any]) -> Trajectory:
    """Read what `_write_slamlog` writes, by whole columns.

    Raises
    ------
    ValueError, LookupError
        If the text has another form; `read_slamlog` then reads or refuses it.
    """
    hides = not about["scenario"].sensor.identities
    lines = text.removesuffix("\n").split("\n")
    moves = columns_of(lines, "odometry", ",", 5)
    truth = columns_of(lines, "groundtruth", ",", 5)
    readings = columns_of(lines, "measurement", ",", 7 if hides else 5)
    head = len(lines) - sum(len(each[0]) for each in (moves, truth, readings))
    log = slamlog.parsed(to_lines("\n".join(lines[:head]), ""), "")
    tables = [*map(table_of, (moves[1:3], truth[1:], readings[2:4]))]
    times = texts(np.arange(len(truth[0]), dtype=np.float64))
    number = dict(zip(times, range(len(times)), strict=True))
    step = np.array([*map(number.__getitem__, readings[0])])
    true = readings[5 if hides else 1]
    if max(map(len, true), default=0) > MAX_ID_DIGITS:
        raise ValueError("an id is too long")
    ids = np.array([*map(int, true)])
    row = np.arange(len(step)) - np.searchsorted(step, step) if hides else ids
    shape = len(times), count_rows(about["scenario"])
    measurements, mask = np.zeros((*shape, 2)), np.zeros(shape, dtype=np.bool_)
    true_ids = np.full(shape, slamlog.NO_LANDMARK, dtype=np.int64)
    mask[step, row], true_ids[step, row] = True, ids
    odometry, poses, measurements[step, row] = tables
    counts = np.bincount(step, minlength=len(times)).tolist()
    order = "o".join("m" * count for count in counts) + "g" * len(times)
    written, blank = [*map(str, ids.tolist())], [""] * len(ids)
    is_usual = (
        not log.events
        and not len(log.ground_truth)
        and "".join([line[0] for line in lines[head:]]) == order
        and [moves[0], moves[3]] == [times[1:], ["1.0"] * len(odometry)]
        and truth[0] == times
        and (np.diff(step) >= 0).all()
        and readings[4:6] == ([blank, written] if hides else [])
        and readings[1] == (blank if hides else written)
        and ids.min() >= -hides
        and np.count_nonzero(mask) == len(ids)
        and "_" not in "".join(lines[head:])
        and all((abs(table) <= LARGEST).all() for table in tables)
    )
    if not is_usual:
        raise ValueError("another form")
    return Trajectory(
        **about,
        start_estimate=log.start,
        odometry=odometry,
        poses=poses,
        landmarks=log.landmarks,
        measurements=measurements,
        mask=mask,
        landmark_ids=true_ids if hides else None,
    )


def to_slamlog(trajectory: Trajectory) -> slamlog.SlamLog:
    """Return the log of a trajectory, for replay.

    Time counts steps, as in `record_episode`,
    whose log of the same seed is equal.

    Raises
    ------
    ValueError
        If the trajectory lacks measurements or landmarks.
    """
    landmarks = array_of(trajectory, "landmarks")
    measurements = array_of(trajectory, "measurements")
    mask = array_of(trajectory, "mask")
    true_ids = trajectory.landmark_ids
    events: list[slamlog.Event] = []
    for step, seen in enumerate(mask):
        if step > 0:
            distance, turn = trajectory.odometry[step - 1].tolist()
            events.append(slamlog.OdometryRow(float(step), distance, turn, dt=1.0))
        if seen.any():
            readings = measurements[step][seen]
            if trajectory.scenario.sensor.identities:
                scan = slamlog.Scan(float(step), readings, np.flatnonzero(seen))
            else:
                of = None if true_ids is None else true_ids[step][seen]
                scan = slamlog.Scan(float(step), readings, true_ids=of)
            events.append(scan)
    world, seed, start = trajectory.scenario, trajectory.seed, trajectory.start_estimate
    return log_of_episode(world, seed, start, landmarks, events, trajectory.poses)


def _from_log(log: slamlog.SlamLog, about: dict[str, Any]) -> Trajectory:
    moves = [event for event in log.events if isinstance(event, slamlog.OdometryRow)]
    rows = count_rows(about["scenario"])
    measurements = np.zeros((len(moves) + 1, rows, 2))
    mask = np.zeros((len(moves) + 1, rows), dtype=np.bool_)
    true_ids = np.full(mask.shape, slamlog.NO_LANDMARK, dtype=np.int64)
    for scan in log.scans:
        ids = scan.landmark_ids
        places = int(scan.t), np.arange(len(scan.measurements)) if ids is None else ids
        measurements[places], mask[places] = scan.measurements, True
        if scan.true_ids is not None:
            true_ids[places] = scan.true_ids
    hides = not about["scenario"].sensor.identities
    known = all(scan.true_ids is not None for scan in log.scans)
    return Trajectory(
        **about,
        start_estimate=log.start,
        odometry=np.array([(move.d, move.alpha) for move in moves]),
        poses=log.ground_truth[:, 1:],
        landmarks=log.landmarks,
        measurements=measurements,
        mask=mask,
        landmark_ids=true_ids if hides and known else None,
    )


#: The formats, or the modules that define them and load a library.
_ALL: dict[str, TrajectoryFormat | str] = {
    "slamlog": TrajectoryFormat(_write_slamlog, _read_slamlog),
    "npz": TrajectoryFormat(_write_npz, _read_npz, ENDING=".npz", HOLDS_BELIEFS=True),
    "parquet": "parquet",
    "minari": "minari_dataset",
    "tum": TrajectoryFormat(_write_tum, _read_tum, check=_check_tum),
    "g2o": "g2o",
}
#: The formats by name, or the modules to load them from.
FORMATS = {
    name: found
    for name, found in _ALL.items()
    if not isinstance(found, str) or is_here(f"experiments.trajectories.{found}")
}
