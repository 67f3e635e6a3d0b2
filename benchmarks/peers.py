# pyright: reportMissingImports=false
"""The same EKF-SLAM step in other libraries: stacked numpy, filterpy, Stone Soup.

Each is made as fast as possible: with one vectorised h and one vectorised full H.
"""

from collections.abc import Callable
from datetime import datetime, timedelta
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Step = Callable[[], object]


def expected_and_jacobian(mean: Array, slots: NDArray[np.int64]) -> tuple[Array, Array]:
    """Return h (2m,) and the stacked H (2m, n) at a mean, vectorised."""
    m = len(slots)
    columns, rows = 3 + 2 * slots, np.arange(0, 2 * m, 2)
    dx, dy = mean[columns] - mean[0], mean[columns + 1] - mean[1]
    q = dx * dx + dy * dy
    r = np.sqrt(q)
    H = np.zeros((2 * m, len(mean)))
    H[rows, 0], H[rows, 1], H[rows, 2] = dy / q, -dx / q, -1.0
    H[rows + 1, 0], H[rows + 1, 1] = -dx / r, -dy / r
    H[rows, columns], H[rows, columns + 1] = -dy / q, dx / q
    H[rows + 1, columns], H[rows + 1, columns + 1] = dx / r, dy / r
    expected = np.empty(2 * m)
    expected[0::2] = np.arctan2(dy, dx) - mean[2]
    expected[1::2] = r
    return expected, H


def difference(z: Array, expected: Array) -> Array:
    """Innovation with the bearings wrapped."""
    nu = z - expected
    nu[0::2] = (nu[0::2] + np.pi) % (2 * np.pi) - np.pi
    return nu


def motion(mean: Array, odometry: Array) -> tuple[Array, Array, Array]:
    """Return the moved mean, G (n, n) and F (3, 3)."""
    d, turn = odometry
    c, s = np.cos(mean[2]), np.sin(mean[2])
    moved = mean.copy()
    moved[:3] += d * c, d * s, turn
    G = np.eye(len(mean))
    G[0, 2], G[1, 2] = -d * s, d * c
    return moved, G, np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])


class StackedDense:
    """The textbook form: H stacked reading by reading, K = P Hᵀ S⁻¹.

    P ← (I − K H) P, over the whole state.
    """

    def __init__(self, mean: Array, P: Array, R: Array, Q: Array) -> None:
        self.mean, self.P, self.R, self.Q = mean.copy(), P.copy(), R, Q

    def step(self, odometry: Array, z: Array, slots: NDArray[np.int64]) -> None:
        """Predict, then update with all readings at once."""
        self.mean, G, F = motion(self.mean, odometry)
        self.P = G @ self.P @ G.T
        self.P[:3, :3] += F @ self.R @ F.T
        m, n = len(slots), len(self.mean)
        H, expected = np.zeros((2 * m, n)), np.empty(2 * m)
        for k, slot in enumerate(slots):
            c = 3 + 2 * slot
            dx, dy = self.mean[c : c + 2] - self.mean[:2]
            q = dx**2 + dy**2
            r = np.sqrt(q)
            expected[2 * k : 2 * k + 2] = np.arctan2(dy, dx) - self.mean[2], r
            H[2 * k, :3] = dy / q, -dx / q, -1.0
            H[2 * k + 1, :3] = -dx / r, -dy / r, 0.0
            H[2 * k, c : c + 2] = -dy / q, dx / q
            H[2 * k + 1, c : c + 2] = dx / r, dy / r
        PHt = self.P @ H.T
        S = H @ PHt + np.diag(np.tile(self.Q, m))
        K = np.linalg.solve(S, PHt.T).T
        self.mean += K @ difference(z, expected)
        self.P = (np.eye(n) - K @ H) @ self.P


def filterpy_step(
    mean: Array, P: Array, noise: tuple[Array, Array], data: tuple[Array, Array, Any]
) -> Step:
    """Return a function that takes filterpy's ExtendedKalmanFilter one step."""
    from filterpy.kalman import ExtendedKalmanFilter  # noqa: PLC0415 (an optional peer)

    (R, Q), (odometry, z, slots) = noise, data
    peer = ExtendedKalmanFilter(dim_x=len(mean), dim_z=len(z))
    peer.x, peer.P = mean.copy(), P.copy()
    peer.R = np.diag(np.tile(Q, len(slots)))

    def step() -> None:
        moved, G, F = motion(peer.x, odometry)
        peer.F, peer.Q = G, np.zeros_like(P)
        peer.Q[:3, :3] = F @ R @ F.T
        peer.predict()
        peer.x = moved
        peer.update(
            z,
            lambda x: expected_and_jacobian(x, slots)[1],
            lambda x: expected_and_jacobian(x, slots)[0],
            residual=difference,
        )

    return step


def stonesoup_step(
    mean: Array, P: Array, noise: tuple[Array, Array], data: tuple[Array, Array, Any]
) -> Step:
    """Return a function that takes Stone Soup's EKF predictor and updater one step.

    Stone Soup has no SLAM model: it gets a transition and a measurement model over the
    whole state, with the Jacobians given.
    """
    from stonesoup.predictor.kalman import ExtendedKalmanPredictor  # noqa: PLC0415
    from stonesoup.types.array import CovarianceMatrix, StateVector  # noqa: PLC0415
    from stonesoup.types.detection import Detection  # noqa: PLC0415
    from stonesoup.types.hypothesis import SingleHypothesis  # noqa: PLC0415
    from stonesoup.types.state import GaussianState  # noqa: PLC0415
    from stonesoup.updater.kalman import ExtendedKalmanUpdater  # noqa: PLC0415

    moves, senses = _stonesoup_models(noise, data)
    predictor = ExtendedKalmanPredictor(moves)
    updater = ExtendedKalmanUpdater(senses)
    began = datetime(2026, 1, 1)
    now = began + timedelta(seconds=1)
    reading = Detection(StateVector(data[1]), timestamp=now)
    state = [GaussianState(StateVector(mean), CovarianceMatrix(P), timestamp=began)]

    def step() -> None:
        prior = predictor.predict(state[0], timestamp=now)
        state[0] = updater.update(SingleHypothesis(prior, reading))

    return step


def _stonesoup_models(  # noqa: C901 (Stone Soup takes models as classes)
    noise: tuple[Array, Array], data: tuple[Array, Array, Any]
) -> tuple[Any, Any]:
    from stonesoup.base import Property  # noqa: PLC0415
    from stonesoup.models.measurement.nonlinear import NonLinearGaussianMeasurement  # noqa: PLC0415
    from stonesoup.models.transition.nonlinear import GaussianTransitionModel  # noqa: PLC0415
    from stonesoup.types.array import StateVector  # noqa: PLC0415

    (R, Q), (odometry, z, slots) = noise, data

    def flat(state: Any) -> Array:
        return np.asarray(state.state_vector, dtype=float).ravel()

    class Moves(GaussianTransitionModel):  # type: ignore[misc]
        """The unicycle over the whole state."""

        size = Property(int)

        @property
        def ndim_state(self) -> int:
            return int(self.size)

        def function(self, state: Any, *_: Any, **__: Any) -> Any:
            return StateVector(motion(flat(state), odometry)[0])

        def jacobian(self, state: Any, **_: Any) -> Array:
            return motion(flat(state), odometry)[1]

        def covar(self, **_: Any) -> Array:
            full = np.zeros((self.size, self.size))
            full[:3, :3] = R
            return full

    class Senses(NonLinearGaussianMeasurement):  # type: ignore[misc]
        """Bearings and ranges of all landmarks in one vector."""

        @property
        def ndim_meas(self) -> int:
            return len(z)

        def function(self, state: Any, *_: Any, **__: Any) -> Any:
            return StateVector(expected_and_jacobian(flat(state), slots)[0])

        def jacobian(self, state: Any, **_: Any) -> Array:
            return expected_and_jacobian(flat(state), slots)[1]

        def rvs(self, *_: Any, **__: Any) -> Any:
            raise NotImplementedError

        def pdf(self, *_: Any, **__: Any) -> Any:
            raise NotImplementedError

    n = int(3 + 2 * (np.max(slots) + 1))
    return Moves(size=n), Senses(
        ndim_state=n,
        mapping=tuple(range(n)),
        noise_covar=np.diag(np.tile(Q, len(slots))),
    )
