"""An exactly consistent Kalman filter, many runs at once: three numbers, one read."""

import numpy as np

F = np.array([[1.0, 1.0, 0.5], [0.0, 1.0, 1.0], [0.0, 0.0, 1.0]])
Q = np.diag([0.5, 0.5, 0.5])
H = np.array([[1.0, 0.0, 0.0]])
R = 0.25


def kalman_scores(rng, runs, steps, claimed=1.0):
    """NEES and NIS, each (runs, steps); claimed covariances are off by a factor."""
    P, x, mean = np.eye(3), rng.standard_normal((runs, 3)), np.zeros((runs, 3))
    nees, nis = np.empty((runs, steps)), np.empty((runs, steps))
    for k in range(steps):
        x = x @ F.T + rng.standard_normal((runs, 3)) * np.sqrt(np.diag(Q))
        mean, P = mean @ F.T, F @ P @ F.T + Q
        S = P[0, 0] + R
        gain = P[:, 0] / S
        innovation = x[:, 0] + np.sqrt(R) * rng.standard_normal(runs) - mean[:, 0]
        nis[:, k] = innovation**2 / S * claimed
        mean = mean + innovation[:, None] * gain
        P = P - np.outer(gain, gain) * S
        error = x - mean
        nees[:, k] = (error @ np.linalg.inv(P) * error).sum(axis=1) * claimed
    return nees, nis
