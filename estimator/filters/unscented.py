"""Unscented EKF-SLAM: cubature points instead of Jacobians."""

from __future__ import annotations

from itertools import compress

import numpy as np
from numpy.typing import ArrayLike

from ...arrays import Array, BoolArray, IntArray
from ..interface import UpdateReport
from ..kernels.kalman_gain import BeliefArrays
from ..models.bearing_range import read_distance_jit
from ..models.rigid_motion import composed
from ..models.sensors import Sensor, for_sensor
from ..support import argument_checks
from ..support.argument_checks import LandmarkIds
from ..support.undo import undone_on_error
from .ekf import EkfSlam, reading_variances
from .gaussian_map import FIRST_LANDMARKS


class UnscentedSlam(EkfSlam):
    """Unscented filter with cubature points and wrapped angles; dense, O(n³) per step.

    The models transform the 2N points mean ± √N Lᵢ, L Lᵀ = P, each of weight 1/2N [1]_
    [2]_.  To predict, the state is extended by the motion noise.  New landmarks are
    initialised by linearisation, as in ``ekf``.  The filter needs no Jacobians, but is
    as overconfident about its heading as the EKF: use it for comparison only.

    Parameters are those of :class:`EkfSlam`.

    References
    ----------
    .. [1] S. Julier, J. Uhlmann, A new extension of the Kalman filter to nonlinear
       systems, SPIE AeroSense, 1997.
    .. [2] I. Arasaratnam, S. Haykin, Cubature Kalman filters, IEEE TAC 54(6), 2009.
    """

    _report = UpdateReport()

    def predict(self, odometry: ArrayLike, dt: float = 1.0) -> None:
        """Move by odometry (d, α) [m, rad], through the cubature points."""
        forward, sideways, turn = moved = self.motion.moved(odometry)
        variance = self._motion_noise.over(moved, dt)
        mean, P, reference = (array.copy() for array in self.map.used)
        n = len(mean)
        root = np.zeros((n + 3, n + 3))
        root[:n, :n] = _square_root(P)
        root[n:, n:] = np.diag(np.sqrt(variance))
        deviations = np.sqrt(n + 3) * np.concatenate([root, -root], axis=1)
        x, y, heading = mean[:3, None] + deviations[:3]
        along, across, turned = deviations[n:]
        moves = forward + along, sideways + across, turn
        x, y, heading, _, _ = composed(x, y, heading, *moves)
        poses = np.stack([x, y, heading + turned])
        mean[:3] = poses.mean(axis=1)
        spread = poses - mean[:3, None]
        share = deviations.shape[1]
        P[:3, :3] = spread @ spread.T / share
        P[:3, 3:] = spread @ deviations[3:n].T / share
        P[3:, :3] = P[:3, 3:].T
        self.map.hold(BeliefArrays(mean, P, reference), self.map.slots, steps=1)

    def update(
        self, measurements: ArrayLike, landmark_ids: LandmarkIds | None = None
    ) -> UpdateReport:
        """Correct the belief with one scan, then add its new landmarks to the map."""
        readings = argument_checks.scan(measurements, self.sensor.columns)
        ids = argument_checks.given_identities(landmark_ids, len(readings), self)
        argument_checks.refuse_unusable(readings, ids)
        slots, least = self.map.slots, self.rules.min_range
        mapped = np.array([i in slots for i in ids], dtype=bool)
        usable = self._read_distances(readings) >= least
        expected, near = self._expected_ranges(
            [slots[i] for i in compress(ids, mapped)]
        )
        usable[mapped] &= expected >= least
        known, skipped = mapped & usable, mapped & ~usable
        corrected, others = UpdateReport(), list(compress(ids, ~mapped))
        needed = max(FIRST_LANDMARKS, len(slots) + len(others))
        with undone_on_error(self.bookmark()):  # what follows changes a copy
            block = self.map.blank(needed, readings=len(others))
            self.map.hold(self.map.used, slots, block=block)
            if known.any():
                near = near[usable[mapped]]
                corrected = self._correct(
                    readings[known], [*compress(ids, known)], near
                )
            added = super().update(readings[~mapped], others)
            self._report = corrected.replace(
                added_ids=added.added_ids,
                skipped_ids=(*compress(ids, skipped), *added.skipped_ids),
            )
        return self._report

    def report(self) -> UpdateReport:
        """Return the report of the last update once more."""
        return self._report

    def _read_distances(self, readings: Array) -> Array:
        """Return the distances of landmarks by readings (m, 2) [m], inf if unknown."""
        read = for_sensor(read_distance_jit, self.sensor)
        return np.array([read(first, second) for first, second in readings])

    def _expected_ranges(self, slots: list[int]) -> tuple[Array, BoolArray]:
        """Return the expected ranges of landmarks (m,) [m], and which are near.

        Near are those within 10 σ of the robot.  σ is the largest standard deviation
        of the error e_l − e_p − J δ e_θ of the offset δ from the robot to a landmark.
        """
        own = np.zeros((len(slots), 5), dtype=np.int64)
        own[:, 1:] = 1, 2, 3, 4
        own[:, 3:] += 2 * np.array(slots, dtype=np.int64)[:, None]
        offsets = self.map.mean[own[:, 3:]] - self.map.mean[:2]
        H = np.zeros((len(slots), 2, 5))
        H[:, (0, 1), (0, 1)], H[:, (0, 1), (3, 4)] = -1.0, 1.0
        H[:, 0, 2], H[:, 1, 2] = offsets[:, 1], -offsets[:, 0]
        P = self.map.covariance[own[:, :, None], own[:, None]]
        largest = np.linalg.eigvalsh(H @ P @ H.transpose(0, 2, 1))[:, -1]
        expected = np.hypot(*offsets.T)
        return expected, expected < 10 * np.sqrt(np.maximum(largest, 0.0))

    def _correct(
        self, readings: Array, ids: list[int], near: BoolArray
    ) -> UpdateReport:
        n = self.map.size
        columns = 3 + 2 * np.array([self.map.slots[i] for i in ids])
        root = _square_root(self.map.covariance[:n, :n])
        deviations = np.sqrt(n) * np.concatenate([root, -root], axis=1)
        mean, sensor = self.map.mean[:n], self.sensor
        expected, spread, distances = _through_sensor(sensor, mean, deviations, columns)
        innovation = sensor.difference(readings, expected)
        if self.rules.noise_as_read:
            distances = self._read_distances(readings)
        noise = reading_variances(self.rules, distances, sensor)
        kept = self._within_gate(innovation, spread, noise)
        rows = np.repeat(kept, 2)
        spread, nu = spread[rows], innovation.ravel()[rows]
        S = spread @ spread.T / spread.shape[1] + np.diag(noise.ravel()[rows])
        factor = _factor(S, list(compress(ids, kept)))
        cross = spread @ deviations.T / spread.shape[1]
        gains = np.linalg.solve(factor, cross)
        white = np.linalg.solve(factor, nu)
        self.map.mean[:n] += gains.T @ white
        self.map.covariance[:n, :n] -= gains.T @ gains
        return UpdateReport(
            nis=float(white @ white),
            degrees_of_freedom=len(nu) * sensor.size // 2,
            associated_ids=tuple(compress(ids, kept)),
            rejected_ids=tuple(compress(ids, ~kept)),
            near_ids=tuple(compress(ids, kept & near)),
            innovation=innovation[kept],
            factor=factor,
        )

    def _within_gate(self, innovation: Array, spread: Array, noise: Array) -> BoolArray:
        if not np.isfinite(self.rules.gate):
            return np.ones(len(innovation), dtype=bool)
        pairs = spread.reshape(len(innovation), 2, -1)
        own = pairs @ pairs.transpose(0, 2, 1) / pairs.shape[2]
        own += noise[:, :, None] * np.eye(2)
        weighted = np.linalg.solve(own, innovation[..., None])[..., 0]
        return np.asarray((innovation * weighted).sum(axis=1) <= self.rules.gate)


def _through_sensor(
    sensor: Sensor, mean: Array, deviations: Array, columns: IntArray
) -> tuple[Array, Array, Array]:
    """Predict the readings of points (n, N): mean (m, 2) and deviations (2m, N).

    The mean distance of the landmarks, (m,), follows.
    """
    points = np.concatenate([mean[:, None], mean[:, None] + deviations], axis=1)
    dx, dy = points[columns] - points[0], points[columns + 1] - points[1]
    cos, sin = np.cos(points[2]), np.sin(points[2])
    read = sensor.read(cos * dx + sin * dy, cos * dy - sin * dx)
    apart = sensor.difference(read[:, 1:], read[:, :1])
    average = apart.mean(axis=1)
    spread = (apart - average[:, None]).transpose(0, 2, 1)
    distances = np.hypot(dx, dy)[:, 1:].mean(axis=1)
    return read[:, 0] + average, spread.reshape(2 * len(columns), -1), distances


def _factor(S: Array, ids: list[int]) -> Array:
    """Return the Cholesky factor of S; an error names the reading that spoils it."""
    try:
        return np.asarray(np.linalg.cholesky(S))
    except np.linalg.LinAlgError:
        smallest = [
            np.linalg.eigvalsh(S[: 2 * k, : 2 * k])[0] for k in range(1, len(ids))
        ]
        at = next((k for k, value in enumerate(smallest) if value <= 0), len(ids) - 1)
        raise argument_checks.not_positive_definite(ids[at]) from None


def _square_root(covariance: Array) -> Array:
    """Return the symmetric square root of a positive semidefinite matrix."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray((vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T)
