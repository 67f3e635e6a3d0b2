"""What the adapters share: settings, arguments, and the report of an update."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ...arrays import Array, IntArray
from ..association.scan_assignments import Noise
from ..filters.ekf import MotionNoise
from ..interface import Belief, UpdateReport
from ..support import argument_checks
from ..support.argument_checks import LandmarkIds

START_FLOOR = 1e-6
"""Least deviation of the first pose [m, rad]: the libraries take no certain one."""


class Readings(NamedTuple):
    """Readings of one scan, with their variances."""

    measurements: Array
    """Rows (β, r), shape (m, 2) [rad, m]."""
    slots: IntArray
    """Place of each landmark in the map, shape (m,)."""
    variances: Array
    """(σβ², σr²), shape (m, 2)."""


class Innovation(NamedTuple):
    """Innovations of a scan at the prior."""

    values: Array
    """ν, shape (m, 2), rows (bearing, range) [rad, m]."""
    covariance: Array
    """S, shape (2m, 2m), in the order β1, r1, β2, r2."""


class PeerSlam(ABC):
    """An estimator of another library, fed step by step.

    Parameters
    ----------
    motion_std, measurement_std, initial_pose, initial_pose_std
        As in :func:`~slamgym.estimator.make_estimator`; a first pose that is certain
        has the deviation `START_FLOOR`.
    range_std_per_metre, noise_at_rest, min_range
        As in :class:`~slamgym.estimator.EkfSlam`; the range that counts is the one
        that the estimate expects.

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
        initial_pose: ArrayLike = (0.0, 0.0, 0.0),
        initial_pose_std: ArrayLike = (0.0, 0.0, 0.0),
        range_std_per_metre: float = 0.0,
        noise_at_rest: bool = True,
        min_range: float = 1e-3,
    ) -> None:
        self._noise = MotionNoise.checked(motion_std, noise_at_rest)
        std = argument_checks.standard_deviations("measurement_std", measurement_std, 2)
        growth = argument_checks.range_growth(range_std_per_metre)
        self._sensor = Noise(float(std[0]), float(std[1]), growth)
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
        """Move by odometry (d, α) [m, rad], its motion noise counted √dt times."""
        distance, turn = argument_checks.pair("odometry", odometry)
        variance = self._noise.over(distance, turn, dt)
        self._move(np.array([distance, turn]), variance)

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
        ids = argument_checks.given_identities(landmark_ids, len(readings), self)
        argument_checks.refuse_unusable(readings, ids)
        slots = np.array([self._slots.get(i, -1) for i in ids], dtype=np.int64)
        mapped, ranges = slots >= 0, readings[:, 1].copy()
        ranges[mapped] = self._expected_ranges(slots[mapped])
        usable = np.minimum(readings[:, 1], ranges) >= self._min_range
        known, new = np.flatnonzero(mapped & usable), np.flatnonzero(~mapped & usable)
        slots[new] = len(self._slots) + np.arange(len(new))
        variances = self._sensor.variances(ranges)
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
        """Move by (d, α), with the variances (3,) of the noise in the robot's frame."""

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
