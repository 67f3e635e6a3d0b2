"""Lower bound of the errors of any filter: the posterior Cramér-Rao bound.

The bound of Tichavský, Muravchik and Nehorai [1]_ is the recursion of a Kalman filter
that is linearised at the truth. It is computed in the invariant error frame. In this
frame, the Jacobian of the motion is the identity, and those of the readings depend on
relative positions only. In the additive frame, such a filter would observe its heading.
With p the position, l each landmark, J = [0 −1; 1 0] and G = ∂(β, r)/∂(l − p)::

    motion     ξ_p += R(θ) ε_xy − J p' ε_α,    ξ_θ += ε_α,    ξ_l −= J l ε_α
    reading    G (ξ_l − ξ_p) + noise
    first one  ξ_l = ξ_p + G⁻¹ noise

References
----------
.. [1] P. Tichavský, C. Muravchik, A. Nehorai, Posterior Cramér-Rao bounds for
   discrete-time nonlinear filtering, IEEE Trans. Signal Processing 46(5), 1998.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import stdtrit

from ..arrays import Array, BoolArray, IntArray
from ..estimator.guards import argument_checks
from ..estimator.models.bearing_range import reading_slopes_jit
from ..estimator.models.rigid_motion import seen_from
from ..estimator.models.sensors import BEARING_RANGE, POSITION, Sensor, find_sensor
from ..jit import jit, njit_allocating, njit_internal


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
    stds = check("measurement_std", measurement_std, 2)
    read = find_sensor(sensor)
    noise = np.array([*read.noise(stds), float(read == POSITION)])
    motion = check("motion_std", motion_std, 3) ** 2
    start = check("start_std", start_std, 3)
    durations = np.broadcast_to(np.asarray(dt, dtype=np.float64), (count, steps)).copy()
    fixes = np.broadcast_to(np.square(pose_std), (count, steps, 3)).astype(np.float64)
    position, heading, raw = (np.full((count, steps), np.nan) for _ in range(3))
    if read not in (BEARING_RANGE, POSITION):
        unknown = np.full(count, np.nan)
        return PosteriorBound(position, heading, raw, unknown, origin=origin)
    starts = _invariant_start(poses[:, :1], start)
    runs = zip(poses, places, seen, durations, fixes, strict=True)
    rows = zip(position, heading, raw, strict=True)
    covariances = tuple(
        _of_one_run(run, (motion, noise), start, out)
        for run, start, out in zip(runs, starts, rows, strict=True)
    )
    spread = np.array([_about_centre(covariance) for covariance in covariances])
    return PosteriorBound(position, heading, raw, spread, covariances, origin)


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
    if len(found) < 2:
        return Efficiency(value, (np.nan, np.nan))
    residual = (least - value * found) / found.mean()
    reach = float(stdtrit(len(found) - 1, 0.975) * residual.std(ddof=1))
    reach = reach / len(found) ** 0.5
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


def _invariant_start(first: Array, std: Array) -> Array:
    """Return D P Dᵀ of the first poses, shape (B, 3, 3)."""
    lever = np.zeros((len(first), 3, 3))
    lever[:] = np.eye(3)
    lever[:, 0, 2], lever[:, 1, 2] = first[:, 0, 1], -first[:, 0, 0]
    return np.asarray(lever * std**2 @ lever.mT)


_Run = tuple[Array, Array, BoolArray, Array, Array]  # path, map, visible, dt, fixes
_Bounds = tuple[Array, Array, Array]  # rows of a `PosteriorBound`


def _of_one_run(
    run: _Run, noise: tuple[Array, Array], start: Array, out: _Bounds
) -> Array:
    """Fill in the bounds of a run, and return the covariance at its end.

    Landmarks enter in the order in which they are read, so that those still unread
    cost nothing.
    """
    poses, landmarks, visible, dt, fixes = run
    rows = np.flatnonzero(visible.any(axis=0))
    rows = rows[np.argsort(visible[:, rows].argmax(axis=0), kind="stable")]
    P = np.zeros((3 + 2 * len(rows), 3 + 2 * len(rows)))
    P[:3, :3] = start
    most = int(visible.sum(axis=1).max(initial=0))  # readings of a scan
    by_row = np.argsort(rows)  # the order within a scan
    run = poses, landmarks[rows], visible[:, rows], dt, fixes
    _follow(run, by_row, noise, np.empty((2, 2 * most, len(P))), P, out)
    at = 3 + 2 * by_row
    columns = np.concatenate([np.arange(3), np.stack([at, at + 1], axis=1).ravel()])
    return np.asarray(P[np.ix_(columns, columns)])


def _about_centre(covariance: Array) -> float:
    """Return the mean variance of the landmarks about their centre."""
    count = len(covariance) // 2 - 1
    if not count:
        return float("nan")
    total = 0.0
    for axis in (3, 4):
        block = covariance[axis::2, axis::2].copy()
        total += block.trace() / count - block.mean()
    return float(total)


@jit
def _follow(
    run: _Run,
    by_row: IntArray,
    noises: tuple[Array, Array],
    pending: Array,
    P: Array,
    out: _Bounds,
) -> None:
    """Take the bound P of one run through all its scans, in place.

    The first `size` rows and columns of P are those of the pose and of the landmarks
    read so far. Landmark i is the (i + 1)-th to be read. A scan is subtracted from P in
    one pass, from its pending rows and shares: P −= Σ share rowᵀ.
    """
    (poses, landmarks, visible, dt, fixes), (motion, noise) = run, noises
    entry = np.zeros((len(P), 3))
    size = 3
    for t in range(len(poses)):
        if t > 0 and dt[t] > 0:
            _move(poses, landmarks, t, motion * dt[t], entry, P, size)
        x, y = poses[t, 0], poses[t, 1]
        count = 0
        for i in by_row:
            if not visible[t, i]:
                continue
            dx, dy = landmarks[i, 0] - x, landmarks[i, 1] - y
            bx, by, rx, ry = reading_slopes_jit(dx, dy)
            distance = np.sqrt(dx * dx + dy * dy)
            across = (noise[0] + noise[3] / max(distance, 1e-12)) ** 2
            along = (noise[1] + noise[2] * distance) ** 2
            if noise[4] > 0:  # (x, y) in the robot's frame
                ry, rx = np.cos(poses[t, 2]), -np.sin(poses[t, 2])
                bx, by, distance = ry, -rx, 1.0
            c = 3 + 2 * i
            if c < size:
                _read(P, size, pending, count, c, bx, by, across)
                _read(P, size, pending, count + 1, c, rx, ry, along)
                count += 2
            else:
                _subtract(P, size, pending, count)
                count = 0
                size += 2
                _add(P, c, size, rx, ry, across * distance * distance, along)
        _subtract(P, size, pending, count)
        for axis, lever in enumerate((-y, x, 1.0)):
            _fix(P, size, axis, lever, fixes[t, axis])
        out[0][t], out[1][t] = P[0, 0] + P[1, 1], P[2, 2]
        lever = 2 * (x * P[1, 2] - y * P[0, 2]) + (x * x + y * y) * P[2, 2]
        out[2][t] = out[0][t] + lever


@njit_allocating
def _move(
    poses: Array, points: Array, t: int, noise: Array, entry: Array, P: Array, size: int
) -> None:
    """Add the noise of the motion to scan t, with the variances ``noise``."""
    cos, sin = np.cos(poses[t - 1, 2]), np.sin(poses[t - 1, 2])
    entry[0, 0], entry[1, 0] = cos, sin
    entry[0, 1], entry[1, 1] = -sin, cos
    entry[0, 2], entry[1, 2], entry[2, 2] = poses[t, 1], -poses[t, 0], 1.0
    for i in range(size // 2 - 1):
        entry[3 + 2 * i, 2], entry[4 + 2 * i, 2] = points[i, 1], -points[i, 0]
    for i in range(2):
        for j in range(2):
            for k in range(2):
                P[i, j] += entry[i, k] * entry[j, k] * noise[k]
    turn = entry[:, 2].copy()
    for i in range(size):
        turned, row = turn[i] * noise[2], P[i]
        for j in range(size):
            row[j] += turned * turn[j]


@njit_allocating
def _fix(P: Array, size: int, axis: int, lever: float, variance: float) -> None:
    """Take in a reading of x, y or θ: of ξ along the axis, and `lever` times ξ_θ."""
    if variance == np.inf:
        return
    row = lever * P[2, :size]
    if axis < 2:
        row += P[axis, :size]
    total = lever * row[2] + variance
    if axis < 2:
        total += row[axis]
    for i in range(size):
        for j in range(size):
            P[i, j] -= row[i] * row[j] / total


@njit_allocating
def _read(
    P: Array, size: int, due: Array, m: int, c: int, gx: float, gy: float, noise: float
) -> None:
    """Take in one number, (gx, gy) (ξ_l − ξ_p) plus noise, of the landmark at c.

    It becomes due, after ``m`` others; the variance of its noise is ``noise``.
    """
    now = np.empty((4, size))  # rows of P after what is due
    for n, at in enumerate((c, c + 1, 0, 1)):
        now[n] = P[at, :size]
        for k in range(m):
            now[n] -= due[1, k, at] * due[0, k, :size]
    row, share = due[0, m], due[1, m]
    for j in range(size):
        row[j] = gx * (now[0, j] - now[2, j]) + gy * (now[1, j] - now[3, j])
    total = gx * (row[c] - row[0]) + gy * (row[c + 1] - row[1]) + noise
    for i in range(size):
        share[i] = row[i] / total


@njit_internal
def _subtract(P: Array, size: int, pending: Array, count: int) -> None:
    """Subtract what is pending, the two numbers of each reading together."""
    for i in range(size):
        target = P[i]
        for k in range(0, count, 2):
            first, second = pending[0, k], pending[0, k + 1]
            share, other = pending[1, k, i], pending[1, k + 1, i]
            for j in range(size):
                target[j] = target[j] - share * first[j] - other * second[j]


@njit_internal
def _add(
    P: Array, c: int, size: int, rx: float, ry: float, across: float, along: float
) -> None:
    """Add the landmark at c, read in the direction (rx, ry), ξ_l = ξ_p + noise."""
    for j in range(size):
        P[c, j], P[c + 1, j] = P[0, j], P[1, j]
        P[j, c], P[j, c + 1] = P[0, j], P[1, j]
    P[c, c] = P[0, 0] + rx * rx * along + ry * ry * across
    P[c + 1, c + 1] = P[1, 1] + ry * ry * along + rx * rx * across
    P[c, c + 1] = P[c + 1, c] = P[0, 1] + rx * ry * (along - across)
