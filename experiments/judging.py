"""Judge the estimates of any program as a Monte Carlo judges filters: `judge`.

The drives hold the truth, and files the estimates: one a drive, or all drives in one.
`judge` matches both and measures every drive as a run, so that the verdict, the causes
and the report are those of a Monte Carlo. `read_estimates` reads the files.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from itertools import groupby, islice
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import numpy as np

from .. import argument_checks
from ..arrays import AnyArray, Array
from ..estimator.filters.batch import BatchTrace
from ..estimator.models.rigid_motion import invariant_error, pose_rotation, seen_from
from ..evaluation.consistency_report import evaluate_consistency
from ..evaluation.error_bound import PosteriorBound, map_error_squared
from ..evaluation.nees import normalised_squared_error, whitened
from ..evaluation.noise_findings import CHANNELS, MOMENTS
from ..evaluation.trajectory_error import Alignment, align_positions, poses_at
from ..sim_configs.scenario_files import scenario_text
from . import estimate_conventions
from .estimate_files import (
    DriveEstimate,
    beliefs_of,
    files_in,
    growing_rows,
    name_of,
    near_truth,
    paired,
    paths_by_label,
    read_estimates,
    true_path,
)
from .monte_carlo_study.filtered_runs import (
    Failure,
    FilteredRuns,
    bound_runs,
    noise_of_runs,
)
from .monte_carlo_study.results import provenance
from .monte_carlo_study.run_measures import (
    LARGEST_SCORE,
    VARIABLES,
    Block,
    by_id,
    deviations_by_id,
    measure_landmarks,
    measure_runs,
    write_failures,
)
from .monte_carlo_study.verdict import POSE_FREEDOM
from .run_and_replay.simulated_runs import SimulatedRuns
from .trajectories.manifest import MANIFEST, TrajectoryDataset, load_trajectories
from .trajectories.trajectory import Trajectory, array_of

if TYPE_CHECKING:
    import xarray as xr

Place: TypeAlias = str | PathLike[str]

#: The errors of covariances; the invariant error is the right-invariant one.
FRAMES = {"additive": "additive", "invariant": "invariant", "right": "invariant",
          "left": "left"}  # fmt: skip
_BOUNDS = ("position_bound", "position_bound_raw", "heading_bound", "map_bound")
_UNKNOWN = np.array(np.nan)
#: For estimates without a map: what came later may be in their poses.
_NO_BOUND = PosteriorBound(_UNKNOWN, _UNKNOWN, _UNKNOWN, _UNKNOWN)
NO_FILE = "there is no file of estimates"
_AT_ONCE = 100  # drives in memory
_ON_TIME = 0.01  # of a step
#: Second-order error of a landmark by the heading, as a share of its deviation, up to
#: which its NEES counts as χ².
_BEND = 0.2
_SYMMETRIC = 1e-6  # relative difference of two entries
_INDEFINITE = -1e-9  # eigenvalue of correlations
_NEAR = 1.5  # a mean NEES / 3 that an honest study may have
_TIME_UNITS = {"nanoseconds": 1e9, "microseconds": 1e6, "milliseconds": 1e3}
_COARSER = 1.5  # interval of the truth by that of the estimates
_ROUNDED = 1e-6  # of a time stamp in nanoseconds since 1970 [s]
_ASIDE, _ASIDE_GAIN = 0.01, 4.0  # of intervals of time, and of errors


def judge(
    estimates: Place | Sequence[Place] | Mapping[str, Place | Sequence[Place]],
    drives: Place | None = None,
    *,
    truth: Place | Sequence[Place] | None = None,
    covariances: str | None = None,
    align: str | Sequence[float] | None = None,
    command: str = "",
) -> xr.Dataset:
    """Measure estimates that any program made, as ``monte_carlo`` does its own.

    Parameters
    ----------
    estimates : path, sequence of paths, or mapping from labels to them
        Files of estimates, or folders of them. A folder is an estimator, named after
        it; files that are given by themselves belong to one.
    drives : path, optional
        The folder of :func:`generate_trajectories` that holds the truth; by default the
        estimates, if they are such a folder with the beliefs of a filter.
    truth : path or sequence of paths, optional
        True paths of drives from elsewhere, instead of ``drives``.
    covariances : {"additive", "invariant", "right", "left"}, optional
        The error whose covariances the files hold; "right" is "invariant". Its NEES
        decides; for "left" that of the invariant error, which is the same. By default
        covariances are read as additive, and the additive or the invariant error
        decides: the one that rejects fewer estimators, so that one which is honest in
        either is rejected in at most 5 % of cases. Where both reject equally many, it
        is the invariant one, or the additive one if its mean NEES is nearer to 3 and at
        most 1.5 times off. For beliefs of filters in a data set, it is the invariant
        one.
    align : "fit" or (x, y, θ), optional
        A motion [m, m, rad] of all estimates, covariances included, into the frame of
        the truth. "fit" finds the one that brings each path closest to the truth; NEES
        then is not χ², and there is no verdict.
    command : str
        Command that reproduces the results.

    Returns
    -------
    xarray.Dataset
        As ``monte_carlo`` returns it, without NIS and the NEES of whole states. Runs
        are in the order of their seeds or names. If the files have no seeds, ``run``
        holds their names. A drive without usable estimates is a failed run. The
        attribute ``mistakes`` names conventions that files break.

    Raises
    ------
    ValueError
        If a file is malformed, or matches no drive.
    OSError
        If a file cannot be read.

    Examples
    --------
    >>> from tempfile import mkdtemp
    >>> from slamgym import generate_trajectories
    >>> folder = mkdtemp()
    >>> job = {"episodes": 3, "estimator": "invariant", "controller": "open_loop"}
    >>> _ = generate_trajectories("six_landmarks", folder, **job)
    >>> float(judge(folder).pose_nees_invariant.mean() / 3) < 2
    True
    """
    if covariances is not None:
        argument_checks.one_of("covariances", covariances, tuple(FRAMES))
    frame = FRAMES[covariances or "additive"]
    if align not in (None, "fit"):
        align = argument_checks.finite_vector("align", align, 3).tolist()
    if truth is not None and drives is not None:
        raise ValueError("truth must be None where drives are given")
    sources = paths_by_label(estimates)
    task = _drives(drives, sources) if truth is None else _paths(truth, sources)
    parts: dict[str, list[_Part]] = {label: [] for label in sources}
    for chunk in task.chunks:
        for label, files in chunk.estimates.items():
            parts[label].append(_measured(chunk, files, frame, align))
    decides = "additive" if covariances == "additive" else "invariant"
    notes: list[str] = []
    if covariances is None and not task.is_own:
        decides, notes = _deciding(parts)
    mistakes = {
        label: _mistakes(each, task, frame, decides) for label, each in parts.items()
    }
    about = {
        "title": f"Estimates of {len(task.names)} drives of {task.title}",
        "scenario_name": task.title,
        "scenario": task.scenario,
        "estimators": json.dumps({k: {"name": k, "options": {}} for k in sources}),
        "seed": task.seed,
        "mistakes": json.dumps(mistakes),
        "alignment": "fitted" if align == "fit" else "given" if align else "",
        "frame": decides,
        "notes": json.dumps([*task.notes, *notes]),
        **provenance(command or f"judge({estimates!r}, {drives!r}, truth={truth!r})"),
    }
    blocks = {k: [part.block for part in each] for k, each in parts.items()}
    return _dataset(blocks, task, about)


class _Chunk(NamedTuple):
    """Some drives with all estimates of them, and what a filter could know."""

    runs: SimulatedRuns
    #: By label; the reason where there is none.
    estimates: dict[str, list[DriveEstimate | str]]
    bound: PosteriorBound
    noise: Array
    #: Seconds of a step.
    dt: float = 1.0
    #: True poses of all drives some steps later, nan where unknown.
    truth_at: Callable[[float], Array] | None = None


class _Task(NamedTuple):
    """What is judged."""

    title: str
    #: As TOML; empty for drives from elsewhere.
    scenario: str
    seed: int
    #: Seeds, or names of files.
    names: list[Any]
    chunks: Iterator[_Chunk]
    #: What was left out or converted, as sentences.
    notes: tuple[str, ...] = ()
    #: Whether all estimates are the beliefs in data sets.
    is_own: bool = False


class _Part(NamedTuple):
    """Measures of the drives of a chunk, and what names mistakes."""

    block: Block
    #: Truth, poses and covariances as in the files, and starts.
    arrays: tuple[Array, Array, Array, Array]
    #: See `_Chunk`.
    truth_at: Callable[[float], Array] | None = None


# --------------------------------------------------------------------------------------
# The drives: of a data set with known worlds, or true paths from elsewhere.


def _drives(place: Place | None, sources: dict[str, list[Path]]) -> _Task:
    """Match estimates with the drives of a data set, by their seeds."""
    if place is None:
        (place, *more) = [path for paths in sources.values() for path in paths]
        if more or not (place / MANIFEST).is_file():
            raise ValueError(
                "drives must be the folder of slamgym generate that holds the truth, "
                "or truth must be given, got neither"
            )
    folder, data = Path(place), load_trajectories(place)
    job = data.manifest.job
    seeds = [
        job.seed + shard.first_episode + k
        for shard in data.manifest.shards
        for k in range(shard.episodes)
    ]
    found: dict[str, dict[Any, DriveEstimate] | None] = {}
    for label, paths in sources.items():
        is_own = [path.resolve() for path in paths] == [folder.resolve()]
        found[label] = files = None if is_own else read_estimates(paths)
        if files is not None and not set(files) & set(seeds):
            raise ValueError(
                f"no estimates of {label} match a drive of {folder}: files must be "
                f"named after its seeds, such as seed_{seeds[0]:08d}.csv, got "
                f"{next(iter(files.values())).file}"
            )
    text = scenario_text(job.scenario)
    own = [
        found[label] is None or all((path / MANIFEST).is_file() for path in paths)
        for label, paths in sources.items()
    ]
    chunks = _chunks(data, found)
    return _Task(job.scenario.name, text, job.seed, seeds, chunks, is_own=all(own))


def _chunks(
    data: TrajectoryDataset, found: Mapping[str, Mapping[Any, DriveEstimate] | None]
) -> Iterator[_Chunk]:
    """Yield some drives at a time; None stands for the beliefs that are in the data."""
    drives = iter(data)
    while some := list(islice(drives, _AT_ONCE)):
        files: dict[str, list[DriveEstimate | str]] = {
            label: [
                beliefs_of(drive, str(data.folder))
                if each is None
                else each.get(drive.seed, NO_FILE)
                for drive in some
            ]
            for label, each in found.items()
        }
        runs = _runs_of(some)
        alike = list(_alike(some, runs))
        noise = np.concatenate([noise_of_runs(s, s, same) for s, same in alike])
        bound = _NO_BOUND
        given = (each for listed in files.values() for each in listed)
        if any(
            isinstance(each, DriveEstimate) and len(each.landmark_ids) for each in given
        ):
            bounds = [bound_runs(scenario, same)[:4] for scenario, same in alike]
            joined = (np.concatenate(each) for each in zip(*bounds, strict=True))
            position, heading, raw, of_map = joined
            bound = PosteriorBound(position, heading, raw, of_map)
        yield _Chunk(runs, files, bound, noise, some[0].scenario.dt)


def _runs_of(drives: Sequence[Trajectory]) -> SimulatedRuns:
    """Return drives as runs; the first scan precedes any motion."""

    def stacked(name: str) -> AnyArray:
        return np.stack([array_of(each, name) for each in drives])

    hidden = drives[0].landmark_ids is not None
    still = np.zeros((len(drives), 1, 2))
    return SimulatedRuns(
        odometry=np.concatenate([still, stacked("odometry")], axis=1),
        measurements=stacked("measurements"),
        visible=stacked("mask"),
        true_poses=stacked("poses"),
        landmarks=stacked("landmarks"),
        initial_poses=stacked("start_estimate"),
        true_ids=stacked("landmark_ids") if hidden else None,
    ).identified()


def _alike(
    drives: Sequence[Trajectory], runs: SimulatedRuns
) -> Iterator[tuple[Any, SimulatedRuns]]:
    """Yield neighbouring runs of one scenario together."""
    begin = 0
    for scenario, same in groupby(drives, key=lambda drive: drive.scenario):
        rows = slice(begin, begin + len(list(same)))
        begin = rows.stop
        parts = {n: a[rows] for n, a in runs._asdict().items()
                 if a is not None and n != "ids"}  # fmt: skip
        yield scenario, runs._replace(**parts)


def _paths(truth: Place | Sequence[Place], sources: dict[str, list[Path]]) -> _Task:
    """Match estimates with true paths, by the names of their files.

    The truth is interpolated at the times of the estimates. All drives are judged at
    the same number of poses, evenly spread over those that lie within the truth.
    """
    (places,) = paths_by_label(truth).values()
    true = {name_of(path): true_path(path) for path in files_in(places)}
    if not true:
        raise ValueError(f"truth must be at least one file, got none in {places[0]}")
    found = {
        label: paired(read_estimates(paths), list(true))
        for label, paths in sources.items()
    }
    names = sorted(true, key=lambda name: (isinstance(name, str), name))
    inside = {
        (label, name): _within(each[name], true[name])
        for label, each in found.items()
        for name in names
        if name in each
    }
    if not inside:
        raise ValueError(
            "estimates and truth must share their names, such as run_1.tum in one "
            f"folder each, got truth named {names[0]}, and estimates named "
            f"{next((n for each in found.values() for n in each), 'nothing')}"
        )
    count = min(len(each.truth) for each in inside.values())

    def chunks() -> Iterator[_Chunk]:
        for label in found:
            files: list[DriveEstimate | str] = []
            poses = np.full((len(names), count, 3), np.nan)
            clocks = []
            for row, name in enumerate(names):
                if (label, name) not in inside:
                    files.append(NO_FILE)
                    continue
                estimate, exact, times, *_ = inside[label, name]
                few = np.linspace(0, len(exact) - 1, count).round().astype(int)
                poses[row] = exact[few]
                clocks.append((row, times[few], true[name]))
                files.append(estimate.at(few)._replace(times=None))
            empty = np.zeros((len(names), count, 0, 2))  # of a world without landmarks
            runs = SimulatedRuns(
                odometry=np.zeros((len(names), count, 2)),
                measurements=empty,
                visible=np.zeros(empty.shape[:3], np.bool_),
                true_poses=poses,
                landmarks=empty[:, 0],
                initial_poses=poses[:, 0],
            )
            noise = np.zeros((len(names), len(CHANNELS), len(MOMENTS)))
            truth_at = partial(_truth_at, poses, clocks)
            yield _Chunk(runs, {label: files}, _NO_BOUND, noise, truth_at=truth_at)

    notes = _notes(inside.values())
    return _Task(Path(places[0]).stem, "", 0, names, chunks(), notes)


def _truth_at(
    truth: Array, clocks: Sequence[tuple[int, Array, Array]], steps: float
) -> Array:
    """Return the true poses (B, K, 3) of drives some steps after their times."""
    later = np.full_like(truth, np.nan)
    for row, times, path in clocks:
        later[row] = poses_at(times + steps * np.median(np.diff(times)), path)
    return later


class _Inside(NamedTuple):
    """The estimates of a file that have a truth, and the truth there."""

    estimate: DriveEstimate
    truth: Array
    #: Shape (T,) [s].
    times: Array
    #: Poses of the file that have none.
    left_out: int = 0
    #: Unit of the time stamps, if they were converted.
    unit: str = ""
    #: Whether the truth has longer intervals.
    is_coarse: bool = False


def _within(estimate: DriveEstimate, path: Array) -> _Inside:
    """Return the estimates at times of a true path (n, 4), and the truth there.

    A pose in a gap of the truth has none, because no interpolation is valid there.
    """
    if estimate.times is None:
        if len(estimate.poses) != len(path):
            raise ValueError(
                f"{estimate.file} has no times and must have as many poses as its "
                f"truth, {len(path)}, got {len(estimate.poses)}"
            )
        return _Inside(estimate, path[:, 1:], path[:, 0])
    places = [f"{estimate.file}, pose {k}" for k in range(len(estimate.poses))]
    rows = np.column_stack([estimate.times, estimate.poses])
    estimate = estimate.at(growing_rows(rows, places))
    times, due = estimate.times, path[:, 0]
    assert times is not None
    times, unit = _in_seconds(times, estimate.poses, path)
    exact = poses_at(times, path)
    known = np.isfinite(exact).all(axis=1) & near_truth(times, due)
    inside = np.flatnonzero(known)
    if len(inside) < 2:
        raise ValueError(
            f"{estimate.file} and its truth must share at least two times, got "
            f"{times[0]:.10g} to {times[-1]:.10g} s, and {due[0]:.10g} to "
            f"{due[-1]:.10g} s; write both in seconds of one clock"
        )
    left_out = len(times) - len(inside)
    kept = estimate.at(inside)
    spacings = [float(np.median(np.diff(each))) for each in (due, times[inside])]
    is_coarse = spacings[0] > _COARSER * spacings[1]
    return _Inside(kept, exact[inside], times[inside], left_out, unit, is_coarse)


def _in_seconds(times: Array, poses: Array, path: Array) -> tuple[Array, str]:
    """Return times in the unit of a true path, and which unit had to be converted.

    They are converted if the intervals then coincide and did not before, and if the
    poses are then far nearer to the truth.
    """

    def overlap(found: Array) -> float:
        low, high = max(found[0], due[0]), min(found[-1], due[-1])
        whole = max(found[-1], due[-1]) - min(found[0], due[0])
        return max(float((high - low) / whole), 0.0)

    def distance(found: Array) -> float:
        gaps = np.linalg.norm(poses_at(found, path)[:, :2] - poses[:, :2], axis=1)
        known = gaps[np.isfinite(gaps)]
        return float(np.median(known)) if len(known) > 1 else np.inf

    due = path[:, 0]
    if overlap(times) > _ASIDE:
        return times, ""
    for name, size in _TIME_UNITS.items():
        for read, whose in ((times / size, ""), (times * size, "of the truth ")):
            ends = np.clip(read, due[0], due[-1])
            is_end = abs(ends - read) < _ROUNDED * (size if whose else 1.0)
            found = np.where(is_end, ends, read)
            if overlap(found) > 0.5 and distance(found) < distance(times) / _ASIDE_GAIN:
                return found, f"{whose}are {name}"
    return times, ""


def _notes(found: Iterable[_Inside]) -> tuple[str, ...]:
    """Write what was left out or converted, once for all files."""
    notes, every = [], list(found)
    units = [each for each in every if each.unit]
    if units:
        others = f", as in {len(units)} files" if len(units) > 1 else ""
        notes.append(
            f"{units[0].estimate.file}: the time stamps {units[0].unit}{others}; they "
            "are converted to seconds."
        )
    short = [each for each in every if each.left_out]
    if short:
        poses = sum(each.left_out + len(each.truth) for each in every)
        notes.append(
            f"{sum(each.left_out for each in short)} of {poses} poses have no truth "
            f"near their times and are left out; the first file is "
            f"{short[0].estimate.file}, with {short[0].left_out}."
        )
    coarse = [each for each in every if each.is_coarse]
    if coarse:
        notes.append(
            f"the truth of {coarse[0].estimate.file} has fewer poses than the "
            "estimate. Interpolation between these poses adds to the errors."
        )
    flat = [each for each in every if each.estimate.is_spatial]
    if flat:
        notes.append(
            f"{flat[0].estimate.file} holds poses in space: only x, y and yaw are "
            "judged; --space judges all six coordinates."
        )
    return tuple(notes)


# --------------------------------------------------------------------------------------
# The measures.


def _measured(
    chunk: _Chunk, files: Sequence[DriveEstimate | str], frame: str, align: Any
) -> _Part:
    """Measure the estimates of one estimator on the drives of a chunk."""
    truth = chunk.runs.true_poses
    count, steps, _ = truth.shape
    poses = np.full((count, steps, 3), np.nan)
    claims = np.full((count, steps, 3, 3), np.nan)
    failures: dict[int, Failure] = {}
    for run, each in enumerate(files):
        if isinstance(each, str):
            failures[run] = Failure(-1, each)
        elif reason := _unmatched(each, steps, chunk.dt):
            failures[run] = Failure(-1, reason)
        else:
            poses[run], claims[run] = each.poses, each.covariances
    additive = estimate_conventions.additive_covariances(poses, claims, frame)
    moved = poses
    if align is not None:
        moved, additive = _aligned(poses, additive, truth, align)
    failures |= _invalid(claims, additive, failures)
    trace = BatchTrace(
        moved, additive, np.zeros((count, steps)), np.zeros((count, steps), np.int64)
    )
    filtered = FilteredRuns(trace, [None] * count, failures, {})
    block = measure_runs(chunk.runs, filtered, chunk.bound, chunk.noise)
    block["readings"][:] = 0  # which of them corrected anything is not known
    for run, each in enumerate(files):
        if isinstance(each, str) or run in failures:
            continue
        unsure = float("inf") if align else float(additive[run, 0, 2, 2])
        if problem := _add_map(block, run, chunk.runs, each, moved[run, -1], unsure):
            failures[run] = Failure(steps - 1, problem)
    write_failures(block, failures)
    arrays = truth, poses, claims, chunk.runs.initial_poses
    return _Part(block, arrays, chunk.truth_at)


def _unmatched(estimate: DriveEstimate, steps: int, dt: float) -> str:
    """Return why the poses of a file are not those of a drive; empty if they are."""
    count = len(estimate.poses)
    if estimate.times is None:
        return "" if count == steps else f"it has {count} poses, the drive {steps}"
    due, times = np.arange(steps), estimate.times / (dt if estimate.in_seconds else 1.0)

    def on_time(found: Array) -> bool:
        return count == steps and np.allclose(found, due, rtol=0, atol=_ON_TIME)

    if on_time(times):
        return ""
    if on_time(times - times[0]):
        return f"its time stamps begin at step {times[0]:.6g}, not at step 0"
    if on_time(times / dt):
        return f"its time stamps are seconds, not steps of {dt:g} s"
    if missing := np.setdiff1d(due, times.round()).tolist():
        return (
            f"it has no pose for {len(missing)} of the steps 0 to {steps - 1}; the "
            f"first of them is step {missing[0]}"
        )
    row = int((abs(times[:steps] - due) > _ON_TIME).argmax())
    return f"pose {row} is that of step {times[row]:.6g}; each step needs one"


def _invalid(
    claims: Array, additive: Array, failures: Mapping[int, Failure]
) -> dict[int, Failure]:
    """Find runs whose matrices are not covariances."""
    gaps = abs(claims - np.swapaxes(claims, -1, -2)).max(axis=(2, 3))
    sizes = abs(claims).max(axis=(1, 2, 3))[:, None]
    nothing = np.broadcast_to(sizes == 0, gaps.shape)
    variances = np.einsum("rsii->rsi", additive)
    negative = (variances < 0).any(axis=2)
    deviations = np.sqrt(np.where(variances > 0, variances, np.inf))
    correlations = np.nan_to_num(additive / deviations[..., None])
    correlations = correlations / deviations[:, :, None]
    # A matrix that whitens errors is positive definite: no eigenvalues are needed.
    unsure = ~np.isfinite(whitened(np.zeros(variances.shape), additive)).all(axis=2)
    indefinite = np.zeros_like(unsure)
    indefinite[unsure] = np.linalg.eigvalsh(correlations[unsure])[..., 0] < _INDEFINITE
    found: dict[int, Failure] = {}
    for reason, wrong in (
        ("an entry of the covariance is not finite", ~np.isfinite(gaps)),
        ("all entries of its covariances are 0", nothing),
        ("the covariance is not symmetric", gaps > _SYMMETRIC * sizes),
        ("a variance is negative", negative),
        ("the covariance is indefinite: a correlation is too large", indefinite),
    ):
        for run in set(np.flatnonzero(wrong.any(axis=1)).tolist()) - set(failures):
            found.setdefault(run, Failure(int(wrong[run].argmax()), reason))
    return found


def _aligned(
    poses: Array, covariances: Array, truth: Array, align: Any
) -> tuple[Array, Array]:
    """Move estimates X̂ to T X̂ with their covariances.

    The covariance of the additive error becomes diag(R, 1) P diag(R, 1)ᵀ; to first
    order, that of the left-invariant error stays, and that of the right-invariant error
    becomes Ad_T P Ad_Tᵀ.
    """
    poses, covariances = poses.copy(), covariances.copy()
    for run in range(len(poses)):
        motion = Alignment(0.0, np.zeros(2))
        if align != "fit":
            motion = Alignment(align[2], np.array(align[:2]))
        elif np.isfinite(poses[run]).all():
            motion = _fitted(poses[run, :, :2], truth[run, :, :2])
        poses[run, :, :2] = motion.apply(poses[run, :, :2])
        poses[run, :, 2] += motion.angle
        turn = pose_rotation(motion.angle)
        covariances[run] = turn @ covariances[run] @ turn.T
    return poses, covariances


def _fitted(positions: Array, truth: Array) -> Alignment:
    """Return the motion onto the truth, without a turn where the robot rests."""
    motion = align_positions(positions, truth)
    gaps = np.square(motion.apply(positions) - truth).sum()
    if gaps * 4 < np.square(truth - truth.mean(axis=0)).sum():
        return motion
    return Alignment(0.0, truth.mean(axis=0) - positions.mean(axis=0))


def _add_map(
    block: Block,
    run: int,
    runs: SimulatedRuns,
    estimate: DriveEstimate,
    pose: Array,
    heading_variance: float,
) -> str:
    """Measure the final map of a run into its block; return the problem, if any.

    The files hold no covariances between pose and map. So the verdict covers the
    landmarks in the frame of the map, unless the heading of the start is so uncertain
    that it bends their errors, whose NEES then is not χ². An infinite variance stands
    for aligned estimates, whose landmarks are not aligned.
    """
    ids, count = estimate.landmark_ids, runs.landmarks.shape[1]
    if not len(ids) or not count:
        return ""
    if ids.max() >= count:
        return f"its map has landmark {ids.max()}, the world has {count} from 0 on"
    truth, claims = runs.landmarks[run], estimate.landmark_covariances
    measured = measure_landmarks(
        truth[None], ids[None], estimate.landmarks[None], claims[None]
    )
    near = (
        seen_from(pose[:2], np.append(at, points))
        for at, points in (
            (runs.true_poses[run, -1], truth[ids]),
            (pose, estimate.landmarks),
        )
    )
    errors = invariant_error(*near)[3:].reshape(-1, 2)
    measured["map_error_centred"] = np.sqrt(map_error_squared(errors))[None]
    squares = normalised_squared_error(truth[ids] - estimate.landmarks, claims)
    measured["landmark_nees_additive"] = by_id(squares[None], ids[None], count)
    measured["landmark_mahalanobis"] = np.sqrt(measured["landmark_nees_additive"])
    bend = np.hypot(*(truth[ids] - estimate.poses[0, :2]).T) * heading_variance
    least = np.sqrt(np.maximum(np.linalg.eigvalsh(claims)[:, 0], 0.0))
    rows = np.flatnonzero(bend <= _BEND * least)
    deviations = whitened(truth[ids][rows] - estimate.landmarks[rows], claims[rows])
    measured |= deviations_by_id(deviations[None], ids[None, rows], count)
    for name, value in measured.items():
        block[name][run] = value[0]
    return ""


def _deciding(parts: Mapping[str, Sequence[_Part]]) -> tuple[str, list[str]]:
    """Return the error that decides where none is declared, and notes about it.

    It is the one that rejects fewer estimators. A choice by the mean NEES alone would
    reject an honest estimator in more than 5 % of cases, because it may choose the
    error in which the estimator is not honest.
    """
    rejected: dict[str, dict[str, bool]] = {}
    gaps = {}
    for frame in ("invariant", "additive"):
        scores = {
            label: np.concatenate([p.block[f"pose_nees_{frame}"] for p in each])[:, 1:]
            for label, each in parts.items()
        }
        rejected[frame] = {label: _is_rejected(nees) for label, nees in scores.items()}
        known = np.concatenate([each[np.isfinite(each)] for each in scores.values()])
        mean = float(known.mean()) / POSE_FREEDOM if len(known) else 1.0
        gaps[frame] = abs(np.log(max(mean, 1e-300)))
    counts = {frame: sum(each.values()) for frame, each in rejected.items()}
    is_additive = gaps["additive"] < min(gaps["invariant"], np.log(_NEAR))
    if counts["additive"] != counts["invariant"]:
        is_additive = counts["additive"] < counts["invariant"]
    chosen, other = "additive", "invariant"
    if not is_additive:
        chosen, other = other, chosen
    return chosen, [
        f"{label}: its covariances agree with the {other} error, but not with the "
        f"{chosen} error, which decides for all estimators. Judge {label} in a "
        "separate call."
        for label, is_bad in rejected[chosen].items()
        if is_bad and not rejected[other][label]
    ]


def _is_rejected(nees: Array) -> bool:
    """Whether the NEES of runs (M, K) is not that of an honest estimator, at 5 %."""
    scores = np.where(nees < LARGEST_SCORE, nees, np.nan)
    first = int(np.isfinite(scores).any(axis=0).argmax())
    scores = scores[np.isfinite(scores[:, first:]).all(axis=1)]
    if len(scores) < 2 or scores.shape[1] < 2:
        return False
    none, rng = np.zeros_like(scores), np.random.default_rng(0)
    report = evaluate_consistency(
        scores, none, none, dof=POSE_FREEDOM, frame="invariant", rng=rng
    )
    return not report.accepted


def _mistakes(parts: Sequence[_Part], task: _Task, frame: str, decides: str) -> str:
    """Name the convention that an estimator breaks, if any."""
    last = parts[0].arrays[0].shape[1] - 1
    steps = np.unique(np.linspace(1, last, 25).astype(int))
    truth, poses, claims = (
        np.concatenate([part.arrays[place][:, steps] for part in parts])
        for place in range(3)
    )
    additive = estimate_conventions.additive_covariances(poses, claims, frame)
    counts = np.cumsum([len(part.arrays[0]) for part in parts])
    few = parts[: int(np.searchsorted(counts, estimate_conventions.MOST_DRIVES)) + 1]
    first = [np.concatenate([part.arrays[place] for part in few]) for place in range(4)]
    (truth_at, *others) = [part.truth_at for part in few]
    ratios = np.concatenate([p.block["pose_nees_invariant"] for p in parts]) / 3
    return (
        estimate_conventions.swapped_drives(truth, poses, additive, task.names)
        or estimate_conventions.mistake_in_estimates(
            *(first[0], first[1], first[2], first[3], frame),
            decides=decides,
            truth_at=None if others else truth_at,
        )
        or estimate_conventions.stray_poses(ratios, task.names)
    )


def _dataset(
    blocks: Mapping[str, Sequence[Block]], task: _Task, about: dict[str, Any]
) -> xr.Dataset:
    import xarray as xr  # noqa: PLC0415

    of_world = {"noise_sums", *_BOUNDS} if not task.scenario else set()
    arrays = {
        name: (
            ("estimator", *variable.dims),
            np.stack(
                [np.concatenate([b[name] for b in each]) for each in blocks.values()]
            ).astype(object if variable.kind == "U" else variable.kind),
            {"long_name": variable.meaning},
        )
        for name, variable in VARIABLES.items()
        if name not in of_world
    }
    numbered = all(isinstance(name, int) for name in task.names)
    runs = [n - task.seed if numbered else str(n) for n in task.names]
    coordinates = {
        "estimator": np.array(list(blocks)),
        "run": np.array(runs, dtype=None if numbered else object),
        "noise": np.array(CHANNELS),
        "moment": np.array(MOMENTS),
    }
    return xr.Dataset(arrays, coordinates, about)
