"""Made-up runs, for tests of figures: numbers of the right kind, from no filter."""

import numpy as np

from slamgym.experiments.run_and_replay.trace import RunTrace


def covariances(rng, count, size, scale):
    factors = rng.normal(size=(count, size, size)) * scale
    return factors @ factors.transpose(0, 2, 1) / size


def make_trace(steps=12, count=6, seed=0, **changes):
    """Drive along an arc; landmark i enters the map at step i % 3 and shrinks."""
    rng = np.random.default_rng(seed)
    t = 0.5 * np.arange(steps + 1)
    heading = np.linspace(0, 4.0, steps + 1)
    true_poses = np.stack([8 * np.sin(heading), 8 - 8 * np.cos(heading), heading], 1)
    poses = true_poses + rng.normal(size=(steps + 1, 3)) * [0.2, 0.2, 0.02]
    true_landmarks = rng.uniform(-10, 20, size=(count, 2))
    first = covariances(rng, count, 2, 1.2)
    ids = 10 + np.arange(count)
    history = []
    for k in range(steps + 1):
        seen = np.arange(count) % 3 <= k
        shrink = 1 / (1 + max(k - 2, 0))
        means = true_landmarks[seen] + 0.5 * shrink
        history.append((ids[seen], means, shrink * first[seen]))
    final = covariances(rng, 1, 3 + 2 * count, 0.5)[0]
    for i in range(count):
        rows = slice(3 + 2 * i, 5 + 2 * i)
        final[rows, rows] = history[-1][2][i] + 0.3 * np.eye(2)
    at_first = 3 + 2 * len(history[0][0])
    fields = {
        "estimator": "ekf",
        "t": t,
        "predicted_poses": poses + 0.1,
        "predicted_pose_covariances": covariances(rng, steps + 1, 3, 0.5),
        "poses": poses,
        "pose_covariances": covariances(rng, steps + 1, 3, 0.3),
        "true_poses": true_poses,
        "nis": rng.chisquare(6, size=steps + 1),
        "nis_dof": np.where(np.arange(steps + 1) == 0, 0, 6),
        "landmark_ids": ids,
        "landmarks": history[-1][1],
        "first_landmarks": true_landmarks + 0.5,
        "first_landmark_covariances": first,
        "landmark_history": tuple(history),
        "true_landmarks": true_landmarks,
        "first_covariance": covariances(rng, 1, at_first, 0.5)[0],
        "final_covariance": final,
    }
    return RunTrace(**{**fields, **changes})
