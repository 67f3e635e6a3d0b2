"""Run one filter over many simulated runs: in a batch if possible, else one by one.

`filter_runs` filters. `bound_runs` computes the bound on the errors of any filter, and
`noise_of_runs` the actual noise of the runs.
"""

import contextlib
import itertools
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple, cast

import numpy as np

from ...arrays import Array, BoolArray
from ...envs.robot import wall_distances
from ...estimator import interface
from ...estimator.filters.batch import BatchSlam, BatchTrace, can_batch
from ...estimator.filters.ekf import EkfSlam
from ...estimator.guards.saved_states import is_semidefinite
from ...estimator.models.bearing_range import wrap_angle
from ...estimator.models.motions import find_motion
from ...estimator.models.sensors import Sensor, find_sensor
from ...evaluation.error_bound import PosteriorBound, posterior_bound
from ...evaluation.nees import SINGULAR
from ...evaluation.noise_findings import noise_sums
from ...sim_configs import Scenario
from ..run_and_replay.filter_settings import FilterSettings, refuse_large_map
from ..run_and_replay.simulated_runs import SimulatedRuns
from ..run_and_replay.trace import DecisionRecorder, RunDecisions, is_finite

_NOT_FINITE = "the pose, its covariance or the NIS is not finite"
_MAP_NOT_FINITE = "the belief about the map is not finite"


class Failure(NamedTuple):
    """Where and why a run failed."""

    #: Step of the run.
    step: int
    message: str


class FilteredRuns(NamedTuple):
    """The beliefs of a filter in B runs."""

    #: The belief after every step; nan from the step on at which a run failed.
    trace: BatchTrace
    #: Final beliefs; None for a run that failed.
    beliefs: list[interface.Belief | None]
    #: By the index of the run.
    failures: dict[int, Failure]
    #: About readings without identity, by the index of the run.
    decisions: dict[int, RunDecisions]

    @classmethod
    def unknown(cls, runs: SimulatedRuns) -> "FilteredRuns":
        """Return those of a filter that has not run yet."""
        count, steps, _ = runs.visible.shape
        trace = BatchTrace(
            np.full((count, steps, 3), np.nan),
            np.full((count, steps, 3, 3), np.nan),
            np.full((count, steps), np.nan),
            np.zeros((count, steps), dtype=np.int64),
        )
        return cls(trace, [None] * count, {}, {})


def filter_runs(
    settings: FilterSettings, runs: SimulatedRuns, *, threads: int | None = None
) -> FilteredRuns:
    """Feed every run to a filter of its own.

    A filter made of the shared kernels runs in a batch, any other one step by step; the
    results are the same to the last bit. An error in one run ends that run alone.

    Parameters
    ----------
    settings : FilterSettings
        Makes the filters.
    runs : SimulatedRuns
        Their input.
    threads : int, optional
        Threads of a batch; all cores by default.
    """
    first = settings.make(runs.initial_poses[0])
    is_batch = can_batch(first) and runs.true_ids is None
    is_batch = is_batch and cast(EkfSlam, first).sensor.places
    read = runs.identified().visible.any(axis=1).sum(axis=1)  # by each run
    refuse_large_map(int(read.max()), first)
    if is_batch:
        return _in_a_batch(cast(EkfSlam, first), settings, runs, threads)
    found = FilteredRuns.unknown(runs)
    for run in range(len(found.beliefs)):
        failure = _one_by_one(settings, runs, run, found)
        if failure is not None:
            _erase(found.trace, run, failure.step)
            found.failures[run] = failure
    return found


def _in_a_batch(
    slam: EkfSlam, settings: FilterSettings, runs: SimulatedRuns, threads: int | None
) -> FilteredRuns:
    count, _, landmarks = runs.visible.shape
    batch = BatchSlam(
        slam,
        count,
        landmarks,
        initial_poses=runs.initial_poses,
        initial_pose_std=settings.initial_pose_std,
        threads=threads,
    )
    trace = _run(batch, runs)
    finite = _finite(trace)
    beliefs = [_renamed(batch.belief(run), runs) for run in range(count)]
    finite[:, -1] &= [is_finite(belief) for belief in beliefs]
    found = FilteredRuns(trace, [*beliefs], {}, {})
    for run in np.flatnonzero(~finite.all(axis=1)).tolist():
        # the single filter repeats the run, for its message
        failure = _one_by_one(settings, runs, run, FilteredRuns.unknown(runs))
        failure = failure or Failure(int(finite[run].argmin()), _NOT_FINITE)
        _erase(trace, run, failure.step)
        found.beliefs[run], found.failures[run] = None, failure
    return found


def _run(batch: BatchSlam, runs: SimulatedRuns) -> BatchTrace:
    """Run a batch, in pieces that end where the poses are read."""
    steps = runs.visible.shape[1]
    due = [t for t in range(steps) if runs.pose_reading(t) is not None]
    traces, begin = [], 0
    for end in sorted({*(t + 1 for t in due), steps}):
        part = slice(begin, end)
        trace = batch.run(
            runs.odometry[:, part],
            runs.measurements[:, part],
            runs.visible[:, part],
            runs.dt[part],
        )
        if (given := runs.pose_reading(end - 1)) is not None:
            nis, freedom = batch.observe_pose(*given)
            going, now = np.isfinite(trace.nis[:, -1]), batch.storage()
            trace.nis[:, -1] += nis
            trace.degrees_of_freedom[:, -1] += freedom
            trace.poses[going, -1] = now.means[going, :3]
            trace.poses[:, -1, 2] = wrap_angle(trace.poses[:, -1, 2])
            trace.pose_covariances[going, -1] = now.covariances[going, :3, :3]
        traces.append(trace)
        begin = end
    if len(traces) == 1:
        return traces[0]
    parts = zip(*traces, strict=True)
    return BatchTrace(*(np.concatenate(part, axis=1) for part in parts))


def _renamed(belief: interface.Belief, runs: SimulatedRuns) -> interface.Belief:
    """Return a belief of a batch, which names landmarks by their rows, by their ids."""
    if runs.ids is None:
        return belief
    rows = np.array(belief.landmark_ids, dtype=np.int64)
    return replace(belief, landmark_ids=tuple(runs.ids_of(rows)))


def _one_by_one(
    settings: FilterSettings, runs: SimulatedRuns, run: int, found: FilteredRuns
) -> Failure | None:
    """Filter one run, fill its row of the trace, keep final belief and decisions."""
    from ...estimator.map_management.managed_slam import filter_in  # noqa: PLC0415 (many)

    step, trace = 0, found.trace
    try:
        slam = settings.make(runs.initial_poses[run])
        recorder = DecisionRecorder(slam)
        observer = slam if hasattr(slam, "observe_truth") else None
        landmarks = dict(enumerate(runs.landmarks[run]))
        for step in range(runs.visible.shape[1]):
            if observer is not None:
                observer.observe_truth(runs.true_poses[run, step], landmarks)
            belief = _step(slam, runs, run, step, trace, recorder)
            if not _finite(trace, (run, step)):
                return Failure(step, _NOT_FINITE)
        smoothed = getattr(filter_in(slam), "smoothed", None)
        if callable(smoothed):  # without innovations, and so without NIS
            path = smoothed()
            belief, covariances = path.belief(), path.pose_covariances
            trace.poses[run], trace.pose_covariances[run] = path.poses, covariances
            trace.nis[run], trace.degrees_of_freedom[run] = 0.0, 0
    except (Exception, SystemExit) as error:
        return Failure(step, f"{type(error).__name__}: {error}")
    if not is_finite(belief):
        return Failure(step, _MAP_NOT_FINITE)
    found.beliefs[run] = belief
    if runs.true_ids is not None and (made := recorder.result()) is not None:
        found.decisions[run] = made
    return None


def _step(
    slam: interface.SlamEstimator,
    runs: SimulatedRuns,
    run: int,
    step: int,
    trace: BatchTrace,
    recorder: DecisionRecorder,
) -> interface.Belief:
    if step > 0:  # the first scan is before any motion
        slam.predict(runs.odometry[run, step], runs.dt[step])
    seen = np.flatnonzero(runs.visible[run, step])
    readings = runs.measurements[run, step, seen]
    if runs.true_ids is None:
        report = slam.update(readings, runs.ids_of(seen))
    else:
        report = slam.update(readings)
        recorder.add(report, runs.true_ids[run, step, seen])
    if (given := runs.pose_reading(step)) is not None:
        z, H, R = given
        fix = interface.taking_poses(slam).observe_pose(z[run], H, R)
        report = interface.with_fix(report, fix)
    belief = slam.belief()
    trace.poses[run, step] = belief.pose
    trace.pose_covariances[run, step] = belief.pose_covariance
    trace.nis[run, step] = report.nis
    trace.degrees_of_freedom[run, step] = report.degrees_of_freedom
    return belief


def _finite(trace: BatchTrace, where: Any = ...) -> BoolArray:
    """Report where the trace is finite, shape (B, T), or (T,) or () of a part."""
    poses, covariances = trace.poses[where], trace.pose_covariances[where]
    known = np.isfinite(poses).all(axis=-1) & np.isfinite(trace.nis[where])
    return np.asarray(known & np.isfinite(covariances).all(axis=(-2, -1)))


def _erase(trace: BatchTrace, run: int, step: int) -> None:
    """Set a run to nan from the step on at which it failed."""
    for array in (trace.poses, trace.pose_covariances, trace.nis):
        array[run, step:] = np.nan
    trace.degrees_of_freedom[run, step:] = 0


# --------------------------------------------------------------------------------------
# Why a covariance gives no NEES: which part of it is wrong, and since when.

_POSE_NAMES = ("x", "y", "θ")


def covariance_flaw(covariance: Array, names: Sequence[str] = _POSE_NAMES) -> str:
    """Write why a covariance gives no NEES, "" if it gives one.

    Parameters
    ----------
    covariance : ndarray, shape (n, n)
    names : sequence of str
        Names of the n numbers.

    Examples
    --------
    >>> covariance_flaw(np.array([[4.0, 4.08], [4.08, 4.0]]), ("x", "y"))
    'has the correlation 1.02 of x and y'
    >>> covariance_flaw(np.zeros((3, 3)))
    'is all zeros'
    """
    variances = covariance.diagonal()
    if not np.isfinite(covariance).all():
        return "is not finite"
    if not covariance.any():
        return "is all zeros"
    if variances[least := int(variances.argmin())] <= 0:
        return f"has the variance {variances[least]:.3g} of {names[least]}"
    correlations = covariance / np.sqrt(np.outer(variances, variances))
    apart = np.abs(correlations - np.eye(len(variances)))
    i, j = sorted(divmod(int(apart.argmax()), len(variances)))
    if apart[i, j] > 1 + 1e-5:
        rho = float(correlations[i, j])
        return f"has the correlation {rho:.6g} of {names[i]} and {names[j]}"
    value = float(np.linalg.eigvalsh((correlations + correlations.T) / 2)[0])
    if value > SINGULAR:
        return ""
    kind = "indefinite" if value < -SINGULAR else "singular"
    return f"is {kind}: the least eigenvalue of its correlations is {value:.2g}"


def belief_flaw(belief: interface.Belief) -> str:
    """Name the smallest part of an indefinite covariance that is wrong, "" if none is.

    The parts are the pose, single landmarks, a landmark with the pose, two landmarks,
    and the whole state.

    Examples
    --------
    >>> P = np.eye(5)
    >>> P[0, 3] = P[3, 0] = 1.5
    >>> print(belief_flaw(interface.Belief(np.zeros(5), P, (7,))))
    the covariance of the pose and landmark 7 has the correlation 1.5 of x and x of 7
    """
    P = (belief.covariance + belief.covariance.T) / 2
    variances = P.diagonal()
    if (variances >= 0).all():
        std = np.sqrt(np.where(variances > 0, variances, 1.0))
        if is_semidefinite(P / np.outer(std, std)):
            return ""
    rows: dict[str, list[int]] = {"the pose": [0, 1, 2]}
    for slot, landmark in enumerate(belief.landmark_ids):
        rows[f"landmark {landmark}"] = [3 + 2 * slot, 4 + 2 * slot]
    singles, pairs = [(name,) for name in rows], itertools.combinations(rows, 2)
    for parts in itertools.chain(singles, pairs):
        at = [row for name in parts for row in rows[name]]
        flaw = covariance_flaw(P[np.ix_(at, at)], _names(parts))
        if flaw and not flaw.startswith("is singular"):
            return f"the covariance of {' and '.join(parts)} {flaw}"
    return f"the covariance of the state {covariance_flaw(P, [''] * len(P))}"


def _names(parts: Sequence[str]) -> list[str]:
    own = [
        _POSE_NAMES if part == "the pose" else (f"x of {part[9:]}", f"y of {part[9:]}")
        for part in parts
    ]
    return [name for names in own for name in names]


def first_flaw(settings: FilterSettings, runs: SimulatedRuns, run: int) -> str:
    """Repeat a run; write from which step and where its covariance is indefinite.

    The result is "" if it never is, or if the filter knows the truth.
    """
    slam = settings.make(runs.initial_poses[run])
    trace = FilteredRuns.unknown(runs).trace
    recorder = DecisionRecorder(slam)
    if hasattr(slam, "observe_truth"):
        return ""
    with contextlib.suppress(Exception):  # of a filter that fails after this
        for step in range(runs.visible.shape[1]):
            belief = _step(slam, runs, run, step, trace, recorder)
            if flaw := belief_flaw(belief):
                return f"since step {step}, {flaw}"
    return ""


_MANY = 6  # deviations that a displacement hardly exceeds


def bound_runs(
    scenario: Scenario, runs: SimulatedRuns, *, threads: int | None = None
) -> PosteriorBound:
    """Return the bound along each run's true path, with the noise of the world.

    Where the world hides identities, it is that of a filter which knows them. It is nan
    for sensors of one number, whose first reading of a landmark bounds nothing. The
    covariances are left out: they take as much memory as the filters.
    """
    identified = runs.identified()
    dt = np.tile(runs.dt, (len(runs.odometry), 1))
    if not scenario.motion.noise_at_rest:
        dt *= runs.odometry.any(axis=2)
    return posterior_bound(
        runs.true_poses,
        identified.landmarks_of_rows,
        identified.visible,
        dt,
        motion_std=scenario.motion.std,
        measurement_std=scenario.sensor.std,
        start_std=scenario.start.std,
        pose_std=runs.fix_std,
        sensor=sensor_with_noise(scenario.sensor.kind, scenario),
        origin=scenario.start.pose[:2],
        with_covariances=False,
        threads=threads,
    )


def sensor_with_noise(kind: str, scenario: Scenario) -> Sensor:
    """Return a sensor with the noise per metre of a world."""
    growth = scenario.sensor.range_std_per_metre
    return find_sensor(kind).with_noise(range_std_per_metre=growth)


def noise_of_runs(scenario: Scenario, assumed: Scenario, runs: SimulatedRuns) -> Array:
    """Return sums over the noise of each run, in deviations that `assumed` has.

    Clutter does not count, nor motion at rest where no noise is assumed, nor motion
    that begins near a wall: walls stop the longest displacements. Of the sensors,
    bearing_range alone counts.
    """
    identified = runs.identified()
    motion = find_motion(scenario.models.get("motion", "unicycle"))
    noisy = ~_near_walls(scenario, runs.true_poses)
    if not assumed.motion.noise_at_rest:
        noisy &= runs.odometry.any(axis=2)
    return noise_sums(
        runs.true_poses,
        identified.landmarks_of_rows,
        motion.displacements(runs.odometry),
        identified.measurements,
        identified.visible & (scenario.sensor.kind == "bearing_range"),
        motion_std=assumed.motion.std,
        measurement_std=assumed.sensor.std,
        sensor=sensor_with_noise("bearing_range", assumed),
        noise_in=assumed.motion.noise_in,
        noisy_steps=noisy,
    )


def _near_walls(scenario: Scenario, poses: Array) -> BoolArray:
    """Return the steps, shape (B, T), that begin where a wall may end them."""
    near = np.zeros(poses.shape[:2], dtype=np.bool_)
    if not scenario.walls:
        return near
    ends = np.array(scenario.walls)
    start, end = ends[:, 0] + 1j * ends[:, 1], ends[:, 2] + 1j * ends[:, 3]
    at = poses[:, :-1, 0] + 1j * poses[:, :-1, 1]
    robot, std = scenario.robot, max(scenario.motion.std[:2])
    reach = robot.radius + robot.max_speed * scenario.dt + _MANY * std
    near[:, 1:] = wall_distances(at, start, end - start).min(axis=-1) < reach
    return near
