"""Lower bound of the errors of any filter: the posterior Cramér-Rao bound.

The bound of Tichavský, Muravchik and Nehorai [1]_ is the covariance of a Kalman filter
that is linearised at the truth. Many runs are filtered at once, without estimates. The
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
from ..arrays import Array, BoolArray, IntArray
from ..estimator.beliefs import columns_of
from ..estimator.filters.batch import durations_of, filter_at_truth
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
    with_covariances: bool = True,
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
    with_covariances : bool
        Whether to return the final covariances, too.
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
    least, spread = np.full((count, 3, steps), np.nan), np.full(count, np.nan)
    covariances = list[Array]()
    dt, fixes = (
        np.ascontiguousarray(np.broadcast_to(array, shape))
        for array, shape in (
            (durations_of(dt), (count, steps)),
            (np.asarray(pose_std, dtype=np.float64), poses.shape),
        )
    )
    if not (fixes > 0).all():
        raise ValueError("pose_std must be above 0, infinite where there is no reading")
    arrays = poses, places, seen, dt, fixes, least, spread
    pieces = _pieces(seen) if read in (BEARING_RANGE, POSITION) else ()
    for some in pieces:
        piece = [array[some] for array in arrays]
        P, slots = filter_at_truth(piece, start, *stds, read, threads)
        if with_covariances:
            last = poses[some, -1], places[some]
            covariances += _invariant_covariances(P, slots, *last)
    position, heading, raw = np.moveaxis(least, 1, 0)
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


def map_error_squared(errors: Array) -> Array:
    """Return the square of invariant errors (..., n, 2) that the bound is about.

    Returns
    -------
    ndarray, shape (...)
        Mean over the n > 0 landmarks about the centre of the map [m²].
    """
    apart = errors - errors.mean(axis=-2, keepdims=True)
    return np.asarray((apart**2).sum(axis=-1).mean(axis=-1))


_MOST_BYTES = 2**22  # of the covariances of the runs that are filtered at once


def _pieces(visible: BoolArray) -> Iterator[slice]:
    """Cut runs into pieces that fit into memory."""
    most = int(visible.any(axis=1).sum(axis=1).max(initial=0))
    size = max(argument_checks.usable_cores(), _MOST_BYTES // (8 * (3 + 2 * most) ** 2))
    for begin in range(0, len(visible), size):
        yield slice(begin, begin + size)


def _invariant_covariances(
    covariances: Array, slots: IntArray, poses: Array, places: Array
) -> Iterator[Array]:
    """Yield the whole final covariances of runs, landmarks in the order of rows."""
    for P, slot, pose, points in zip(covariances, slots, poses, places, strict=True):
        read = slot >= 0
        at = columns_of(slot[read].tolist())
        whole = (np.tril(P) + np.tril(P, -1).T)[np.ix_(at, at)]
        yield invariant_covariance(np.append(pose, points[read]), whole)
