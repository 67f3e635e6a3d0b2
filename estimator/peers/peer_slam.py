"""What the adapters of other libraries share: settings, arguments, and reports."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ... import argument_checks
from ...argument_checks import LandmarkIds
from ...arrays import Array, IntArray
from ..interface import Belief, UpdateReport
from ..models.bearing_range import predict_measurement, wrap_angle
from ..models.motions import UNICYCLE, Motion, MotionNoise, predict_pose
from ..models.sensors import Sensor, only_bearing_range

# Least deviation of the first pose [m, rad]: the libraries take no certain one.
START_FLOOR = 1e-6


class Readings(NamedTuple):
    """Readings of one scan, with their variances."""

    measurements: Array  # rows (β, r), shape (m, 2) [rad, m]
    slots: IntArray  # place of each landmark in the map, shape (m,)
    variances: Array  # (σβ², σr²), shape (m, 2)


class Innovation(NamedTuple):
    """Innovations of a scan at the prior."""

    values: Array  # ν, shape (m, 2), rows (bearing, range) [rad, m]
    covariance: Array  # S, shape (2m, 2m), in the order β1, r1, β2, r2


class PeerSlam(ABC):
    """An estimator of another library, fed step by step.

    Parameters
    ----------
    motion_std, measurement_std, initial_pose, initial_pose_std
        As in :func:`~slamgym.estimator.make_estimator`; a first pose that is certain
        has the deviation `START_FLOOR`.
    sensor, noise_at_rest, min_range, motion
        As in :class:`~slamgym.estimator.EkfSlam`; bearing-range only, and its noise is
        that at the range that the estimate expects.

    Raises
    ------
    ValueError
        If an argument has the wrong shape or is not finite or negative.
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
        self._noise = MotionNoise.checked(motion_std, noise_at_rest, motion)
        self._sensor = only_bearing_range(sensor, "an adapter")
        std = argument_checks.standard_deviations("measurement_std", measurement_std, 2)
        self._std = std
        self._min_range = argument_checks.above("min_range", min_range, 0)
        self._slots: dict[int, int] = {}
        self.reset(initial_pose, initial_pose_std)

    @property
    def landmark_ids(self) -> tuple[int, ...]:
        """The mapped landmarks, in the order of the belief."""
        return tuple(self._slots)

    def reset(self, pose: ArrayLike, pose_std: ArrayLike) -> None:
        """Start a new run, without a map, at a pose (3,) with deviations (3,)."""
        mean = argument_checks.finite_vector("pose", pose, 3)
        std = argument_checks.standard_deviations("pose_std", pose_std, 3)
        self._slots = {}
        self._start(mean, np.maximum(std, START_FLOOR))

    def predict(self, odometry: ArrayLike, dt: float = 1.0) -> None:
        """Move by odometry (d, α) [m, rad]; dt multiplies the noise variance."""
        moved = self._noise.motion.moved(odometry)
        self._move(np.array(moved), self._noise.over(moved, dt))

    def update(
        self, measurements: ArrayLike, landmark_ids: LandmarkIds | None = None
    ) -> UpdateReport:
        """Take in one scan, rows (bearing, range) [rad, m], all seen at once.

        Raises
        ------
        ValueError
            If the arguments are malformed; the belief is then as before.
        """
        readings = argument_checks.scan(measurements)
        ids = argument_checks.identities(landmark_ids, len(readings), self)
        argument_checks.refuse_unusable(readings, ids)
        slots = np.array([self._slots.get(i, -1) for i in ids], dtype=np.int64)
        mapped, ranges = slots >= 0, readings[:, 1].copy()
        ranges[mapped] = self._expected_ranges(slots[mapped])
        usable = np.minimum(readings[:, 1], ranges) >= self._min_range
        known, new = np.flatnonzero(mapped & usable), np.flatnonzero(~mapped & usable)
        slots[new] = len(self._slots) + np.arange(len(new))
        stds = self._sensor.stds(self._std, np.maximum(ranges, self._min_range))
        variances = stds**2
        innovation = self._take_in(
            Readings(readings[known], slots[known], variances[known]),
            Readings(readings[new], slots[new], variances[new]),
        )
        self._slots |= {ids[row]: int(slots[row]) for row in new}
        return _report(innovation).replace(
            associated_ids=tuple(ids[row] for row in known),
            added_ids=tuple(ids[row] for row in new),
            skipped_ids=tuple(ids[row] for row in np.flatnonzero(~usable)),
        )

    def belief(self) -> Belief:
        """Return the present belief, of the additive error."""
        return Belief(*self._moments(), self.landmark_ids)

    @abstractmethod
    def state_dict(self) -> dict[str, Any]:
        """Return everything that :meth:`load_state_dict` needs, as arrays."""

    @abstractmethod
    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a saved state, bit for bit."""

    @abstractmethod
    def _start(self, pose: Array, std: Array) -> None:
        """Begin at a pose (3,) with deviations (3,), the map empty."""

    @abstractmethod
    def _move(self, odometry: Array, variance: Array) -> None:
        """Move by (dx, dy, α) in the robot's frame, with the noise's variances (3,)."""

    @abstractmethod
    def _take_in(self, known: Readings, new: Readings) -> Innovation | None:
        """Take in readings of mapped and of new landmarks, and map the latter."""

    @abstractmethod
    def _mean(self) -> Array:
        """Return the mean (3 + 2n,), between predict and update the prior's."""

    @abstractmethod
    def _moments(self) -> tuple[Array, Array]:
        """Return mean (3 + 2n,) and covariance (3 + 2n, 3 + 2n)."""

    def _expected_ranges(self, slots: IntArray) -> Array:
        mean = self._mean()
        offsets = mean[3:].reshape(-1, 2)[slots] - mean[:2]
        return np.asarray(np.linalg.norm(offsets, axis=1))

    def __repr__(self) -> str:
        return f"{type(self).__name__} with {len(self._slots)} landmarks"


def _report(innovation: Innovation | None) -> UpdateReport:
    if innovation is None or not innovation.values.size:
        return UpdateReport()
    factor = np.asarray(np.linalg.cholesky(innovation.covariance))
    white = np.linalg.solve(factor, innovation.values.ravel())
    return UpdateReport(
        nis=float(white @ white),
        degrees_of_freedom=white.size,
        innovation=innovation.values,
        factor=factor,
    )


def moved_state(mean: Array, odometry: Array) -> tuple[Array, Array]:
    """Return g(x, u) of the whole state (n,), and G (n, n)."""
    pose, of_pose, _ = predict_pose(mean[:3], odometry)
    G = np.eye(len(mean))
    G[:3, :3] = of_pose
    return np.concatenate([pose, mean[3:]]), G


def motion_covariance(mean: Array, variance: Array) -> Array:
    """Return F R Fᵀ over the whole state, (n, n), for variances (3,) of the noise."""
    F = predict_pose(mean[:3], np.zeros(2)).jacobian_noise
    Q = np.zeros((len(mean), len(mean)))
    Q[:3, :3] = (F * variance) @ F.T
    return Q


def wrapped(difference: Array) -> Array:
    """Return a difference of readings β1, r1, β2, …, its bearings in [-π, π)."""
    result = np.array(difference, dtype=np.float64)
    result[0::2] = wrap_angle(result[0::2])
    return result


def expected_readings(mean: Array, slots: IntArray) -> tuple[Array, Array]:
    """Return the readings h (m, 2) expected at a mean (n,), and H (2m, n)."""
    landmarks = mean[3:].reshape(-1, 2)[slots]
    expected, of_pose, of_landmark = predict_measurement(mean[:3], landmarks)
    H = np.zeros((len(slots), 2, len(mean)))
    H[:, :, :3] = of_pose
    for axis in (0, 1):
        columns = 3 + 2 * slots + axis
        H[np.arange(len(slots)), :, columns] = of_landmark[:, :, axis]
    return expected, H.reshape(2 * len(slots), -1)
