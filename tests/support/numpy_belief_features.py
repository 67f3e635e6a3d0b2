"""The features of beliefs once more, in numpy: the slow twin of the compiled pass."""

import math
from typing import NamedTuple

import numpy as np


class BeliefMarginals(NamedTuple):
    """What B beliefs say of the pose and of each of L landmarks, one by one."""

    poses: np.ndarray
    """Shape (B, 3)."""
    pose_covariances: np.ndarray
    """Shape (B, 3, 3)."""
    landmarks: np.ndarray
    """Shape (B, L, 2), zeros where not mapped."""
    spreads: np.ndarray
    """Shape (9, B, L), zeros where not mapped: the covariances xx, xy, yy of a landmark
    (lx, ly), and of lx and of ly with the pose: lx x, lx y, lx θ, ly x, ly y, ly θ."""
    mapped: np.ndarray
    """Which landmarks are in the map, shape (B, L)."""


def marginals_of(beliefs):
    """Take what is believed of the poses and of each landmark by itself.

    The beliefs are those of a batch, `BatchSlam.beliefs()`, or of an agent's worlds.
    """
    mapped, means, cov = beliefs.mapped, beliefs.means, beliefs.covariances
    x = 3 + 2 * np.arange(mapped.shape[1])
    own = [cov[:, x, x], cov[:, x, x + 1], cov[:, x + 1, x + 1]]
    with_pose = [cov[:, x + axis, of] for axis in (0, 1) for of in range(3)]
    return BeliefMarginals(
        means[:, :3],
        cov[:, :3, :3],
        means[:, 3:].reshape(*mapped.shape, 2),
        np.stack(own + with_pose),
        mapped,
    )


def belief_features(beliefs, bounds):
    """Compute what `belief_features` of the package does."""
    poses, mapped = beliefs.poses, beliefs.mapped
    cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    std, correlation = _pose_spread(beliefs.pose_covariances, cos, sin)
    relative = relative_landmarks(beliefs)
    aa, ab, bb = relative_spreads(beliefs)
    near = np.sqrt(np.maximum(np.stack([aa, bb], axis=-1), 0.0))
    worst = np.sqrt(largest_variances(*beliefs.spreads[:3]))
    diagonal = math.hypot(bounds[2] - bounds[0], bounds[3] - bounds[1])
    scaled = _scaled(poses[:, :2], bounds)
    return {
        "belief_landmark_correlation": _correlation(ab, near[..., 0] * near[..., 1]),
        "belief_landmark_map_std": on_log_scale(worst),
        "belief_landmark_std": on_log_scale(near),
        "belief_landmarks": np.clip(relative / diagonal, -1.0, 1.0),
        "belief_mask": mapped.copy(),
        "belief_pose": np.concatenate([scaled, cos[:, None], sin[:, None]], axis=1),
        "belief_pose_correlation": correlation,
        "belief_pose_std": on_log_scale(std),
    }


def on_log_scale(std):
    """Map 1 mm to 10 m onto [0, 1]."""
    bounded = np.clip(std, 1e-3, 10.0)
    return np.clip(np.log10(bounded / 1e-3) / 4, 0.0, 1.0)


def relative_landmarks(beliefs):
    """Compute ρ, (B, N, 2)."""
    dx, dy, cos, sin = _offsets(beliefs)
    rho = np.stack([cos * dx + sin * dy, cos * dy - sin * dx], axis=-1)
    return rho * beliefs.mapped[..., None]


def relative_spreads(beliefs):
    """Compute the covariance of ρ: ahead, both, aside."""
    xx, xy, yy, x_px, x_py, x_h, y_px, y_py, y_h = beliefs.spreads
    pose = beliefs.pose_covariances[:, :, :, None]
    dx, dy, cos, sin = _offsets(beliefs)
    to_x, to_y = x_h - pose[:, 0, 2], y_h - pose[:, 1, 2]  # of e_l - e_p with e_θ
    turn = pose[:, 2, 2]
    a = xx + pose[:, 0, 0] - 2 * x_px + 2 * to_x * dy + turn * dy * dy
    b = xy + pose[:, 0, 1] - x_py - y_px - to_x * dx + to_y * dy - turn * dx * dy
    c = yy + pose[:, 1, 1] - 2 * y_py - 2 * to_y * dx + turn * dx * dx
    across = 2 * cos * sin * b
    ahead = cos * cos * a + across + sin * sin * c
    aside = sin * sin * a - across + cos * cos * c
    both = cos * sin * (c - a) + (cos * cos - sin * sin) * b
    mapped = beliefs.mapped
    return ahead * mapped, both * mapped, aside * mapped


def largest_variances(xx, xy, yy):
    """Compute the larger eigenvalues of [xx xy; xy yy]."""
    return 0.5 * (xx + yy) + np.hypot(0.5 * (xx - yy), xy)


def _offsets(beliefs):
    """Give l - p, each coordinate (B, N), and cos θ, sin θ (B, 1)."""
    poses, landmarks = beliefs.poses, beliefs.landmarks
    dx, dy = landmarks[..., 0] - poses[:, :1], landmarks[..., 1] - poses[:, 1:2]
    return dx, dy, np.cos(poses[:, 2:]), np.sin(poses[:, 2:])


def _pose_spread(covariances, cos, sin):
    """Give σ (ahead, aside, θ) and correlations of the pose in the robot's frame."""
    xx, xy, yy = covariances[:, 0, 0], covariances[:, 0, 1], covariances[:, 1, 1]
    x_h, y_h = covariances[:, 0, 2], covariances[:, 1, 2]
    across = 2 * cos * sin * xy
    variances = [
        cos * cos * xx + across + sin * sin * yy,
        sin * sin * xx - across + cos * cos * yy,
        covariances[:, 2, 2],
    ]
    pairs = [
        cos * sin * (yy - xx) + (cos * cos - sin * sin) * xy,
        cos * x_h + sin * y_h,
        cos * y_h - sin * x_h,
    ]
    std = np.sqrt(np.maximum(np.stack(variances, axis=1), 0.0))
    product = std[:, [0, 0, 1]] * std[:, [1, 2, 2]]
    return std, _correlation(np.stack(pairs, axis=1), product)


def _scaled(points, bounds):
    low, high = np.array(bounds[:2]), np.array(bounds[2:])
    scaled = (2 * points - low - high) / (high - low)
    return np.asarray(np.clip(scaled, -1.0, 1.0))


def _correlation(covariance, product):
    """Divide where there is something to divide by; 0 elsewhere."""
    known = product > 0
    ratio = covariance / np.where(known, product, 1.0)
    return np.clip(np.where(known, ratio, 0.0), -1.0, 1.0)
