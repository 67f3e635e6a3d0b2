"""Kalman filters of other libraries: one Gaussian over the pose and a growing map.

The libraries predict and correct; none of them maps, so landmarks enter as in ``ekf``::

    l = f(x, z),    P_l* = F_p P_p*,    P_ll = F_p P_pp F_pᵀ + F_z Q F_zᵀ
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from slamgym.arrays import Array
from slamgym.estimator.guards import saved_states
from slamgym.estimator.models.bearing_range import locate_landmark
from slamgym.estimator.peers.peer_slam import Innovation, PeerSlam, Readings

# Spread of the points of both unscented filters, with κ = 3 − n: the defaults of Stone
# Soup.
SIGMA_ALPHA, SIGMA_BETA = 0.5, 2.0


class Moments(NamedTuple):
    """A Gaussian over pose and map."""

    mean: Array  # (3 + 2n,)
    covariance: Array  # (3 + 2n, 3 + 2n)


STATE: saved_states.Table = {
    "landmark_ids": (saved_states.IDS, "n"),
    "mean": (saved_states.NUMBERS, "3+2n"),
    "covariance": (saved_states.NUMBERS, "3+2n", "3+2n"),
}


class KalmanPeer(PeerSlam):
    """A Kalman filter of another library, its map grown by this adapter."""

    def _start(self, pose: Array, std: Array) -> None:
        self._state = Moments(pose, np.diag(std**2))

    def _move(self, odometry: Array, variance: Array) -> None:
        self._state = self._predicted(self._state, odometry, variance)

    def _take_in(self, known: Readings, new: Readings) -> Innovation | None:
        state, innovation = self._state, None
        if len(known.slots):
            state, innovation = self._corrected(state, known)
        if len(new.slots):
            state = _with_landmarks(state, new)
        self._state = state
        return innovation

    @abstractmethod
    def _predicted(self, state: Moments, odometry: Array, variance: Array) -> Moments:
        """Return the state moved by (d, α) with noise of these variances (3,)."""

    @abstractmethod
    def _corrected(self, state: Moments, scan: Readings) -> tuple[Moments, Innovation]:
        """Return the state after readings of mapped landmarks, and what was new."""

    def _mean(self) -> Array:
        return self._state.mean

    def _moments(self) -> tuple[Array, Array]:
        return self._state

    def state_dict(self) -> dict[str, Any]:
        """Return mean, covariance and the landmarks, as copies."""
        return {
            "estimator": type(self).__name__,
            "mean": self._state.mean.copy(),
            "covariance": self._state.covariance.copy(),
            "landmark_ids": np.array(self.landmark_ids, dtype=np.int64),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a saved state, bit for bit."""
        name = {"estimator": type(self).__name__}
        saved = saved_states.read(state, STATE, of=name)
        self._state = Moments(saved["mean"], saved["covariance"])
        self._slots = {i: slot for slot, i in enumerate(saved["landmark_ids"])}


def _with_landmarks(state: Moments, new: Readings) -> Moments:
    """Return the state with landmarks behind it, each correlated with the pose."""
    mean, P = state
    found = locate_landmark(mean[:3], new.measurements)
    n, m = len(mean), len(new.slots)
    of_pose = found.jacobian_pose.reshape(2 * m, 3)
    grown = np.empty((n + 2 * m, n + 2 * m))
    grown[:n, :n] = P
    grown[n:, :n] = of_pose @ P[:3]
    grown[:n, n:] = grown[n:, :n].T
    grown[n:, n:] = of_pose @ P[:3, :3] @ of_pose.T
    for k, of_reading in enumerate(found.jacobian_measurement):
        rows = slice(n + 2 * k, n + 2 * k + 2)
        grown[rows, rows] += (of_reading * new.variances[k]) @ of_reading.T
    return Moments(np.concatenate([mean, found.position.ravel()]), grown)
