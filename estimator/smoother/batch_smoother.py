"""Smooth a drive: the most likely poses and landmarks given all its readings.

`smooth` finds them, and the `SmoothedDrive` that it returns computes covariances.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import cho_solve, solve_triangular

from ... import argument_checks
from ...argument_checks import LandmarkIds
from ...arrays import Array, IntArray
from ..interface import Belief, SlamEstimator
from ..map_management.managed_slam import filter_in
from ..models.bearing_range import locate_landmark, wrap_angle
from ..models.rigid_motion import seen_from
from ..models.sensors import BEARING_RANGE
from .drive import Drive, Sightings, path_between
from .elimination import PART, Sensitivity
from .optimiser import (
    KINDS,
    Estimate,
    Optimiser,
    ReadingNoise,
    Solution,
    factorised,
    filter_drive,
    start_of,
)
from .reassociation import Reassociation, reassociate

ITERATIONS = 5  # of an update of the filter that gives the second start
Start = ArrayLike | Belief  # poses, or the belief of a filter at the end
SCALES = {"huber": 1.345, "cauchy": 2.3849}  # 95 % efficient without outliers


def smooth(
    drive: Drive,
    *,
    start: Start | None = None,
    landmarks: Mapping[int, ArrayLike] | None = None,
    robust: str | None = None,
    robust_scale: float | None = None,
    tolerance: float = 1e-9,
    iterations: int = 100,
    associate: bool = False,
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
    associate : bool
        Whether to repair the association of the readings before, see
        `reassociation.reassociate`, which returns it, too.  The landmarks of the
        solution have new identities.

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
    if not isinstance(drive, Drive):
        raise TypeError(
            f"drive must be a Drive, got {type(drive).__name__}; smooth_log smooths "
            "a log, or the file of one"
        )
    argument_checks.whole("iterations", iterations, 1)
    argument_checks.above("tolerance", tolerance, 0.0)
    if associate:
        poses = None if start is None or isinstance(start, Belief) else start
        return smooth_repaired(
            reassociate(drive, start=poses),
            robust=robust,
            robust_scale=robust_scale,
            tolerance=tolerance,
            iterations=iterations,
        )
    kernel, given = robust_kernel(robust, robust_scale), landmarks or {}
    # Far from the world's origin, coordinates are rounded by more than the last steps.
    origin = drive.initial_pose[:2]
    drive, given, start = drive.seen_from(origin), *_seen_from(origin, given, start)
    if not drive.sensor.places:
        drive, start, given = _placed(drive, start, given)
    arrays, order = drive.arrays()
    optimiser = Optimiser(arrays, ReadingNoise(drive.sensor, drive.rules, *kernel))
    starts = _starts(drive, start, _places(given, order), order)
    found = _best(optimiser, starts, tolerance, iterations)
    return SmoothedDrive(optimiser, found, order.tolist(), drive, origin)


def _seen_from(
    origin: Array, landmarks: Mapping[int, ArrayLike], start: Start | None
) -> tuple[dict[int, ArrayLike], Start | None]:
    """Return the initial values with positions relative to another origin."""
    given: dict[int, ArrayLike] = {
        i: argument_checks.finite_vector(f"landmarks[{i}]", place, 2) - origin
        for i, place in landmarks.items()
    }
    if start is None:
        return given, None
    if isinstance(start, Belief):
        return given, replace(start, mean=seen_from(origin, start.mean))
    poses = argument_checks.as_floats("start", start)
    shaped = poses.ndim > 0 and poses.shape[-1] == 3  # else refused later
    return given, seen_from(origin, poses) if shaped else poses


def smooth_repaired(found: Reassociation, **options: Any) -> SmoothedDrive:
    """Smooth a drive with repaired associations, by further keywords of `smooth`.

    It starts from the poses of the repair, and from those of a filter if that fails.
    """
    try:
        return smooth(found.drive, start=found.poses, **options)
    except np.linalg.LinAlgError:
        return smooth(found.drive, **options)


def robust_kernel(robust: str | None, scale: float | None) -> tuple[float, float]:
    """Return kind and scale of a robust kernel, or refuse them."""
    if robust is not None:
        argument_checks.one_of("robust", robust, tuple(SCALES))
    chosen = SCALES.get(robust or "", 1.0) if scale is None else scale
    return KINDS[robust], argument_checks.above("robust_scale", chosen, 0.0)


def _placed(
    drive: Drive, start: Start | None, given: Mapping[int, ArrayLike]
) -> tuple[Drive, Start, dict[int, ArrayLike]]:
    """Return a drive without landmarks that a filter cannot place, and the others.

    For a sensor whose single reading does not determine a landmark.
    """
    found = start
    if not isinstance(found, Belief):
        _, found = filter_drive(drive, iterations=ITERATIONS)
    pairs = zip(found.landmark_ids, found.landmarks, strict=True)
    read = set(drive.landmark_ids)
    known = {i: place for i, place in pairs if i in read} | dict(given)
    kept = [
        Sightings(z, np.where(np.isin(ids, list(known)), ids, -1))
        for z, ids in drive.scans
    ]
    return drive.with_scans(kept), found if start is None else start, known


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
    drive: Drive, start: Start | None, given: Mapping[int, Array], order: IntArray
) -> list[Callable[[], Estimate]]:
    """Return functions that compute poses and landmarks to start from, best first."""

    def estimate(poses: Array, found: Mapping[int, Array]) -> Estimate:
        return Estimate(poses, _landmarks_at(drive, poses, {**found, **given}, order))

    if start is None or isinstance(start, Belief):
        return [
            lambda: estimate(*start_of(drive, start)),
            lambda: estimate(*start_of(drive, iterations=ITERATIONS)),
        ]
    poses = argument_checks.as_floats("start", start)
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
        sensor = drive.sensor
        locate = locate_landmark if sensor == BEARING_RANGE else sensor.locate
        for k in range(drive.poses):
            readings, ids = drive.sightings(k)
            located = locate(poses[k], readings).position
            for i, place in zip(ids.tolist(), located, strict=True):
                places.setdefault(i, place)
    return np.concatenate([places[i] for i in order.tolist()])


class _Marginals(NamedTuple):
    """What the covariances are made of."""

    sensitivity: Sensitivity  # Π, Φ and Ψ
    factor: Array  # lower Cholesky factor of S, shape (2n, 2n)
    landmarks: Array  # P_l, shape (2n, 2n)


class SmoothedDrive:
    """The most likely poses and landmarks of a drive, given all its readings.

    ::

        P_l = S⁻¹,    P_k = Π_k + Ψ_k P_l Ψ_kᵀ,    P_kl = Ψ_k P_l
        P_jk = Π_j Φ_{j+1}ᵀ … Φ_kᵀ + Ψ_j P_l Ψ_kᵀ    for j < k

    with the Schur complement S of the landmarks and Π, Φ, Ψ of
    `elimination.Sensitivity`.

    Parameters
    ----------
    optimiser : Optimiser
        That found the solution; it linearises it when a covariance is asked for.
    solution : Solution
        The minimum of the cost.
    order : sequence of int
        The landmarks in the order of the elimination.
    drive : Drive
        What was smoothed.
    origin : ndarray, shape (2,)
        Origin of the positions in the optimiser and the drive [m].
    """

    def __init__(
        self,
        optimiser: Optimiser,
        solution: Solution,
        order: list[int],
        drive: Drive,
        origin: Array,
    ) -> None:
        estimate = solution.estimate
        #: Half the sum of the squared, normalised residuals; of a robust kernel, ρ.
        self.cost = solution.cost
        #: The cost at the start.
        self.first_cost = solution.first_cost
        #: Steps of Levenberg-Marquardt.
        self.iterations = solution.iterations
        #: In the order of their first reading.
        self.landmark_ids = drive.landmark_ids
        #: (x, y, θ), shape (N, 3) [m, m, rad], heading in [-π, π).
        self.poses = estimate.poses + np.append(origin, 0.0)
        self.poses[:, 2] = wrap_angle(self.poses[:, 2])
        self._motions, self._noise = tuple(drive.motions), drive.motion_noise
        #: Number of readings of landmarks.
        self.readings = drive.readings
        self._numbers = drive.sensor.size * drive.readings
        #: Number of components of readings of the poses themselves.
        self.pose_components = drive.pose_components
        self._slots = {i: slot for slot, i in enumerate(order)}
        self._all = estimate.landmarks + np.tile(origin, len(order))
        #: Positions in the order of `landmark_ids`, shape (n, 2) [m].
        self.landmarks = self._all[self._columns(self.landmark_ids)].reshape(-1, 2)
        self._optimiser, self._solution = optimiser, solution
        if solution.is_damped:
            _ = self._marginals  # refuses landmarks that are not determined

    @cached_property
    def _marginals(self) -> _Marginals:
        factor = factorised(self._optimiser.linearised(self._solution))
        return _Marginals(
            self._optimiser.sensitivity(self._solution),
            factor[0],
            np.asarray(cho_solve(factor, np.eye(len(self._all)))),
        )

    @property
    def readings_until(self) -> IntArray:
        """How many readings of odometry lead to each pose, shape (N,)."""
        counts = [len(motion.steps) for motion in self._motions]
        return np.cumsum(counts, dtype=np.int64)

    @property
    def cost_per_degree(self) -> float:
        """Twice the cost by its degrees of freedom, nan if there are none.

        It is about 1 if the noise is as assumed, and the kernel not robust.
        """
        freedom = self._numbers - 2 * len(self.landmarks) + self.pose_components
        return 2 * self.cost / freedom if freedom else float("nan")

    @property
    def path(self) -> Array:
        """The pose at the start and after each reading of odometry, shape (1 + P, 3).

        See `path.path_between`; where several readings lead to a scan.
        """
        return path_between(self.poses, self._motions, self._noise)

    @property
    def pose_covariances(self) -> Array:
        """Marginal covariance of each pose, shape (N, 3, 3)."""
        return self.covariances_of(range(len(self.poses)))

    def covariances_of(self, poses: Sequence[int] | IntArray) -> Array:
        """Return the marginal covariances of some poses, shape (p, 3, 3).

        Negative indices count from the end.
        """
        chosen = np.array([self._pose(pose) for pose in poses], dtype=np.int64)
        sensitivity, factor, _ = self._marginals
        covariances = sensitivity.given_map[chosen]
        for first in range(0, len(chosen), PART):
            own = sensitivity.of(chosen[first : first + PART])
            rows = own.reshape(-1, len(self._all)).T
            root = solve_triangular(factor, rows, lower=True).T.reshape(own.shape)
            covariances[first : first + PART] += root @ root.transpose(0, 2, 1)
        return covariances

    @property
    def landmark_covariances(self) -> Array:
        """Marginal covariance of each landmark, shape (n, 2, 2) [m²]."""
        columns = self._columns(self.landmark_ids).reshape(-1, 2)
        blocks = self._marginals.landmarks[columns[:, :, None], columns[:, None, :]]
        return np.asarray(blocks)

    def covariance(
        self, poses: Sequence[int], landmark_ids: LandmarkIds | None = None
    ) -> Array:
        """Return the joint covariance of some poses and landmarks.

        Parameters
        ----------
        poses : sequence of int
            Which poses; negative ones count from the end.
        landmark_ids : sequence of int, optional
            Which landmarks; by default all.

        Returns
        -------
        ndarray, shape (3p + 2m, 3p + 2m)
            Of the additive error, in the order given.

        Raises
        ------
        ValueError
            If a pose does not exist or a landmark has no reading.
        """
        chosen = [self._pose(pose) for pose in poses]
        columns = self._columns(self._known(landmark_ids))
        sensitivity = self._marginals.sensitivity.of(np.array(chosen, dtype=np.int64))
        to_landmarks = sensitivity.reshape(-1, len(self._all))
        spread = to_landmarks @ self._marginals.landmarks
        count = 3 * len(chosen)
        joint = np.empty((count + len(columns),) * 2)
        joint[:count, :count] = spread @ to_landmarks.T + self._given_map(chosen)
        joint[:count, count:] = spread[:, columns]
        joint[count:, :count] = joint[:count, count:].T
        joint[count:, count:] = self._marginals.landmarks[np.ix_(columns, columns)]
        return (joint + joint.T) / 2

    def belief(self, pose: int = -1, landmark_ids: LandmarkIds | None = None) -> Belief:
        """Return the belief about one pose and some landmarks, given the whole drive.

        Parameters
        ----------
        pose : int
            Which pose; the last one by default.
        landmark_ids : sequence of int, optional
            Which landmarks, in this order; by default all.
        """
        ids = self._known(landmark_ids)
        mean = np.concatenate(
            [self.poses[self._pose(pose)], self._all[self._columns(ids)]]
        )
        return Belief(mean, self.covariance([pose], ids), tuple(ids), "invariant")

    def _given_map(self, poses: Sequence[int]) -> Array:
        """Return the joint covariance of some poses if the map was known."""
        blocks = np.empty((len(poses), 3, len(poses), 3))
        sensitivity = self._marginals.sensitivity
        for at, first in enumerate(poses):
            later = {pose for pose in poses if pose >= first}
            moved = sensitivity.given_map[first]
            for k in range(first, max(later) + 1):
                if k > first:
                    moved = sensitivity.transitions[k] @ moved
                for other in [i for i, pose in enumerate(poses) if pose == k]:
                    blocks[other, :, at] = moved
                    blocks[at, :, other] = moved.T
        return blocks.reshape((3 * len(poses),) * 2)

    def _columns(self, ids: Sequence[int]) -> Array:
        firsts = np.array([2 * self._slots[i] for i in ids], dtype=np.int64)
        return np.asarray(np.stack([firsts, firsts + 1], axis=1).ravel())

    def _known(self, landmark_ids: LandmarkIds | None) -> list[int]:
        if landmark_ids is None:
            return list(self.landmark_ids)
        ids = argument_checks.identities(landmark_ids, np.size(landmark_ids))
        for i in ids:
            if i not in self._slots:
                raise ValueError(f"landmark {i} has no reading in the drive")
        return ids

    def _pose(self, pose: int) -> int:
        count = len(self.poses)
        if not -count <= pose < count:
            raise ValueError(f"poses must be below {count}, got {pose}")
        return pose % count

    def __repr__(self) -> str:
        return (
            f"SmoothedDrive of {len(self.poses)} poses and {len(self.landmarks)} "
            f"landmarks, cost {self.cost:.6g} after {self.iterations} iterations"
        )


def smoother_in(slam: SlamEstimator) -> Any:
    """Return the smoother, that of the most probable hypothesis; None without one."""
    inner = filter_in(slam)
    return inner if hasattr(inner, "smoothed") else None
