"""Smooth a drive: the most likely poses and landmarks given all its readings."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike

from ...arrays import Array, IntArray
from ..interface import Belief
from ..models.bearing_range import locate_landmark
from ..support import argument_checks
from .drive import Drive
from .optimiser import KINDS, Estimate, Noise, Optimiser, Solution
from .smoothed_drive import SmoothedDrive
from .start import start_of

ITERATIONS = 5  # of an update of the filter that gives the second start
SCALES = {"huber": 1.345, "cauchy": 2.3849}  # 95 % efficient without outliers


def smooth(
    drive: Drive,
    *,
    start: ArrayLike | Belief | None = None,
    landmarks: Mapping[int, ArrayLike] | None = None,
    robust: str | None = None,
    robust_scale: float | None = None,
    tolerance: float = 1e-9,
    iterations: int = 100,
) -> SmoothedDrive:
    """Return the most likely poses and landmarks of a drive, with their covariances.

    The maximum a posteriori estimate under the prior, motion and sensor noise of the
    filters [1]_: Levenberg-Marquardt, which eliminates the poses along the chain and
    solves for the landmarks last.

    Parameters
    ----------
    drive : Drive
        Motions and scans.
    start : Belief or array_like, shape (N, 3), optional
        The belief of a filter at the end of the drive, or poses to start from; by
        default an invariant filter over the drive.
    landmarks : mapping from id to (2,), optional
        Landmarks to start from; else those of the filter, or as first read.
    robust : {"huber", "cauchy"}, optional
        Kernel that gives outliers less weight.
    robust_scale : float, optional
        Normalised distance of a reading from which on it counts less; 1.345 for Huber's
        and 2.3849 for Cauchy's by default.
    tolerance : float
        The solution is found when no pose or landmark moves more [m, rad].
    iterations : int
        Most iterations.

    Raises
    ------
    ValueError
        If the drive has no readings, the start does not fit, or it has a landmark
        without a reading.
    numpy.linalg.LinAlgError
        If the iterations do not converge.
    MemoryError
        If memory does not suffice.

    References
    ----------
    .. [1] F. Dellaert, M. Kaess, Square Root SAM, IJRR 25(12), 2006.

    Examples
    --------
    >>> drive = Drive(motion_std=(0.1, 0.1, 0.05), measurement_std=(0.02, 0.1))
    >>> drive.update([(0.0, 5.0)], [7])
    >>> drive.predict((2.0, 0.0))
    >>> drive.update([(0.0, 3.2)], [7])
    >>> np.round(smooth(drive).poses[-1], 3)
    array([1.933, 0.   , 0.   ])
    """
    argument_checks.whole("iterations", iterations, 1)
    argument_checks.above("tolerance", tolerance, 0.0)
    noise = Noise(drive.rules, *robust_kernel(robust, robust_scale))
    arrays, order = drive.arrays()
    optimiser = Optimiser(arrays, noise)
    starts = _starts(drive, start, _places(landmarks or {}, order), order)
    found = _best(optimiser, starts, tolerance, iterations)
    return SmoothedDrive(optimiser, found, order.tolist(), drive)


def robust_kernel(robust: str | None, scale: float | None) -> tuple[float, float]:
    """Return kind and scale of a robust kernel, or refuse them."""
    if robust is not None:
        argument_checks.one_of("robust", robust, tuple(SCALES))
    chosen = SCALES.get(robust or "", 1.0) if scale is None else scale
    return KINDS[robust], argument_checks.above("robust_scale", chosen, 0.0)


def _best(
    optimiser: Optimiser,
    starts: Sequence[Callable[[], Estimate]],
    tolerance: float,
    iterations: int,
) -> Solution:
    """Return the solution from the first start, or the best where that is implausible.

    Raises the error of the first start where none leads to a solution.
    """
    failures, best = [], None
    for start in starts:
        try:
            found = optimiser.minimise(start(), tolerance, iterations)
        except np.linalg.LinAlgError as error:
            failures.append(error)
            continue
        if best is None or found.cost < best.cost:
            best = found
        if best.cost <= optimiser.plausible_cost:
            break
    if best is None:
        raise failures[0]
    return best


def _places(landmarks: Mapping[int, ArrayLike], order: IntArray) -> dict[int, Array]:
    """Return the landmarks given by the user; each has a reading."""
    known = set(order.tolist())
    given = {
        i: argument_checks.finite_vector(f"landmarks[{i}]", place, 2)
        for i, place in landmarks.items()
    }
    for i in given:
        if i not in known:
            raise ValueError(f"landmark {i} has no reading in the drive")
    return given


def _starts(
    drive: Drive,
    start: ArrayLike | Belief | None,
    given: Mapping[int, Array],
    order: IntArray,
) -> list[Callable[[], Estimate]]:
    """Return functions that compute poses and landmarks to start from, best first."""

    def estimate(poses: Array, found: Mapping[int, Array]) -> Estimate:
        return Estimate(poses, _landmarks_at(drive, poses, {**found, **given}, order))

    if start is None or isinstance(start, Belief):
        return [
            lambda: estimate(*start_of(drive, start)),
            lambda: estimate(*start_of(drive, iterations=ITERATIONS)),
        ]
    poses = argument_checks.as_floats("start", start).copy()
    if poses.shape != (drive.poses, 3) or not np.isfinite(poses).all():
        raise ValueError(
            f"start must be finite poses ({drive.poses}, 3), got shape {poses.shape}"
        )
    return [lambda: estimate(poses, {})]


def _landmarks_at(
    drive: Drive, poses: Array, known: Mapping[int, Array], order: IntArray
) -> Array:
    """Return where the landmarks start, shape (2n,): as known, or as first read."""
    places = dict(known)
    if len(places) < len(order):
        for k in range(drive.poses):
            readings, ids = drive.sightings(k)
            located = locate_landmark(poses[k], readings).position
            for i, place in zip(ids.tolist(), located, strict=True):
                places.setdefault(i, place)
    return np.concatenate([places[i] for i in order.tolist()])
