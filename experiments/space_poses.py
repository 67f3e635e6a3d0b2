"""Judge poses in space, with covariances of six coordinates: `judge_in_space`.

The estimate X̂ and the truth X are in SE(3). An error ξ has a translation and a rotation
vector, and is one of ::

    left        Log(X̂⁻¹ X), in the robot's frame
    right       Log(X X̂⁻¹) = Ad(X̂) Log(X̂⁻¹ X), in the world's frame
    decoupled   (p − p̂, Log(R̂ᵀ R)): position in the world, rotation in the body

The NEES of the left and of the right error are the same if their covariances are [1]_.

References
----------
.. [1] J. Solà, J. Deray, D. Atchuthan, A micro Lie theory for state estimation in
   robotics, arXiv:1812.01537, 2018: the appendix on SE(3).
"""

from __future__ import annotations

import zipfile
from collections.abc import Iterator, Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ..argument_checks import one_of
from ..arrays import Array
from ..evaluation.consistency_report import evaluate_consistency
from ..evaluation.nees import normalised_squared_error
from .estimate_conventions import unit_of
from .estimate_files import (
    content_lines,
    files_in,
    growing_rows,
    name_of,
    near_truth,
    paired,
    paths_by_label,
    square,
    tum_rows,
    tum_table,
)
from .monte_carlo_study import verdict
from .run_and_replay.trace import finite

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Place = str | PathLike[str]

ERRORS = ("left", "right", "decoupled")
ORDERS = ("translation-first", "rotation-first")
_SMALL = 1e-4  # angle of a rotation below which series are exact [rad]
_SYMMETRIC = 1e-6  # relative difference of two entries
_NEAR, _FAR, _ERRORS = 1.5, 2.5, 3.0  # as for poses in the plane, see conventions
_UNIT = 0.1  # largest difference of the length of a quaternion from 1
_RESCALED = 0.1  # logarithm of a scale above which the unit differs
_SMALLER = 4.0  # factor by which the right convention reduces the errors
_SHIFTS = (-2.0, -1.5, -1.0, -0.5, 0.5, 1.0, 1.5, 2.0)  # of time stamps, in steps
_GAIN = 0.25  # of log-likelihood of a pose [nats]
_DEGREES = np.diag([1.0] * 3 + [np.pi / 180] * 3)
_SWAP = np.eye(6)[[3, 4, 5, 0, 1, 2]]


class Pose(NamedTuple):
    """Poses in space, over any leading axes."""

    #: Shape (..., 3) [m].
    positions: Array
    #: Shape (..., 3, 3).
    rotations: Array


#: Times (T,) [s] and true poses. Without times, pose k belongs to estimate k.
_Path = tuple[Array | None, Pose]


class SpaceEstimate(NamedTuple):
    """The poses of one drive with their covariances, as in the file."""

    file: str
    poses: Pose
    #: Shape (T, 6, 6).
    covariances: Array
    #: Shape (T,) [s]; None if pose k is that of row k of the truth.
    times: Array | None = None


# --------------------------------------------------------------------------------------
# SE(3): twists ξ = (ρ, φ) have the translation first.


def hat(vectors: Array) -> Array:
    """Return the cross products v× as matrices, shape (..., 3, 3)."""
    x, y, z = np.moveaxis(vectors, -1, 0)
    zero = np.zeros_like(x)
    rows = zero, -z, y, z, zero, -x, -y, x, zero
    return np.stack(rows, axis=-1).reshape(*x.shape, 3, 3)


def exponential(twists: Array) -> Pose:
    """Return Exp(ξ) for twists (..., 6): the position is V(φ) ρ."""
    turn = twists[..., 3:]
    angle = np.linalg.norm(turn, axis=-1)[..., None, None]
    a = np.where(angle < _SMALL, 1.0, angle)
    first = np.where(angle < _SMALL, 0.5, 2 * np.sin(a / 2) ** 2 / a**2)
    second = np.where(angle < _SMALL, 1 / 6, (a - np.sin(a)) / a**3)
    W = hat(turn)
    V = np.eye(3) + first * W + second * W @ W
    rotations = Rotation.from_rotvec(turn.reshape(-1, 3)).as_matrix()
    position = (V @ twists[..., :3, None])[..., 0]
    return Pose(position, rotations.reshape(*turn.shape, 3))


def logarithm(pose: Pose) -> Array:
    """Return the twist Log(X), shape (..., 6), its rotation of at most π."""
    matrices = pose.rotations.reshape(-1, 3, 3)
    turn = Rotation.from_matrix(matrices).as_rotvec().reshape(pose.positions.shape)
    angle = np.linalg.norm(turn, axis=-1)[..., None, None]
    a = np.where(angle < _SMALL, 1.0, angle)
    factor = np.where(angle < _SMALL, 1 / 12, (1 - a / 2 / np.tan(a / 2)) / a**2)
    W = hat(turn)
    inverse = np.eye(3) - W / 2 + factor * W @ W  # V(φ)⁻¹
    rho = (inverse @ pose.positions[..., None])[..., 0]
    return np.concatenate([rho, turn], axis=-1)


def between(start: Pose, end: Pose) -> Pose:
    """Return X₁⁻¹ X₂."""
    back = np.swapaxes(start.rotations, -1, -2)
    gap = (end.positions - start.positions)[..., None]
    return Pose((back @ gap)[..., 0], back @ end.rotations)


def composed(start: Pose, step: Pose) -> Pose:
    """Return X₁ X₂."""
    moved = (start.rotations @ step.positions[..., None])[..., 0]
    return Pose(start.positions + moved, start.rotations @ step.rotations)


def adjoint(pose: Pose) -> Array:
    """Return Ad(X) = [R, p× R; 0, R], shape (..., 6, 6)."""
    matrix = _diagonal(pose.rotations, pose.rotations)
    matrix[..., :3, 3:] = hat(pose.positions) @ pose.rotations
    return matrix


def _diagonal(first: Array, second: Array) -> Array:
    matrix = np.zeros((*first.shape[:-2], 6, 6))
    matrix[..., :3, :3], matrix[..., 3:, 3:] = first, second
    return matrix


# --------------------------------------------------------------------------------------
# The verdict.


def judge_in_space(
    estimates: Place | Sequence[Place],
    truth: Place | Sequence[Place],
    *,
    covariances: str = "left",
    order: str = "translation-first",
) -> dict[str, Any]:
    """Decide whether covariances of poses in space agree with their errors.

    Parameters
    ----------
    estimates : path or sequence of paths
        Files of estimates, or a folder: TUM with 36 or 21 entries of a covariance, or
        npz with ``belief_poses`` (T, 7), as x y z qx qy qz qw, and
        ``belief_pose_covariances`` (T, 6, 6).
    truth : path or sequence of paths
        True paths with the names of the estimates: TUM, or npz with ``poses`` (T, 7).
        An npz of truth or estimates may hold ``times`` (T,) [s]; without them, pose k
        belongs to pose k of the other.
    covariances : {"left", "right", "decoupled"}
        The error whose covariances the files hold.
    order : {"translation-first", "rotation-first"}
        Of its coordinates.

    Returns
    -------
    dict
        ``verdict``, ``reason`` and ``sentence``; ``nees`` per degree of freedom of
        ``pose``, ``position`` and ``rotation``, and ``nees_over_time``, the same for
        each step, None where undefined; ``cause``, the convention that explains
        the errors, or ""; ``runs``, ``steps``, ``tested_steps``, the number of steps
        that are tested together, and ``left_out``, that of poses without truth.

    Raises
    ------
    ValueError
        If a file is malformed, or no estimate has a truth.
    """
    one_of("covariances", covariances, ERRORS)
    one_of("order", order, ORDERS)
    (true_places,) = paths_by_label(truth).values()
    named = paths_by_label(estimates)
    if len(named) > 1:
        raise ValueError(
            "estimates in space must be those of one estimator, in one folder, got "
            f"{' and '.join(named)}"
        )
    true = dict(pair for path in files_in(true_places) for pair in _true_paths(path))
    read = dict(
        pair
        for paths in named.values()
        for path in files_in(paths)
        for pair in _estimates_in(path)
    )
    found = paired(read, list(true))
    names = [name for name in true if name in found]
    if not names:
        raise ValueError(
            "estimates and truth must share their names, such as run_1.tum in one "
            f"folder each, got {next(iter(read), 'nothing')} and "
            f"{next(iter(true), 'nothing')}"
        )
    drives = [_within(found[name], *true[name]) for name in names]
    for _, estimate, _ in drives:
        if len(estimate.covariances) < 2:
            raise ValueError(f"{estimate.file} must have at least two poses, got one")
    exact, poses, claims, left_out = _stacked(drives)
    readings = dict(_readings(exact, poses, claims, order))
    error, matrices = readings[_name(covariances, order)]
    nees = normalised_squared_error(error, matrices)
    if not np.isfinite(nees).any():
        raise ValueError(
            f"{drives[0][1].file}: every covariance of six coordinates is singular, "
            "so no NEES is defined: write variances > 0 for all six, or judge poses in "
            "the plane without --space"
        )
    ratios = {"pose": nees / 6}
    for name, part in (("position", slice(0, 3)), ("rotation", slice(3, 6))):
        own = matrices[..., part, part]
        ratios[name] = normalised_squared_error(error[..., part], own) / 3
    decided, reason, tested = verdict.NOT_SHOWN, "one drive is too few to decide", 0
    if len(nees) > 1:
        none = np.zeros_like(nees)
        rng = np.random.default_rng(0)
        report = evaluate_consistency(
            nees, none, none, dof=6, frame="invariant", rng=rng
        )
        decided, reason = verdict.verdict_of_report(
            report, len(report.failed_runs), len(nees)
        )[:2]
        tested = len(report.family_steps)
    (label,) = named
    return {
        "estimator": label,
        "verdict": decided,
        "reason": reason,
        "sentence": f"{label}: {decided}: {reason}.",
        "nees": {name: float(np.nanmean(each)) for name, each in ratios.items()},
        "nees_over_time": {
            name: [finite(ratio) for ratio in _means(each)]
            for name, each in ratios.items()
        },
        "cause": ""
        if decided == verdict.CONSISTENT
        else _cause(readings, error, nees) or _nearer(exact, poses),
        "runs": len(nees),
        "steps": nees.shape[1],
        "tested_steps": tested,
        "left_out": left_out,
    }


def _means(ratios: Array) -> Array:
    """Return averages of ratios (M, K) over runs; nan where no run has one."""
    known = np.isfinite(ratios)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.where(known, ratios, 0).sum(axis=0) / known.sum(axis=0))


def nees_in_space_figure(found: Mapping[str, Any], width_mm: float = 85.0) -> Figure:
    """Draw the NEES per degree of freedom over time, from the result of a judgement.

    Parameters
    ----------
    found : mapping
        The result of `judge_in_space`.
    width_mm : float, default 85
        Width of the figure [mm].
    """
    from .figures.style import new_figure  # noqa: PLC0415
    from .monte_carlo_study import figures  # noqa: PLC0415

    axes = new_figure(width_mm / 25.4, 2.9).subplots()
    shown = [figures.draw_bands(axes, found["runs"], 6, found["tested_steps"])]
    for place, (name, means) in enumerate(found["nees_over_time"].items()):
        ratios = np.array(means, dtype=np.float64)  # nan for None
        shown.append(ratios[np.isfinite(ratios)])
        steps = np.arange(len(ratios))
        axes.plot(*figures.thinned(steps, ratios), **figures.look_of(place).line(name))
    figures.scale_ratios(axes, np.concatenate(shown))
    return figures.finished(axes, "ANEES / n", found["estimator"])


def _name(kind: str, order: str) -> str:
    whole = f"covariances of the {kind} error"
    return whole if order == ORDERS[0] else f"{whole}, {order.replace('-', ' ')}"


def _readings(
    truth: Pose, poses: Pose, claims: Array, order: str
) -> Iterator[tuple[str, tuple[Array, Array]]]:
    """Yield the errors and covariances of all conventions by their names."""
    left = logarithm(between(poses, truth))
    apart = np.concatenate([truth.positions - poses.positions, left[..., 3:]], axis=-1)
    Ad = adjoint(poses)
    turned = _diagonal(
        poses.rotations, np.broadcast_to(np.eye(3), Ad[..., :3, :3].shape)
    )
    right = (Ad @ left[..., None])[..., 0]
    errors = {"left": left, "right": right, "decoupled": apart}
    by_left = {"left": np.eye(6), "right": Ad, "decoupled": turned}
    for each in (order, *(other for other in ORDERS if other != order)):
        swap = np.eye(6) if each == ORDERS[0] else _SWAP
        matrices = swap @ claims @ swap.T
        for kind in ERRORS:
            yield _name(kind, each), (errors[kind], matrices)
        if each != order:
            continue
        for kind, target in ((a, b) for a in ERRORS for b in ERRORS if a != b):
            back = by_left[kind] @ np.linalg.inv(by_left[target])  # J⁻¹
            name = f"{_name(kind, each)}, transported to the {target} error by Jᵀ P J"
            yield (
                f"{name} instead of J P Jᵀ",
                (errors[kind], np.swapaxes(back, -1, -2) @ matrices @ back),
            )
        for kind in ERRORS:
            degrees = _DEGREES @ matrices @ _DEGREES
            yield f"{_name(kind, each)}, rotations in degrees", (errors[kind], degrees)


def _cause(
    readings: Mapping[str, tuple[Array, Array]], error: Array, nees: Array
) -> str:
    """Name the reading of the largest likelihood among those that are honest."""
    fits = {name: _fit(*reading) for name, reading in readings.items()}
    before = next(fits[name] for name, it in readings.items() if it[0] is error)
    honest = {name: fit for name, fit in fits.items() if fit[0]}
    if not honest:
        return ""
    best = max(honest, key=lambda name: honest[name][1].mean())
    gains = honest[best][1] - before[1]
    noise = np.nan_to_num(gains.std()) / np.sqrt(len(gains))
    if gains.mean() < max(_GAIN, _ERRORS * noise):
        return ""
    return (
        f"convention: {best}: read so, NEES / 6 is {honest[best][2]:.2f}, not "
        f"{np.nanmean(nees) / 6:.3g}."
    )


def _nearer(truth: Pose, poses: Pose) -> str:
    """Name the convention of the poses that makes their errors far smaller."""
    before = _median_errors(truth, poses)
    read = {name: _median_errors(*pair) for name, *pair in _pose_readings(truth, poses)}
    sizes = {name: np.log(np.maximum(each, 1e-9)).sum() for name, each in read.items()}
    best = min(sizes, key=lambda name: sizes[name])
    if sizes[best] > np.log(np.maximum(before, 1e-9)).sum() - np.log(_SMALLER):
        return ""
    (place, turn), (was_place, was_turn) = read[best], before
    return (
        f"convention: {best}: read so, the median errors are {place:.2g} m and "
        f"{turn:.2g} rad instead of {was_place:.2g} m and {was_turn:.2g} rad."
    )


def _median_errors(truth: Pose, poses: Pose) -> tuple[float, float]:
    """Return the median errors of positions [m] and rotations [rad]."""
    gaps = np.linalg.norm(truth.positions - poses.positions, axis=-1)
    turns = np.linalg.norm(logarithm(between(poses, truth))[..., 3:], axis=-1)
    return float(np.median(gaps)), float(np.median(turns))


def _pose_readings(truth: Pose, poses: Pose) -> Iterator[tuple[str, Pose, Pose]]:
    """Yield truth and estimates, read in other conventions of the poses."""
    origin = Pose(np.zeros(3), np.eye(3))
    inverse = "poses of the world as the robot sees it (inverse)"
    yield inverse, truth, between(poses, origin)
    yield f"{inverse}, in the truth", between(truth, origin), poses
    first = "quaternions that begin with qw"
    yield first, truth, _rolled(poses)
    yield f"{first}, in the truth", _rolled(truth), poses
    spreads = [
        np.square(each.positions - each.positions.mean(axis=1, keepdims=True)).sum()
        for each in (truth, poses)
    ]
    if min(spreads) > 0:
        name, scale = unit_of(float(np.sqrt(spreads[0] / spreads[1])))
        if abs(np.log(scale)) > _RESCALED:  # else an error of the scale
            yield name, truth, poses._replace(positions=poses.positions * scale)
    steps = np.arange(truth.positions.shape[1])
    for shift in _SHIFTS:
        side = "late" if shift > 0 else "early"
        places = np.clip(steps - shift, 0, steps[-1])
        after = np.clip(np.ceil(places).astype(int), 1, None)
        ends = [
            Pose(truth.positions[:, rows], truth.rotations[:, rows])
            for rows in (after - 1, after)
        ]
        then = interpolated(ends[0], ends[1], places - after + 1)
        yield f"time stamps that are {abs(shift):.2g} steps too {side}", then, poses


def _rolled(poses: Pose) -> Pose:
    """Return poses whose quaternions were written as qw qx qy qz."""
    flat = Rotation.from_matrix(poses.rotations.reshape(-1, 3, 3)).as_quat()
    turned = Rotation.from_quat(flat[:, [1, 2, 3, 0]]).as_matrix()
    return poses._replace(rotations=turned.reshape(poses.rotations.shape))


def interpolated(start: Pose, end: Pose, share: Array) -> Pose:
    """Interpolate between poses along their twists, at shares in [0, 1]."""
    return composed(
        start, exponential(share[..., None] * logarithm(between(start, end)))
    )


def _fit(errors: Array, covariances: Array) -> tuple[bool, Array, float]:
    """Return whether errors are honest, log-likelihoods of runs, and NEES / 6."""
    order = [3, 4, 5, 0, 1, 2]  # rotations first: fewer frames change them
    ordered = covariances[..., order, :][..., order]
    try:
        factor = np.linalg.cholesky(ordered[:, 1:])
    except np.linalg.LinAlgError:
        return False, np.full(len(errors), -1e300), np.nan
    white = np.linalg.solve(factor, errors[:, 1:, order, None])[..., 0]
    sizes = np.log(np.diagonal(factor, axis1=-2, axis2=-1)).sum(axis=-1)
    squares = (white**2).mean(axis=1)
    mean = squares.mean(axis=0)
    spread = squares.std(axis=0) / np.sqrt(len(squares)) / mean
    limit = np.minimum(np.log(_NEAR) + _ERRORS * spread, np.log(_FAR))
    likelihood = (-0.5 * (white**2).sum(axis=-1) - sizes).mean(axis=1)
    return bool((abs(np.log(mean)) <= limit).all()), likelihood, float(mean.mean())


# --------------------------------------------------------------------------------------
# The files.


def _poses_of(rows: Array) -> Pose:
    """Return poses from rows x y z qx qy qz qw."""
    return Pose(rows[:, :3], Rotation.from_quat(rows[:, 3:7]).as_matrix())


def _true_paths(path: Path) -> Iterator[tuple[Any, _Path]]:
    """Yield name, times and poses of each drive; an npz may have no times."""
    if path.suffix == ".npz":
        for name, (rows,), times in _npz_drives(path, {"poses": (7,)}):
            yield name, (times, _poses_of(rows))
        return
    lines = content_lines(path)
    rows = np.array([row[:8] for row in tum_rows(lines)])
    kept = growing_rows(rows, [f"{path}, line {line.number}" for line in lines])
    yield name_of(path), (rows[kept, 0], _poses_of(rows[kept, 1:]))


def _estimates_in(path: Path) -> Iterator[tuple[Any, SpaceEstimate]]:
    if path.suffix == ".npz":
        yield from _of_npz(path)
        return
    table, lines = tum_table(path)
    if table.shape[1] not in (29, 44):
        wanted = "36 or 21 entries of a covariance behind the pose"
        raise lines[0].error(wanted, f"{table.shape[1] - 8}")
    kept = growing_rows(table, [f"{path}, line {line.number}" for line in lines])
    table = table[kept]
    matrices = _checked(str(path), square(table[:, 8:], 6))
    poses = _poses_of(table[:, 1:8])
    yield name_of(path), SpaceEstimate(str(path), poses, matrices, table[:, 0])


def _of_npz(path: Path) -> Iterator[tuple[Any, SpaceEstimate]]:
    wanted = {"belief_poses": (7,), "belief_pose_covariances": (6, 6)}
    for name, (rows, claims), times in _npz_drives(path, wanted):
        matrices = _checked(str(path), claims)
        yield name, SpaceEstimate(str(path), _poses_of(rows), matrices, times)


def _npz_drives(
    path: Path, wanted: Mapping[str, tuple[int, ...]]
) -> Iterator[tuple[Any, list[Array], Array | None]]:
    """Yield name, arrays (T, ...) of given shapes, and times, if any, of each drive."""
    names, seeds, times = " and ".join(wanted), None, None
    try:
        with path.open("rb") as stream, np.load(stream) as archive:
            arrays = [np.asarray(archive[name], np.float64) for name in wanted]
            if "seed" in archive.files:
                seeds = np.atleast_1d(archive["seed"]).tolist()
            if "times" in archive.files:
                times = np.asarray(archive["times"], np.float64)
    except (ValueError, KeyError, EOFError, OSError, zipfile.BadZipFile) as error:
        raise ValueError(f"{path} must hold {names}: {error}") from None
    if seeds is None:
        arrays, seeds = [array[None] for array in arrays], [name_of(path)]
        times = None if times is None else times[None]
    _check_npz(path, wanted, arrays, times, len(seeds))
    for k, name in enumerate(seeds):
        own = None if times is None else times[k]
        yield name, [array[k] for array in arrays], own


def _check_npz(
    path: Path,
    wanted: Mapping[str, tuple[int, ...]],
    arrays: Sequence[Array],
    times: Array | None,
    drives: int,
) -> None:
    """Refuse wrong shapes of arrays (E, T, ...), and invalid quaternions or times."""
    names, (count, steps) = " and ".join(wanted), (*arrays[0].shape, 0)[:2]
    due = [(drives, steps, *shape) for shape in wanted.values()]
    if [array.shape for array in arrays] != due:
        sizes = [f"(T, {', '.join(map(str, shape))})" for shape in wanted.values()]
        got = " and ".join(str(array.shape[1:]) for array in arrays)
        raise ValueError(
            f"{path}: {names} must be {' and '.join(sizes)} for each drive, got {got} "
            f"for {drives} seeds"
        )
    lengths = np.linalg.norm(arrays[0][..., 3:], axis=-1)
    if not (abs(lengths - 1) < _UNIT).all():
        raise ValueError(f"{path}: quaternions qx qy qz qw must have the length 1")
    if times is None:
        return
    if times.shape != (count, steps) or not (np.diff(times) > 0).all():
        raise ValueError(f"{path}: times must be (T,) for each drive, and increase")


def _checked(file: str, matrices: Array) -> Array:
    """Return matrices that are symmetric and finite; refuse others."""
    gaps = abs(matrices - np.swapaxes(matrices, -1, -2)).max(axis=(1, 2))
    wrong = ~(gaps <= _SYMMETRIC * abs(matrices).max(axis=(1, 2)))
    if wrong.any():
        row = int(wrong.argmax())
        raise ValueError(
            f"{file}: the covariance of pose {row} must be finite and symmetric; write "
            "36 entries by rows, or the upper triangle"
        )
    return matrices


def _within(
    estimate: SpaceEstimate, due: Array | None, path: Pose
) -> tuple[Pose, SpaceEstimate, int]:
    """Return the truth at the times of estimates, these, and how many have none."""
    if estimate.times is None or due is None:
        count, others = len(estimate.covariances), len(path.positions)
        if count != others:
            what = estimate.file if estimate.times is None else "the truth"
            raise ValueError(
                f"{what} has no times, so {estimate.file} and its truth must have "
                f"the same number of poses, got {count} and {others}"
            )
        return path, estimate, 0
    inside = np.flatnonzero(near_truth(estimate.times, due))
    if len(inside) < 2:
        raise ValueError(
            f"{estimate.file} and its truth must share at least two times, got "
            f"{estimate.times[0]:.10g} to {estimate.times[-1]:.10g} s, and "
            f"{due[0]:.10g} to {due[-1]:.10g} s; write both in seconds of one clock"
        )
    times = estimate.times[inside]
    after = np.clip(np.searchsorted(due, times), 1, len(due) - 1)
    start, end = (_at(path, rows) for rows in (after - 1, after))
    share = (times - due[after - 1]) / (due[after] - due[after - 1])
    poses = _at(estimate.poses, inside)
    kept = estimate._replace(poses=poses, covariances=estimate.covariances[inside])
    return interpolated(start, end, share), kept, len(estimate.times) - len(inside)


def _at(poses: Pose, rows: Any) -> Pose:
    return Pose(poses.positions[rows], poses.rotations[rows])


def _stacked(
    drives: Sequence[tuple[Pose, SpaceEstimate, int]],
) -> tuple[Pose, Pose, Array, int]:
    """Return truth, poses and covariances of all drives at equally many times."""
    count = min(len(estimate.covariances) for _, estimate, _ in drives)
    truths, poses, claims = [], [], []
    for truth, estimate, _ in drives:
        few = np.linspace(0, len(estimate.covariances) - 1, count).round().astype(int)
        truths.append(_at(truth, few))
        poses.append(_at(estimate.poses, few))
        claims.append(estimate.covariances[few])
    exact, found = (
        Pose(*(np.stack(each) for each in zip(*listed, strict=True)))
        for listed in (truths, poses)
    )
    return exact, found, np.stack(claims), sum(left for *_, left in drives)
