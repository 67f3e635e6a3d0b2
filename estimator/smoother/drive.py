"""Record the data of a whole drive: motions, scans and the noise of both.

A `Drive` is the input of the smoother, and `DriveArrays` is its form for kernels.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from copy import copy
from itertools import chain
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ... import argument_checks
from ...arrays import Array, IntArray
from ..filters.ekf import checked_rules
from ..filters.pose_readings import PoseReading
from ..kernels.scan_update import AT_ESTIMATE
from ..models.bearing_range import wrap_angle
from ..models.motions import UNICYCLE, Motion, MotionNoise
from ..models.rigid_motion import pose_rotation, predict
from ..models.sensors import Sensor, find_sensor


class OdometryBetween(NamedTuple):
    """The odometry between two poses."""

    # (d, α, dt) of each reading [m, rad, -].
    steps: tuple[tuple[float, float, float], ...]
    # Where they lead, in the frame of the first pose, shape (3,) [m, m, rad].
    increment: Array
    covariance: Array  # of the noise in that frame, shape (3, 3)


class Sightings(NamedTuple):
    """The readings of one pose."""

    measurements: Array  # rows (β, r), shape (m, 2) [rad, m]
    ids: IntArray  # landmark of each, shape (m,)

    def distinct(self) -> Iterator[Sightings]:
        """Yield them in scans that show no landmark twice.

        Landmarks repeat where there is no motion between two scans, and where two
        landmarks of a scan were merged.
        """
        turns, last = np.zeros(len(self.ids), dtype=np.int64), dict[int, int]()
        for k, i in enumerate(self.ids.tolist()):
            turns[k] = last[i] = last.get(i, -1) + 1
        for turn in range(max(last.values(), default=-1) + 1):
            chosen = turns == turn
            yield Sightings(self.measurements[chosen], self.ids[chosen])


class Drive:
    """The motions and scans of a drive, with the noise that filters assume.

    It has the methods ``predict`` and ``update`` of a filter.  The poses of the drive
    are those of the scans.  Odometry readings between two scans are composed, and their
    noise is propagated to first order, as in a filter's prediction (exactly, for a
    single reading).

    Parameters
    ----------
    motion_std : array_like, shape (3,)
        (σx, σy, σα) of the motion noise in the robot frame [m, m, rad], per step of
        dt = 1.  Zeros are exact: such a motion is certain in that direction.
    measurement_std : array_like, shape (2,)
        (σβ, σr) of the measurement noise [rad, m].
    initial_pose, initial_pose_std : array_like, shape (3,)
        Mean and standard deviation of the first pose [m, m, rad].
    sensor, noise_at_rest, min_range
        As in :class:`~slamgym.estimator.EkfSlam`.
    motion : str or Motion
        The drive.

    Raises
    ------
    ValueError
        If an argument has the wrong shape, is not finite or negative, or a reading
        would have no noise.

    Examples
    --------
    >>> drive = Drive(motion_std=(0.1, 0.1, 0.05), measurement_std=(0.02, 0.1))
    >>> drive.update([(0.0, 5.0)], [7])
    >>> drive.predict((2.0, 0.0))
    >>> drive.update([(0.0, 3.0)], [7])
    >>> drive.poses, drive.landmark_ids
    (2, (7,))
    """

    def __init__(
        self,
        motion_std: ArrayLike,
        measurement_std: ArrayLike,
        *,
        sensor: str | Sensor = "bearing_range",
        initial_pose: ArrayLike = (0.0, 0.0, 0.0),
        initial_pose_std: ArrayLike = (0.0, 0.0, 0.0),
        noise_at_rest: bool = True,
        min_range: float = 1e-3,
        motion: str | Motion = UNICYCLE,
    ) -> None:
        self.motion_noise = MotionNoise.checked(motion_std, noise_at_rest, motion)
        self.sensor = find_sensor(sensor)
        self.rules = rules = checked_rules(
            measurement_std, sensor=self.sensor, min_range=min_range
        )
        std = rules.first_std, rules.second_std
        if not (self.sensor.stds(std, 1.0) > 0).all():
            raise ValueError(
                f"measurement_std must be > 0 to smooth, got ({std[0]:g}, {std[1]:g})"
            )
        self.start_at(initial_pose, initial_pose_std)
        self._motions: list[OdometryBetween] = [
            OdometryBetween((), np.zeros(3), np.zeros((3, 3)))
        ]
        self._sightings: list[list[Sightings]] = [[]]
        self._pending: list[tuple[float, float, float]] = []
        self._observed: dict[int, list[PoseReading]] = {}  # by the pose

    def start_at(self, pose: ArrayLike, std: ArrayLike) -> None:
        """Set mean and standard deviation (3,) of the first pose [m, m, rad]."""
        checked = argument_checks.standard_deviations("initial_pose_std", std, 3)
        self.initial_pose = argument_checks.finite_vector("initial_pose", pose, 3)
        self.initial_pose_std = checked

    @property
    def poses(self) -> int:
        """Number of poses: the first one, and one at every later scan."""
        return len(self._motions)

    @property
    def readings_until(self) -> IntArray:
        """How many readings of odometry lead to each pose, shape (N,)."""
        return np.cumsum([len(motion.steps) for motion in self._motions])

    @property
    def readings(self) -> int:
        """Number of readings."""
        return sum(len(scan.ids) for scan in self.scans)

    @property
    def scans(self) -> list[Sightings]:
        """The scans, in their order; several ones may share a pose."""
        return [scan for scans in self._sightings for scan in scans]

    @property
    def motions(self) -> Sequence[OdometryBetween]:
        """The motion to each pose; that to the first one is empty."""
        return self._motions

    @property
    def landmark_ids(self) -> tuple[int, ...]:
        """The landmarks that are read, in the order of their first reading."""
        scans = [scan.ids for scan in self.scans]
        if not scans:
            return ()
        found, first = np.unique(np.concatenate(scans), return_index=True)
        return tuple(found[np.argsort(first)].tolist())

    def predict(self, odometry: ArrayLike, dt: float = 1.0) -> None:
        """Move by odometry (d, α) [m, rad]; dt multiplies the noise variance."""
        reading = argument_checks.pair("odometry", odometry)
        noise = self.motion_noise
        noise.over(noise.motion.moved_by(*reading), dt)  # refuses a wrong dt
        self._pending.append((*reading, float(dt)))

    def update(
        self, measurements: ArrayLike, landmark_ids: argument_checks.LandmarkIds
    ) -> None:
        """Add one scan at the present pose; readings below ``min_range`` are skipped.

        Parameters
        ----------
        measurements : array_like, shape (m, 2)
            Rows (β, r) [rad, m], or those of the sensor.
        landmark_ids : sequence of int, length m
            Identity of the landmark behind each row, without repetition.

        Raises
        ------
        ValueError
            If the arguments are malformed; the drive is then as before.
        """
        readings = argument_checks.scan(measurements, self.sensor.columns)
        ids = argument_checks.identities(landmark_ids, len(readings))
        argument_checks.refuse_unusable(readings, ids)
        self.end_motion()
        usable = self.sensor.distances(readings) >= self.rules.min_range
        chosen = np.array(ids, dtype=np.int64)[usable]
        self._sightings[-1].append(Sightings(readings[usable], chosen))

    def observe_pose(
        self, reading: ArrayLike, matrix: ArrayLike, covariance: ArrayLike
    ) -> None:
        """Add a reading z = H (x, y, θ) + w, w of covariance R, at the present pose.

        Parameters as in :meth:`EkfSlam.observe_pose`.
        """
        given = PoseReading.checked(reading, matrix, covariance)
        self.end_motion()
        self._observed.setdefault(self.poses - 1, []).append(given)

    def pose_readings(self, pose: int) -> list[PoseReading]:
        """Return the readings of one pose itself, such as compass or GPS."""
        return self._observed.get(pose, [])

    @property
    def pose_components(self) -> int:
        """Number of components of all readings of the poses themselves."""
        given = chain.from_iterable(self._observed.values())
        return sum(len(reading.matrix) for reading in given)

    def end_motion(self) -> None:
        """Make the present position a pose of the drive, also without a scan."""
        if self._pending:
            self._motions.append(self._composed(self._pending))
            self._sightings.append([])
            self._pending = []

    def merge(self, kept: int, gone: int) -> None:
        """Assign the readings of one landmark to another."""
        for scans in self._sightings:
            for scan in scans:
                scan.ids[scan.ids == gone] = kept

    def forget(self, landmark_ids: Collection[int]) -> None:
        """Drop all readings of some landmarks."""
        gone = np.array(list(landmark_ids), dtype=np.int64)
        for scans in self._sightings:
            kept = (~np.isin(scan.ids, gone) for scan in scans)
            pairs = zip(scans, kept, strict=True)
            scans[:] = [Sightings(z[keep], ids[keep]) for (z, ids), keep in pairs]

    def with_scans(self, scans: Sequence[Sightings]) -> Drive:
        """Return a drive of the same motions with other readings in its scans.

        Readings of the landmark -1 are dropped.
        """
        made = copy(self)
        kept = iter([Sightings(z[ids >= 0], ids[ids >= 0]) for z, ids in scans])
        vars(made).update(
            _motions=list(self._motions),
            _pending=list(self._pending),
            _observed={pose: list(z) for pose, z in self._observed.items()},
            _sightings=[[next(kept) for _ in own] for own in self._sightings],
        )
        return made

    def seen_from(self, origin: Array) -> Drive:
        """Return the drive with positions relative to another origin (2,) [m]."""
        made, shift = copy(self), np.append(origin, 0.0)
        observed = {
            pose: [
                given._replace(value=given.value - given.matrix @ shift)
                for given in readings
            ]
            for pose, readings in self._observed.items()
        }
        vars(made).update(initial_pose=self.initial_pose - shift, _observed=observed)
        return made

    def sightings(self, pose: int) -> Sightings:
        """Return all readings of one pose."""
        scans = self._sightings[pose]
        if len(scans) == 1:
            return scans[0]
        none = Sightings(np.empty((0, 2)), np.empty(0, dtype=np.int64))
        columns = zip(none, *scans, strict=True)
        return Sightings(*(np.concatenate(parts) for parts in columns))

    def arrays(self) -> tuple[DriveArrays, IntArray]:
        """Return the data as kernels take it, and the landmarks in their order.

        Raises
        ------
        ValueError
            If there is no reading.
        """
        scans = [self.sightings(pose) for pose in range(self.poses)]
        ids = np.concatenate([scan.ids for scan in scans])
        if not len(ids):
            raise ValueError(
                f"a drive to smooth must hold readings of landmarks, got none in its "
                f"{self.poses} poses"
            )
        firsts = np.cumsum([0, *(len(scan.ids) for scan in scans)], dtype=np.int64)
        order, widths = landmark_order(ids, firsts)
        by_id = np.argsort(order)
        slots = by_id[np.searchsorted(order[by_id], ids)]
        covariances = np.array([motion.covariance for motion in self._motions])
        covariances[0] = np.diag(self.initial_pose_std**2)
        arrays = DriveArrays(
            self.initial_pose,
            np.array([motion.increment for motion in self._motions]),
            *noise_factors(covariances),
            firsts,
            np.concatenate([scan.measurements for scan in scans]),
            2 * slots,
            widths,
            self._pose_arrays(),
        )
        return arrays, order

    def _pose_arrays(self) -> PoseArrays:
        """Return the readings of the poses, filled up to three components."""
        owners = [k for k, given in self._observed.items() for _ in given]
        readings = chain.from_iterable(self._observed.values())
        values = np.zeros((len(owners), 3))
        matrices, roots = np.zeros((2, len(owners), 3, 3))
        for j, (z, H, R) in enumerate(readings):
            size = len(H)
            values[j, :size], matrices[j, :size] = z, H
            roots[j, :size, :size] = np.linalg.inv(np.linalg.cholesky(R))
        firsts = np.searchsorted(owners, np.arange(self.poses + 1))
        return PoseArrays(firsts.astype(np.int64), values, matrices, roots)

    def _composed(self, steps: Sequence[tuple[float, float, float]]) -> OdometryBetween:
        """Compose readings of odometry as a filter predicts from a certain pose 0."""
        *_, (pose, covariance) = _along(steps, self.motion_noise)
        return OdometryBetween(tuple(steps), pose, covariance)

    def __repr__(self) -> str:
        readings = f"{self.readings} readings of {len(self.landmark_ids)} landmarks"
        return f"Drive of {self.poses} poses, {readings}"


# --------------------------------------------------------------------------------------
# The data of a drive as kernels take it, and the order of its landmarks.
#
# Symbols
# -------
# x_k            pose k = 0 … N − 1, (x, y, θ) in the world frame [m, m, rad]
# Δ_k            odometry from pose k − 1 to pose k, a pose in the frame of pose k − 1
# ε_k = N_k w_k  noise of that motion in the frame of pose k − 1, w_k ~ N(0, I)
# V_k            whitener: V_k N_k = I where N_k has full rank

# Variance of a direction without noise, relative to that of the noisiest one.
NEGLIGIBLE = 1e-12


class PoseArrays(NamedTuple):
    """K readings z = H x_k of the poses themselves, filled up with zeros."""

    firsts: IntArray  # those of pose k are rows firsts[k] … firsts[k + 1], (N + 1,)
    values: Array  # z, shape (K, 3)
    matrices: Array  # H, shape (K, 3, 3)
    whiteners: Array  # L⁻¹ with L Lᵀ = R, shape (K, 3, 3)


class DriveArrays(NamedTuple):
    """N poses, M readings of n landmarks; entry 0 of the motions is the prior."""

    start: Array  # prior mean of pose 0, shape (3,)
    increments: Array  # Δ_k, shape (N, 3) [m, m, rad]; row 0 is not read
    factors: Array  # N_k, shape (N, 3, 3); entry 0 is the deviation of the prior
    whiteners: Array  # V_k, shape (N, 3, 3)
    # The readings of pose k are rows firsts[k] … firsts[k + 1], shape (N + 1,).
    firsts: IntArray
    readings: Array  # rows (β, r), shape (M, 2) [rad, m]
    # First column of the landmark of each reading, 2 slot, shape (M,).
    columns: IntArray
    # Columns of the landmarks that pose k or a later one reads, shape (N,).
    widths: IntArray
    fixes: PoseArrays


def noise_factors(covariances: Array) -> tuple[Array, Array]:
    """Return N with N Nᵀ = Σ, and V with V Σ Vᵀ = I, of covariances (N, 3, 3).

    A direction without noise, to which the solution adheres, gets the weight of the
    noisiest one in V: V only measures how far an iterate is from the solution.

    Examples
    --------
    >>> factor, whitener = noise_factors(np.diag([4.0, 0.0, 1.0])[None])
    >>> np.allclose(factor @ factor.transpose(0, 2, 1), np.diag([4.0, 0.0, 1.0]))
    True
    >>> np.round(np.sort(abs(whitener[0]).max(axis=1)), 3)
    array([0.5, 0.5, 1. ])
    """
    variances, axes = np.linalg.eigh(covariances)
    largest = variances[:, -1:]
    noisy = variances > NEGLIGIBLE * largest
    std = np.sqrt(np.where(noisy, variances, 0.0))
    scale = np.sqrt(np.where(largest > 0, largest, 1.0))
    weights = 1 / np.where(noisy, std, scale)
    factors, whiteners = axes * std[:, None], weights[:, :, None] * axes.mT
    # One layout whatever the number of poses: for another, kernels compile anew.
    return np.ascontiguousarray(factors), np.ascontiguousarray(whiteners)


def landmark_order(ids: IntArray, firsts: IntArray) -> tuple[IntArray, IntArray]:
    """Order landmarks by their last reading, the latest first.

    The elimination goes backwards in time.  In this order the landmarks that it has met
    are always the first ones of the state.

    Parameters
    ----------
    ids : ndarray of int64, shape (M,)
        Landmark of each reading.
    firsts : ndarray of int64, shape (N + 1,)
        As in :class:`DriveArrays`.

    Returns
    -------
    order : ndarray, shape (n,)
        Landmark ids.
    widths : ndarray, shape (N,)
        As in :class:`DriveArrays`.

    Examples
    --------
    >>> order, widths = landmark_order(np.array([4, 7, 4]), np.array([0, 1, 2, 3]))
    >>> order.tolist(), widths.tolist()
    ([4, 7], [4, 4, 2])
    """
    found, from_the_end = np.unique(ids[::-1], return_index=True)
    by_last = np.argsort(from_the_end, kind="stable")
    last_rows = len(ids) - 1 - from_the_end[by_last]
    last_poses = np.searchsorted(firsts, last_rows, side="right") - 1
    met = np.searchsorted(-last_poses, -np.arange(len(firsts) - 1), side="right")
    return found[by_last], 2 * met


def path_between(
    poses: Array, motions: Sequence[OdometryBetween], noise: MotionNoise
) -> Array:
    """Return the pose after each reading of odometry, given the poses at the scans.

    The readings between two poses lead from the first one to the second except for
    their noise, which the poses determine in sum.  Each reading gets the part of it
    that is expected, given the sum s::

        E[s_i | s] = Σ_i Φᵀ Σ⁻¹ s

    with the covariance Σ_i after reading i and its transition Φ to the end.

    Parameters
    ----------
    poses : ndarray, shape (N, 3)
        At the scans [m, m, rad].
    motions : sequence of OdometryBetween
        Those of the drive, the first one empty.
    noise : MotionNoise
        Of the odometry.

    Returns
    -------
    ndarray, shape (1 + P, 3)
        The first pose, and that after each of the P readings; headings in [-π, π).

    Examples
    --------
    >>> steps = ((1.0, 0.0, 1.0), (1.0, 0.0, 3.0))
    >>> spread = np.diag([4.0, 0.0, 0.0])
    >>> still = OdometryBetween((), np.zeros(3), np.zeros((3, 3)))
    >>> motions = [still, OdometryBetween(steps, np.array([2.0, 0, 0]), spread)]
    >>> noise = MotionNoise.checked((1.0, 0, 0), noise_at_rest=True)
    >>> path_between(np.array([[0.0, 0, 0], [2.4, 0, 0]]), motions, noise)[:, 0]
    array([0. , 1.1, 2.4])
    """
    path, spreads = [poses[:1]], [m.covariance for m in motions if len(m.steps) > 1]
    stack = np.reshape(spreads, (-1, 3, 3))
    inverses = iter(np.linalg.pinv(stack, hermitian=True))
    for k in range(1, len(poses)):
        ends, motion = poses[k - 1 : k + 1], motions[k]
        single = len(motion.steps) == 1
        path.append(
            ends[1:] if single else _between(ends, motion, next(inverses), noise)
        )
    found = np.concatenate(path)
    found[:, 2] = wrap_angle(found[:, 2])
    return found


def _between(
    ends: Array, motion: OdometryBetween, inverse: Array, noise: MotionNoise
) -> Array:
    """Return the poses after the readings of one motion, shape (P, 3).

    ``ends`` are its first and last pose, (2, 3), and ``inverse`` is Σ⁻¹ in the formula
    of `path_between`.
    """
    first, last = ends
    turn = pose_rotation(first[2])
    gap = turn.T @ (last - first) - motion.increment
    gap[2] = wrap_angle(gap[2])
    pull = inverse @ gap
    path, onward = np.empty((len(motion.steps), 3)), np.eye(3)
    for i, (pose, covariance) in enumerate(_along(motion.steps, noise)):
        onward[0, 2] = -(motion.increment[1] - pose[1])
        onward[1, 2] = motion.increment[0] - pose[0]
        path[i] = first + turn @ (pose + covariance @ onward.T @ pull)
    path[-1] = last
    return path


def _along(
    steps: Sequence[tuple[float, float, float]], noise: MotionNoise
) -> Iterator[tuple[Array, Array]]:
    """Yield pose and covariance after each step, in the frame before the first."""
    pose, covariance = np.zeros(3), np.zeros((3, 3))
    for *odometry, dt in steps:
        moved = noise.motion.moved(odometry)
        predict(pose, covariance, pose, 3, *moved, noise.over(moved, dt), AT_ESTIMATE)
        yield pose, covariance
