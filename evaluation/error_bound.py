"""Lower bound of the errors of any filter: the posterior Cramér-Rao bound.

The bound of Tichavský, Muravchik and Nehorai [1]_ is the covariance of a Kalman filter
that is linearised at the truth. An EKF that gets the true motion and exact readings is
such a filter, because its estimate is the truth. Many runs are filtered at once. The
bound is about the errors in the invariant frame. With p the position, l each landmark
and J = [0 −1; 1 0], these are to first order ::

    ξ_p = e_p − J p e_θ,    ξ_θ = e_θ,    ξ_l = e_l − J l e_θ

References
----------
.. [1] P. Tichavský, C. Muravchik, A. Nehorai, Posterior Cramér-Rao bounds for
   discrete-time nonlinear filtering, IEEE Trans. Signal Processing 46(5), 1998.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import stdtrit

from .. import argument_checks
from ..arrays import SMALLEST, Array, BoolArray, IntArray
from ..estimator.filters.batch import BatchSlam
from ..estimator.filters.ekf import EkfSlam
from ..estimator.models.rigid_motion import invariant_covariance, seen_from
from ..estimator.models.sensors import BEARING_RANGE, POSITION, Sensor, find_sensor


class PosteriorBound(NamedTuple):
    """Least mean squared errors of B runs, given their true paths; invariant frame."""

    #: Of the position after each scan, shape (B, T) [m²].
    position: Array
    #: Of the heading after each scan, shape (B, T) [rad²].
    heading: Array
    #: Of the position in the additive frame, to first order, shape (B, T) [m²].
    raw_position: Array
    #: At the end: of a landmark about the centre of the map, shape (B,) [m²].
    map: Array
    #: Of (x, y, θ, l1x, …) at the end of each run, shape (3 + 2n, 3 + 2n) for the n
    #: landmarks that it read, in the order of their rows.
    covariances: tuple[Array, ...] = ()
    #: Origin of the invariant frame (x, y) [m].
    origin: tuple[float, float] = (0.0, 0.0)


class Efficiency(NamedTuple):
    """Bound divided by mean squared error, 1 for an estimate that cannot be better."""

    value: float
    #: 95 %, by the scatter of the runs.
    interval: tuple[float, float]


def posterior_bound(
    true_poses: ArrayLike,
    landmarks: ArrayLike,
    visible: ArrayLike,
    dt: ArrayLike,
    *,
    motion_std: ArrayLike,
    measurement_std: ArrayLike,
    start_std: ArrayLike,
    pose_std: ArrayLike = (np.inf, np.inf, np.inf),
    sensor: str | Sensor = "bearing_range",
    origin: tuple[float, float] = (0.0, 0.0),
    threads: int | None = None,
) -> PosteriorBound:
    """Return the bound of many runs, each along its own true path.

    Parameters
    ----------
    true_poses : array_like, shape (B, T, 3)
        At each scan [m, m, rad].
    landmarks : array_like, shape (B, L, 2)
        True positions [m].
    visible : array_like of bool, shape (B, T, L)
        Which landmarks each scan reads; the others take no part.
    dt : array_like, shape (T,) or (B, T)
        Duration that the motion noise before each scan counts.
    motion_std, start_std : array_like, shape (3,)
        Of the motion noise in the robot's frame per step, and of the first pose.
    measurement_std : array_like, shape (2,)
        (σβ, σr) [rad, m].
    pose_std : array_like, shape (3,), (T, 3) or (B, T, 3)
        Of readings of (x, y, θ) after each scan [m, m, rad]; infinite where there is
        none.
    sensor : str or Sensor
        ``"bearing_range"``, or ``"position"`` with `measurement_std` (σx, σy) [m].  The
        bound of other sensors is nan: their first reading of a landmark is no bound.
    origin : (float, float)
        Origin of the invariant frame [m].  It must lie near the path: about a distant
        one, the heading error dominates, and the other errors lose their digits.
    threads : int, optional
        By default, the number of cores.

    Raises
    ------
    ValueError
        If shapes do not fit or a deviation is refused.
    """
    poses = argument_checks.as_floats("true_poses", true_poses)
    places = argument_checks.as_floats("landmarks", landmarks)
    seen = np.ascontiguousarray(visible, dtype=np.bool_)
    if seen.ndim != 3:
        raise ValueError(f"visible must have shape (B, T, L), got {seen.shape}")
    count, steps, points = seen.shape
    for name, array, shape in (
        ("true_poses", poses, (count, steps, 3)),
        ("landmarks", places, (count, points, 2)),
    ):
        if array.shape != shape:
            raise ValueError(f"{name} must have shape {shape}, got {array.shape}")
    about = argument_checks.finite_vector("origin", origin, 2)
    poses, places = seen_from(about, poses), places - about
    check = argument_checks.standard_deviations
    start, read = check("start_std", start_std, 3), find_sensor(sensor)
    stds = (
        check("motion_std", motion_std, 3),
        check("measurement_std", measurement_std, 2),
    )
    position, heading, raw = (np.full((count, steps), np.nan) for _ in range(3))
    spread, covariances = np.full(count, np.nan), list[Array]()
    slam = EkfSlam(*stds, sensor=read, min_range=SMALLEST)
    durations = np.broadcast_to(np.asarray(dt, dtype=np.float64), (count, steps))
    fixes = np.broadcast_to(np.asarray(pose_std, dtype=np.float64), poses.shape)
    for some in _pieces(seen) if read in (BEARING_RANGE, POSITION) else ():
        part = _Drives(
            poses[some], places[some], seen[some], durations[some], fixes[some]
        )
        P, whole, known = _filtered(part, slam, start, threads)
        x, y = poses[some, :, 0], poses[some, :, 1]
        lever = (
            2 * (y * P[..., 0, 2] - x * P[..., 1, 2]) + (x * x + y * y) * P[..., 2, 2]
        )
        raw[some], heading[some] = P[..., 0, 0] + P[..., 1, 1], P[..., 2, 2]
        position[some] = raw[some] + lever
        spread[some] = _about_centre(whole, known)
        sizes = (3 + 2 * known).tolist()
        covariances += [each[:n, :n] for each, n in zip(whole, sizes, strict=True)]
    return PosteriorBound(position, heading, raw, spread, tuple(covariances), origin)


def efficiency(bound: Array, squared_error: Array) -> Efficiency:
    """Divide the bound of M runs by the mean squared error.

    Parameters
    ----------
    bound, squared_error : ndarray, shape (M,) or (M, K)
        Of each run, averaged over its steps where there are several.

    Examples
    --------
    >>> found = efficiency(np.ones(4), np.array([0.5, 1.5, 1.0, 1.0]))
    >>> found.value, [round(end, 2) for end in found.interval]
    (1.0, [0.35, 1.65])
    """
    if not len(squared_error):
        return Efficiency(np.nan, (np.nan, np.nan))
    least, found = (
        np.asarray(array).reshape(len(array), -1).mean(axis=1)
        for array in (bound, squared_error)
    )
    if not found.mean() > 0:
        return Efficiency(np.nan, (np.nan, np.nan))
    value = float(least.mean() / found.mean())
    residual = (least - value * found) / found.mean()
    runs = len(residual)
    if runs < 2:
        return Efficiency(value, (np.nan, np.nan))
    reach = float(stdtrit(runs - 1, 0.975) * residual.std(ddof=1)) / runs**0.5
    return Efficiency(value, (value - reach, value + reach))


def map_error_squared(error: Array) -> Array:
    """Return the square of invariant errors (..., 3 + 2n) that the bound is about.

    Returns
    -------
    ndarray, shape (...)
        Mean over the n > 0 landmarks about the centre of the map [m²].
    """
    points = error[..., 3:].reshape(*error.shape[:-1], -1, 2)
    apart = points - points.mean(axis=-2, keepdims=True)
    return np.asarray((apart**2).sum(axis=-1).mean(axis=-1))


class _Drives(NamedTuple):
    """What B runs of T scans do and read, without noise."""

    poses: Array  # (B, T, 3)
    places: Array  # (B, L, 2) of landmarks
    visible: BoolArray  # (B, T, L)
    dt: Array  # (B, T)
    pose_std: Array  # (B, T, 3), of readings of the poses, infinite where there is none


_MOST_BYTES = 2**22  # of the covariances of the runs that are filtered at once


def _pieces(visible: BoolArray) -> Iterator[slice]:
    """Cut runs into pieces that fit into memory."""
    most = int(visible.any(axis=1).sum(axis=1).max(initial=0))
    size = max(argument_checks.usable_cores(), _MOST_BYTES // (8 * (3 + 2 * most) ** 2))
    for begin in range(0, len(visible), size):
        yield slice(begin, begin + size)


def _filtered(
    drives: _Drives, slam: EkfSlam, start_std: Array, threads: int | None
) -> tuple[Array, Array, IntArray]:
    """Filter runs at the truth.

    Returns
    -------
    pose_covariances : ndarray, shape (B, T, 3, 3)
        In the additive frame.
    covariances : ndarray, shape (B, 3 + 2n, 3 + 2n)
        At the end, in the invariant frame.
    known : ndarray of int, shape (B,)
        The number of landmarks that each run reads, n at most.
    """
    is_read = drives.visible.any(axis=1)
    known = is_read.sum(axis=1)
    rows = np.argsort(~is_read, axis=1, kind="stable")[:, : known.max(initial=0)]
    if not is_read.all():
        drives = drives._replace(
            places=np.take_along_axis(drives.places, rows[..., None], axis=1),
            visible=np.take_along_axis(drives.visible, rows[:, None], axis=2),
        )
    batch = BatchSlam(
        slam,
        *rows.shape,
        initial_poses=drives.poses[:, 0],
        initial_pose_std=start_std,
        threads=threads,
    )
    pose_covariances = _pose_covariances(batch, drives, slam.sensor)
    beliefs = batch.beliefs()
    whole = invariant_covariance(beliefs.means, beliefs.covariances)
    whole[batch.failed_at >= 0] = np.nan
    return pose_covariances, whole, known


def _pose_covariances(batch: BatchSlam, drives: _Drives, sensor: Sensor) -> Array:
    """Take a batch through exact drives, in pieces that end where poses are read."""
    poses, _, visible, dt, pose_std = drives
    moved, z = _displacements(poses), _readings(drives, sensor)
    dt = np.array(dt)
    dt[:, :1] = 0.0
    P, begin = np.empty((*dt.shape, 3, 3)), 0
    due = np.flatnonzero(np.isfinite(pose_std).any(axis=(0, 2)))
    for end in sorted({*(due + 1).tolist(), P.shape[1]}):
        part = np.s_[:, begin:end]
        P[part] = batch.run(
            moved[part], z[part], visible[part], dt[part]
        ).pose_covariances
        last, begin = end - 1, end
        stds, going = pose_std[:, last], batch.failed_at < 0
        for std in np.unique(stds[going], axis=0):
            if (here := np.isfinite(std)).any():
                runs, R = going & (stds == std).all(axis=1), np.diag(std[here] ** 2)
                batch.observe_pose(poses[:, last, here], np.eye(3)[here], R, runs=runs)
                P[runs, last] = batch.storage().covariances[runs, :3, :3]
    return P


def _displacements(poses: Array) -> Array:
    """Return the motion before each pose in the frame of the robot, (B, T, 3)."""
    step, heading = np.diff(poses, axis=1, prepend=poses[:, :1]), poses[:, :-1, 2]
    dx, dy = step[:, 1:, 0], step[:, 1:, 1]
    cos, sin = np.cos(heading), np.sin(heading)
    step[:, 1:, 0], step[:, 1:, 1] = cos * dx + sin * dy, cos * dy - sin * dx
    return step


def _readings(drives: _Drives, sensor: Sensor) -> Array:
    """Return the exact readings, shape (B, T, L, 2), zeros where not visible."""
    visible, (x, y, heading) = drives.visible, drives.poses.reshape(-1, 3).T
    at = np.flatnonzero(visible)  # a third of the time of three numbers for each
    scan, row = np.divmod(at, visible.shape[2])
    landmark = scan // visible.shape[1] * visible.shape[2] + row
    lx, ly = drives.places.reshape(-1, 2).T
    dx, dy = lx[landmark] - x[scan], ly[landmark] - y[scan]
    cos, sin = np.cos(heading)[scan], np.sin(heading)[scan]
    z = np.zeros((visible.size, 2))
    z[at] = sensor.read(cos * dx + sin * dy, cos * dy - sin * dx)
    return z.reshape(*visible.shape, 2)


def _about_centre(covariances: Array, known: IntArray) -> Array:
    """Return the mean variance of the landmarks about their centre, shape (B,).

    Runs with equally many landmarks are computed together: a sum of more numbers, even
    zeros, has other last bits.
    """
    found = np.where(known > 0, 0.0, np.nan)
    for n in np.unique(known[known > 0]).tolist():
        runs = np.flatnonzero(known == n)
        for axis in (3, 4):
            block = covariances[runs, axis : 3 + 2 * n : 2, axis : 3 + 2 * n : 2]
            own = np.ascontiguousarray(block.diagonal(axis1=1, axis2=2))
            found[runs] += own.mean(axis=1) - block.reshape(len(runs), -1).mean(axis=1)
    return found
