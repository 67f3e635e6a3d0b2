"""Measure the errors and the consistency of every run of a Monte Carlo: `measure_runs`.

Some runs are measured at once, but the figures of a run do not depend on the others.
With hidden identities, a run is bad if it fails, or if its path error is more than
`MARGIN` above that of the same filter with known identities on the same readings.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...arrays import AnyArray, Array, BoolArray, IntArray
from ...estimator.interface import Belief
from ...estimator.models.bearing_range import wrap_angle
from ...estimator.models.rigid_motion import ERROR_FRAMES
from ...evaluation import nees
from ...evaluation.association_scores import (
    AssociationScores,
    Gospa,
    oracle_errors,
    places_of,
)
from ...evaluation.error_bound import PosteriorBound, map_error_squared
from ...evaluation.noise_findings import CHANNELS, MOMENTS
from ...evaluation.trajectory_error import aligned_rms, ellipse_areas
from ...sim_configs import Scenario
from ..logs.ground_truth import TrueLandmarks
from ..logs.slamlog import NO_LANDMARK
from ..run_and_replay.filter_settings import FilterSettings
from ..run_and_replay.simulated_runs import SimulatedRuns
from ..run_and_replay.trace import compare_association
from .filtered_runs import (
    Failure,
    FilteredRuns,
    covariance_flaw,
    filter_runs,
    first_flaw,
    sensor_with_noise,
)

Block = dict[str, NDArray[np.generic]]

Value = Any  # an array over runs, or one number for all

STEP, RUN, LANDMARK = ("run", "step"), ("run",), ("run", "landmark")
NOISE = "run", "noise", "moment"
NOISE_SIZES = {"noise": len(CHANNELS), "moment": len(MOMENTS)}


class Variable(NamedTuple):
    """One variable of the results."""

    #: Dimensions other than ``estimator``.
    dims: tuple[str, ...]
    #: numpy kind: f8, i8, ?, or U for text.
    kind: str
    meaning: str


VARIABLES: dict[str, Variable] = {
    "pose_nees_invariant": Variable(STEP, "f8", "NEES of the pose, 3 degrees"),
    "pose_nees_additive": Variable(STEP, "f8", "NEES of the pose, 3 degrees"),
    "position_nees_invariant": Variable(STEP, "f8", "NEES of the position, 2 degrees"),
    "position_nees_additive": Variable(STEP, "f8", "NEES of the position, 2 degrees"),
    "heading_nees": Variable(STEP, "f8", "NEES of the heading, 1 degree, any frame"),
    "nis": Variable(STEP, "f8", "NIS of the scan"),
    "nis_dof": Variable(STEP, "i8", "its degrees of freedom"),
    "readings": Variable(RUN, "i8", "number of readings"),
    "position_error": Variable(STEP, "f8", "distance to the true position [m]"),
    "heading_error": Variable(STEP, "f8", "true minus estimated heading [rad]"),
    "heading_std": Variable(STEP, "f8", "claimed deviation of the heading [rad]"),
    "position_std": Variable(STEP, "f8", "root of the trace of the covariance [m]"),
    "ate": Variable(RUN, "f8", "RMS distance of the path, not aligned [m]"),
    "ate_aligned": Variable(RUN, "f8", "the same after the best rigid motion [m]"),
    "pose_area": Variable(RUN, "f8", "final 3σ ellipse of the position [m²]"),
    "state_nees_invariant": Variable(RUN, "f8", "final NEES of pose and map"),
    "state_nees_additive": Variable(RUN, "f8", "final NEES of pose and map"),
    "state_dof": Variable(RUN, "i8", "its degrees of freedom"),
    "relative_map_nees": Variable(
        RUN, "f8", "final NEES of the map from the robot, infinite if indefinite"
    ),
    "relative_map_dof": Variable(RUN, "i8", "its degrees of freedom"),
    "landmark_deviation_x": Variable(LANDMARK, "f8", "whitened error from the robot"),
    "landmark_deviation_y": Variable(LANDMARK, "f8", "whitened error from the robot"),
    "landmark_rmse": Variable(RUN, "f8", "final RMS map error, not aligned [m]"),
    "landmark_rmse_aligned": Variable(RUN, "f8", "the same after the best motion [m]"),
    "landmark_area": Variable(RUN, "f8", "mean final 3σ ellipse of landmarks [m²]"),
    "landmark_nees_invariant": Variable(LANDMARK, "f8", "final NEES, 2 degrees"),
    "landmark_nees_additive": Variable(LANDMARK, "f8", "final NEES, 2 degrees"),
    "landmark_error": Variable(LANDMARK, "f8", "final distance to the truth [m]"),
    "landmark_mahalanobis": Variable(LANDMARK, "f8", "the same in deviations"),
    "position_error_invariant": Variable(STEP, "f8", "the same, invariant frame [m]"),
    "position_bound": Variable(STEP, "f8", "least mean square of that [m²]"),
    "position_bound_raw": Variable(STEP, "f8", "that of the raw position [m²]"),
    "heading_bound": Variable(STEP, "f8", "least mean square of the heading [rad²]"),
    "map_error_centred": Variable(RUN, "f8", "final RMS about the map's centre [m]"),
    "map_bound": Variable(RUN, "f8", "least mean square of that [m²]"),
    "noise_sums": Variable(NOISE, "f8", "sums over the noise in assumed deviations"),
    "failed": Variable(RUN, "?", "whether the run ended before its time"),
    "failed_at": Variable(RUN, "i8", "at which step, -1 if it did not"),
    "message": Variable(RUN, "U", "why"),
}


#: Errors of the landmarks relative to the robot, in the axes of the map, whitened.
DEVIATIONS = "landmark_deviation_x", "landmark_deviation_y"

COUNTS = AssociationScores._fields

KNOWN_IDS_ATE = "known_ids_ate"

MAPS = ("raw", "aligned")

PREFIX = "association_"

ALARM = "probably_lost"

ORACLE = f"{PREFIX}oracle_errors"

#: Followed by the error frame.
KNOWN_IDS_NEES = "known_ids_nees"

_ASSOCIATION: dict[str, str] = {
    **{f"{PREFIX}{name}": f"{name.replace('_', ' ')}, see docs" for name in COUNTS},
    f"{PREFIX}precision": "share of right ones among readings given to landmarks",
    f"{PREFIX}recall": "share of right ones among readings of landmarks",
    **{
        f"gospa_{which}_{part}": f"GOSPA of the final map, {which}: {part}"
        for which in MAPS
        for part in Gospa._fields
    },
    ORACLE: "share of readings that even the true pose and map would take wrongly",
    ALARM: "1 if the filter reports that it is probably lost, else 0",
    KNOWN_IDS_ATE: "path error of the same filter with known identities, raw [m]",
}

#: Those of a world that hides identities; nan where unknown.
HIDDEN_VARIABLES: dict[str, Variable] = {
    **VARIABLES,
    **{name: Variable(RUN, "f8", meaning) for name, meaning in _ASSOCIATION.items()},
    **{
        f"{KNOWN_IDS_NEES}_{frame}": Variable(STEP, "f8", "NEES with known identities")
        for frame in ERROR_FRAMES
    },
}


#: Of runs that were repeated with less noise to find the cause of an inconsistency; in
#: the results, but in no block, if there are any.
SMALL_NOISE: dict[str, Variable] = {
    **{
        f"small_noise_nees_{frame}": Variable(
            RUN, "f8", "mean NEES of the pose, less noise"
        )
        for frame in ERROR_FRAMES
    },
    "small_noise_heading_nees": Variable(RUN, "f8", "mean NEES of the heading"),
    "small_noise_position_error": Variable(RUN, "f8", "mean distance to the truth [m]"),
    "small_noise_factor": Variable(RUN, "f8", "of all noise, nan if not repeated"),
}
#: The same of runs with more noise than these, but less than in the world.
LARGER = "larger_"
SMALL_NOISE |= {f"{LARGER}{name}": each for name, each in SMALL_NOISE.items()}


def joined(parts: Sequence[Block]) -> Block:
    """Return the measures of all runs of some blocks."""
    if len(parts) == 1:
        return parts[0]
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def variables_of(scenario: Scenario) -> dict[str, Variable]:
    """Return the variables of the results in a world."""
    return VARIABLES if scenario.sensor.identities else HIDDEN_VARIABLES


def measure_runs(
    runs: SimulatedRuns,
    filtered: FilteredRuns,
    bound: PosteriorBound,
    noise: Array,
    *,
    resolution: float = 0.0,
) -> Block:
    """Measure a filter's runs against the truth.

    Parameters
    ----------
    runs : SimulatedRuns
        B runs of T steps among L landmarks.
    filtered : FilteredRuns
        The beliefs of a filter in these runs.
    bound : PosteriorBound
        Of the errors of any filter in these runs.
    noise : ndarray, shape (B, 5, 7)
        Sums of the noise, see :func:`~slamgym.evaluation.noise_sums`.
    resolution : float
        True landmarks nearer to each other count as one place [m], where identities are
        hidden.

    Returns
    -------
    dict
        The `VARIABLES`, or the `HIDDEN_VARIABLES`, shape (B,), (B, T) or (B, L) each;
        nan where undefined.
    """
    block, failures = _empty_block(runs), dict(filtered.failures)
    count, steps, _ = runs.visible.shape
    with np.errstate(all="ignore"):  # a diverged run may overflow
        for piece in _pieces(range(count), 18 * steps):
            some = slice(piece[0], piece[-1] + 1)
            measured = _measure_paths(runs.true_poses[some], filtered, some, bound)
            _write(block, some, measured)
        for name in ("ate", "ate_aligned", "pose_area"):
            block[name][list(failures)] = np.nan
        _measure_maps(block, runs, filtered, failures, resolution)
    block["position_bound"][:], block["heading_bound"][:] = bound[:2]
    block["position_bound_raw"][:], block["map_bound"][:] = bound[2:4]
    block["noise_sums"] = noise
    block["readings"] = runs.visible.sum(axis=(1, 2))
    write_failures(block, failures)
    _explain_gaps(block, filtered)
    return block


#: Numbers that are measured together: their temporaries fit into a processor's cache.
_AT_ONCE = 2**16


def _pieces(rows: Sequence[int], numbers: int) -> Iterator[list[int]]:
    """Cut rows of so many numbers each into pieces of at most `_AT_ONCE` numbers.

    Examples
    --------
    >>> list(_pieces(range(5), 30_000))
    [[0, 1], [2, 3], [4]]
    """
    size = max(1, _AT_ONCE // numbers)
    for begin in range(0, len(rows), size):
        yield list(rows[begin : begin + size])


def _write(
    block: Block, rows: list[int] | slice, measured: Mapping[str, Value]
) -> None:
    for name, values in measured.items():
        block[name][rows] = values


#: A NEES or NIS above counts as none: squares of larger numbers would overflow.
LARGEST_SCORE = 1e100


def gaps_of(block: Block) -> tuple[int, BoolArray]:
    """Return the first step of a block that has a NEES, and the `gaps` after it."""
    nees: AnyArray = block["pose_nees_invariant"]
    first = first_step(np.any(nees < LARGEST_SCORE, axis=0))
    return first, gaps(first, nees, block["nis"], block["nis_dof"])


def first_step(known: BoolArray) -> int:
    """Return the first step, >= 1, at which the NEES of any run is known, (T,)."""
    return 1 + int(known[1:].argmax())


def gaps(first: int, nees: AnyArray, nis: AnyArray, freedom: AnyArray) -> BoolArray:
    """Return the steps without a NEES from the first step on.

    Steps without a NIS, though they have readings, count as well.

    Parameters
    ----------
    first : int
        First step that has a NEES.
    nees, nis, freedom : ndarray, shape (B, T)
        NEES of the pose, NIS and its degrees of freedom.

    Returns
    -------
    ndarray of bool, shape (B, T)
    """
    without = ~(nees < LARGEST_SCORE)
    without[:, :first] = False
    return np.asarray(without | (~(nis < LARGEST_SCORE) & (freedom > 0)))


def _explain_gaps(block: Block, filtered: FilteredRuns) -> None:
    """Write a message for runs that did not fail, but have steps without a NEES."""
    _, without = gaps_of(block)
    messages = list(block["message"])
    for run in np.flatnonzero(without.any(axis=1) & ~block["failed"].astype(bool)):
        step = int(without[run].argmax())
        nees_of_step = float(block["pose_nees_invariant"][run, step])
        flaw = covariance_flaw(filtered.trace.pose_covariances[run, step])
        if flaw and not nees_of_step < LARGEST_SCORE:
            messages[run] = f"the covariance of the pose {flaw}"
        elif not nees_of_step < LARGEST_SCORE:
            messages[run] = f"its NEES is {nees_of_step:.3g}"
        else:
            messages[run] = f"its NIS is {block['nis'][run, step]:.3g}"
    block["message"] = np.array(messages)


def explain_first_gap(
    block: Block, settings: FilterSettings, runs: SimulatedRuns
) -> None:
    """Add to the message of the first such run since when its covariance is wrong."""
    messages = list(block["message"])
    explained = np.array([bool(message) for message in messages])
    for run in np.flatnonzero(explained & ~block["failed"].astype(bool))[:1].tolist():
        flaw = first_flaw(settings, runs, run)
        if flaw and messages[run] not in flaw:
            messages[run] = f"{messages[run]}; {flaw}"
    block["message"] = np.array(messages)


def _measure_maps(
    block: Block,
    runs: SimulatedRuns,
    filtered: FilteredRuns,
    failures: dict[int, Failure],
    resolution: float,
) -> None:
    """Measure the final maps, those of one size together.

    A malformed belief of a user's estimator is a failure of its run.
    """
    pieces = [
        some
        for size, alike in _by_size(filtered.beliefs).items()
        for some in _pieces(
            alike, (3 + 2 * size) ** 2 if runs.true_ids is None else _AT_ONCE
        )
    ]
    while pieces:
        some = pieces.pop(0)
        try:
            _write(block, some, _measured_maps(runs, filtered, some, resolution))
        except Exception as error:
            if len(some) > 1:
                pieces[:0] = ([run] for run in some)
                continue
            message = f"the final belief is no map of this world: {error}"
            failures[some[0]] = Failure(runs.visible.shape[1] - 1, message)


def _by_size(beliefs: Sequence[Belief | None]) -> dict[int, list[int]]:
    """Return which runs have a map, by its number of landmarks."""
    sizes: dict[int, list[int]] = {}
    for run, belief in enumerate(beliefs):
        if belief is not None:
            sizes.setdefault(len(belief.landmark_ids), []).append(run)
    return sizes


def _measured_maps(
    runs: SimulatedRuns, filtered: FilteredRuns, some: list[int], resolution: float
) -> Mapping[str, Value]:
    """Measure the final maps of some runs; of one run where identities are hidden."""
    beliefs = [belief for run in some if (belief := filtered.beliefs[run]) is not None]
    truth = runs.true_poses[some, -1], runs.landmarks[some]
    if runs.true_ids is None:
        return _measure_map(*truth, beliefs)
    made = filtered.decisions.get(some[0])
    named = identified(beliefs[0], {} if made is None else made.identities())
    scores = measure_association(runs, filtered, some[0], resolution)
    return {**_measure_map(*truth, [named]), **scores}


def write_failures(block: Block, failures: Mapping[int, Failure]) -> None:
    """Note in a block which runs failed, when and why."""
    messages = [""] * len(block["failed"])
    for run, failure in failures.items():
        block["failed"][run] = True
        block["failed_at"][run] = failure.step
        messages[run] = failure.message
    block["message"] = np.array(messages)


def _empty_block(runs: SimulatedRuns) -> Block:
    shape = (*runs.visible.shape[:2], runs.landmarks.shape[1])
    sizes = dict(zip(("run", "step", "landmark"), shape, strict=True)) | NOISE_SIZES
    variables = VARIABLES if runs.true_ids is None else HIDDEN_VARIABLES
    blanks = {"f8": np.nan, "i8": 0, "?": False, "U": ""}
    return {
        name: np.full([sizes[dim] for dim in dims], blanks[kind], dtype=kind)
        for name, (dims, kind, _) in variables.items()
    }


def _measure_paths(
    truth: Array, filtered: FilteredRuns, some: slice, bound: PosteriorBound
) -> dict[str, Value]:
    """Measure the paths of some runs, whose true poses are given."""
    trace, origin = filtered.trace, np.array(bound.origin)
    poses, covariances = trace.poses[some], trace.pose_covariances[some]
    x, y, _ = np.moveaxis(poses, -1, 0)
    ex, ey, turn = np.moveaxis(truth - poses, -1, 0).copy()
    P = np.moveaxis(covariances, (-2, -1), (0, 1)).copy()
    turn = wrap_angle(turn)
    half = turn / 2
    along = np.where(half == 0, 1.0, half / np.tan(half))
    # `invariant_error` about the estimated position, by one tangent: both errors have
    # the same covariance there. Then about the origin, see `seen_from`.
    xi = along * ex + half * ey, along * ey - half * ex, turn
    about = xi[0] + turn * (y - origin[1]), xi[1] - turn * (x - origin[0])
    raw = np.sqrt(ex * ex + ey * ey)
    measured: dict[str, Value] = {
        "heading_nees": turn * turn / P[2, 2],
        "nis": trace.nis[some],
        "nis_dof": trace.degrees_of_freedom[some],
        "position_error": raw,
        "position_error_invariant": np.sqrt(about[0] ** 2 + about[1] ** 2),
        "heading_error": turn,
        "heading_std": np.sqrt(P[2, 2]),
        "position_std": np.sqrt(P[0, 0] + P[1, 1]),
        "failed_at": -1,
        "ate": _rms(raw),
        "ate_aligned": aligned_rms(
            np.moveaxis(truth[..., :2], -1, 0), np.stack([-ex, -ey])
        ),
        "pose_area": ellipse_areas(covariances[:, -1, :2, :2]),
    }
    found = nees.nees_of_poses(P, (ex, ey, turn), xi)
    for frame, (position, pose) in zip(ERROR_FRAMES, found, strict=True):
        measured[f"position_nees_{frame}"] = position
        measured[f"pose_nees_{frame}"] = pose
    return measured


def _rms(distances: Array) -> Array:
    return np.asarray(np.sqrt(np.mean(distances**2, axis=-1)))


def _measure_map(
    true_poses: Array, truth: Array, beliefs: list[Belief]
) -> dict[str, Value]:
    """Measure the final maps of B runs, with n landmarks each."""
    ids = np.array([belief.landmark_ids for belief in beliefs], dtype=np.int64)
    count, size = truth.shape[1], 2 * ids.shape[1]
    wrong = (ids < 0) | (ids >= count)
    wrong[:, 1:] |= np.diff(np.sort(ids, axis=1)) == 0
    if wrong.any():
        raise ValueError(
            f"landmark_ids must be distinct and from 0 to {count - 1}, "
            f"got {beliefs[int(wrong.any(axis=1).argmax())].landmark_ids}"
        )
    true_landmarks = np.take_along_axis(truth, ids[..., None], axis=1)
    states = (
        np.hstack([true_poses, true_landmarks.reshape(len(ids), size)]),
        np.stack([belief.mean for belief in beliefs]),
        np.stack([belief.covariance for belief in beliefs]),
    )
    measured: dict[str, Value] = {"state_dof": 3 + size, "relative_map_dof": size}
    seen = nees.relative_state(*states)
    squares = nees.whitened(seen.errors, seen.covariance) ** 2
    deviations = nees.whitened(seen.landmarks, seen.landmark_covariances)
    for k, frame in enumerate(ERROR_FRAMES, start=1):
        values = (deviations[k] ** 2).sum(axis=-1)
        measured[f"landmark_nees_{frame}"] = by_id(values, ids, count)
        found = squares[k].sum(axis=-1)
        for row in np.flatnonzero(np.isnan(found)).tolist():  # far from its map
            some = (part[[row]] for part in states)
            found[row] = nees.state_nees(*some, frame=frame)[0]
        measured[f"state_nees_{frame}"] = found
    if not size:
        return measured
    measured |= deviations_by_id(deviations[0], ids, count)
    relative = squares[0, :, :size].sum(axis=-1)
    for row in np.flatnonzero(np.isnan(relative)).tolist():
        if nees.is_indefinite(states[2][row]):
            relative[row] = math.inf
    landmarks = states[1][:, 3:].reshape(-1, size // 2, 2)
    return measured | {
        "relative_map_nees": relative,
        **measure_landmarks(truth, ids, landmarks, seen.landmark_covariances[1]),
        "map_error_centred": np.sqrt(map_error_squared(seen.landmarks[2])),
        "landmark_mahalanobis": np.sqrt(measured["landmark_nees_additive"]),
    }


def measure_landmarks(
    true_landmarks: Array, ids: IntArray, landmarks: Array, covariances: Array
) -> dict[str, Value]:
    """Measure what final maps are worth without their correlations.

    Parameters
    ----------
    true_landmarks : ndarray, shape (B, L, 2)
        All of them [m].
    ids : ndarray of int, shape (B, n)
        Which of them are in each map, n > 0 different ones.
    landmarks : ndarray, shape (B, n, 2)
        Their estimated positions [m].
    covariances : ndarray, shape (B, n, 2, 2)
        Of these [m²].
    """
    count, truth = (
        true_landmarks.shape[1],
        np.take_along_axis(true_landmarks, ids[..., None], axis=1),
    )
    g, error = np.moveaxis(truth, -1, 0), np.moveaxis(landmarks - truth, -1, 0)
    raw = np.sqrt(error[0] ** 2 + error[1] ** 2)
    return {
        "landmark_rmse": _rms(raw),
        "landmark_rmse_aligned": aligned_rms(g, error),
        "landmark_area": ellipse_areas(covariances).mean(axis=-1),
        "landmark_error": by_id(raw, ids, count),
    }


def deviations_by_id(deviations: Array, ids: IntArray, count: int) -> dict[str, Array]:
    """Return whitened errors (B, n, 2) for all landmarks, infinite where undefined."""
    known = np.where(np.isnan(deviations), np.inf, deviations)
    return {
        name: by_id(known[..., axis], ids, count)
        for axis, name in enumerate(DEVIATIONS)
    }


def by_id(values: Array, ids: IntArray, count: int) -> Array:
    """Return values (B, n) for all landmarks, nan for those that are not in the map."""
    rows = np.full((len(ids), count), np.nan)
    np.put_along_axis(rows, ids, values, axis=1)
    return rows


#: Path error above that with known identities [m].
MARGIN = 1.0

SHARES = ("precision", "recall")


def measure_association(
    runs: SimulatedRuns, filtered: FilteredRuns, run: int, resolution: float
) -> Mapping[str, NDArray[np.generic] | float]:
    """Measure one run; empty if its filter reports no decisions, or failed.

    Parameters
    ----------
    runs : SimulatedRuns
        The runs.
    filtered : FilteredRuns
        The beliefs of a filter in them.
    run : int
        Index of the run.
    resolution : float
        True landmarks nearer to each other count as one place [m].
    """
    made, belief = filtered.decisions.get(run), filtered.beliefs[run]
    if made is None or belief is None:
        return {}
    truth = TrueLandmarks(np.arange(runs.landmarks.shape[1]), runs.landmarks[run])
    names = made.identities()
    paired = truth.of([names.get(i, NO_LANDMARK) for i in belief.landmark_ids])
    found = compare_association(
        made, truth, belief.landmarks, paired, resolution=resolution
    )
    scores = {} if found.scores is None else found.scores.as_dict()
    alarm = {} if made.probably_lost is None else {ALARM: float(made.probably_lost)}
    parts = {"raw": found.raw, "aligned": found.aligned}
    return {
        **alarm,
        **{f"{PREFIX}{name}": float(value) for name, value in scores.items()},
        **{
            f"gospa_{which}_{part}": float(value)
            for which, whole in parts.items()
            for part, value in whole._asdict().items()
        },
    }


def oracle_of_runs(scenario: Scenario, runs: SimulatedRuns, resolution: float) -> Array:
    """Return the share of readings that true pose and map assign wrongly, shape (B,).

    The noise is that of the world, see :func:`~slamgym.evaluation.oracle_errors`; nan
    where identities are known.
    """
    shares = np.full(len(runs.visible), np.nan)
    if runs.true_ids is None:
        return shares
    sensor = sensor_with_noise(scenario.sensor.kind, scenario)
    for run, landmarks in enumerate(runs.landmarks):
        rows = runs.visible[run]
        true_ids, z = (
            [part[seen] for part, seen in zip(whole[run], rows, strict=True)]
            for whole in (runs.true_ids, runs.measurements)
        )
        ids = np.arange(len(landmarks))
        shares[run] = oracle_errors(
            runs.true_poses[run],
            z,
            true_ids,
            ids,
            landmarks,
            scenario.sensor.std,
            sensor=sensor,
            places=places_of(ids, landmarks, resolution),
        )
    return shares


def identified(belief: Belief, identities: Mapping[int, int]) -> Belief:
    """Return a belief about true landmarks by their identity.

    Of several mapped landmarks that show one true landmark, the first counts; those
    of none are left out.
    """
    chosen: dict[int, int] = {}
    for landmark in belief.landmark_ids:
        chosen.setdefault(identities.get(landmark, -1), landmark)
    chosen.pop(-1, None)
    slots = {landmark: slot for slot, landmark in enumerate(belief.landmark_ids)}
    part = Belief.marginal(
        belief.mean, belief.covariance, slots, list(chosen.values()), belief.frame
    )
    return replace(part, landmark_ids=tuple(chosen))


def with_known_ids(
    settings: FilterSettings, runs: SimulatedRuns, threads: int | None
) -> dict[str, Array]:
    """Return the scores of the same filter with known identities.

    It has no landmark management.

    Returns
    -------
    dict
        Path errors (B,) [m], and the NEES of the pose (B, T) in both frames; nan in
        runs that fail.
    """
    trace = filter_runs(settings.unmanaged(), runs.identified(), threads=threads).trace
    gaps = trace.poses[:, :, :2] - runs.true_poses[:, :, :2]
    errors = np.sqrt((gaps**2).sum(axis=2).mean(axis=1))
    posed = runs.true_poses, trace.poses, trace.pose_covariances
    with np.errstate(all="ignore"):  # a diverged run may overflow
        scores = {
            f"{KNOWN_IDS_NEES}_{frame}": nees.pose_nees(*posed, frame=frame)
            for frame in ERROR_FRAMES
        }
    return {KNOWN_IDS_ATE: errors, **scores}
