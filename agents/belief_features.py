"""Beliefs as an agent observes them: egocentric, of fixed size, within finite bounds.

Symbols
-------
p = (x, y, θ)   mean of the pose; R = R(θ) turns the robot's frame into the world's
l               mean of a landmark; ρ = Rᵀ (l - p) the same in the robot's frame [m]
P               covariance of the additive error of the state
"""

import math
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from ..envs.planned_path import planned_path
from ..estimator.batch import BatchMarginals
from ..sim_configs import Scenario, place_landmarks

Array = NDArray[np.float64]
Bounds = tuple[float, float, float, float]

SMALLEST_STD, LARGEST_STD = 1e-3, 10.0
"""Standard deviations [m, rad] that `on_log_scale` maps to 0 and to 1."""


def belief_space(rows: int) -> spaces.Dict:
    """Bound the features of a belief with N rows; the keys of `belief_features`.

    Examples
    --------
    >>> list(belief_space(6))[:3]
    ['belief_landmark_correlation', 'belief_landmark_map_std', 'belief_landmark_std']
    """
    shapes = {
        "belief_landmark_correlation": (-1.0, (rows,)),
        "belief_landmark_map_std": (0.0, (rows,)),
        "belief_landmark_std": (0.0, (rows, 2)),
        "belief_landmarks": (-1.0, (rows, 2)),
        "belief_pose": (-1.0, (4,)),
        "belief_pose_correlation": (-1.0, (3,)),
        "belief_pose_std": (0.0, (3,)),
    }
    boxes: dict[str, spaces.Space[NDArray[np.float64]]] = {
        key: spaces.Box(low, 1.0, shape, dtype=np.float64)
        for key, (low, shape) in shapes.items()
    }
    yes_or_no: Any = np.bool_
    mask = spaces.Box(0, 1, (rows,), dtype=yes_or_no)
    return spaces.Dict({**boxes, "belief_mask": mask})


def world_bounds(scenario: Scenario) -> Bounds:
    """Find the rectangle of a world: around its walls, if it has any.

    Without walls, around the start, the planned path and where landmarks may stand.

    Returns
    -------
    (xmin, ymin, xmax, ymax)
        Of sides > 0 [m].

    Examples
    --------
    >>> from slamgym.sim_configs import load_scenario
    >>> world_bounds(load_scenario("corridor"))
    (-1.2, -1.2, 13.2, 13.2)
    """
    if scenario.walls:
        points = np.reshape(scenario.walls, (-1, 2))
    else:
        layout = scenario.landmarks
        if layout.layout == "random":
            places = np.reshape(layout.bounds, (2, 2))
        else:
            places = place_landmarks(layout, np.random.default_rng(0))
        points = np.concatenate([planned_path(scenario)[:, :2], places])
    low, high = points.min(axis=0), points.max(axis=0)
    flat = high - low < 1.0
    left, bottom = np.where(flat, low - 1.0, low).tolist()
    right, top = np.where(flat, high + 1.0, high).tolist()
    return left, bottom, right, top


def belief_features(
    beliefs: BatchMarginals, bounds: Bounds
) -> dict[str, NDArray[np.generic]]:
    """Turn beliefs into observations.

    Parameters
    ----------
    beliefs : BatchMarginals
        Of B worlds.
    bounds : (xmin, ymin, xmax, ymax)
        Rectangle that the coordinates are scaled by [m]: its middle is 0, the middle
        of its sides ±1. What is outside is clipped.

    Returns
    -------
    dict of ndarray
        =============================== ========= ===================================
        ``belief_pose``                 (B, 4)    x, y scaled; cos θ, sin θ
        ``belief_pose_std``             (B, 3)    σ ahead, aside, of the heading
        ``belief_pose_correlation``     (B, 3)    (ahead, aside), (ahead, θ),
                                                  (aside, θ)
        ``belief_landmarks``            (B, N, 2) ρ, divided by the diagonal
        ``belief_landmark_std``         (B, N, 2) σ of ρ, ahead and aside
        ``belief_landmark_correlation`` (B, N)    of ρ, ahead with aside
        ``belief_landmark_map_std``     (B, N)    worst σ of l in the map's frame
        ``belief_mask``                 (B, N)    which landmarks are mapped
        =============================== ========= ===================================

        Standard deviations are `on_log_scale`; what is not mapped is 0.
    """
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


def on_log_scale(std: Array) -> Array:
    """Map standard deviations to [0, 1], four decades evenly.

    ::

        0 at 1 mm (or mrad) and below, 1 at 10 m and above

    Examples
    --------
    >>> on_log_scale(np.array([0.0, 0.01, 0.1, 50.0])).round(12).tolist()
    [0.0, 0.25, 0.5, 1.0]
    """
    decades = math.log10(LARGEST_STD / SMALLEST_STD)
    bounded = np.clip(std, SMALLEST_STD, LARGEST_STD)
    # the ends by hand: a rounded logarithm could leave the interval
    return np.clip(np.log10(bounded / SMALLEST_STD) / decades, 0.0, 1.0)


def relative_landmarks(beliefs: BatchMarginals) -> Array:
    """Compute ρ = Rᵀ (l - p), shape (B, N, 2) [m], zeros where not mapped."""
    dx, dy, cos, sin = _offsets(beliefs)
    rho = np.stack([cos * dx + sin * dy, cos * dy - sin * dx], axis=-1)
    return rho * beliefs.mapped[..., None]


def relative_spreads(beliefs: BatchMarginals) -> tuple[Array, Array, Array]:
    """Compute the covariance of ρ to first order.

    ::

        e_ρ = Rᵀ (e_l - e_p - e_θ J (l - p)),    J = [0 -1; 1 0]

    so that a landmark is better known relative to the robot than in the map, wherever
    the errors of pose and landmark are correlated.

    Returns
    -------
    aa, ab, bb : ndarray, each of shape (B, N)
        Variance ahead, covariance, variance aside [m²]; zeros where not mapped.
    """
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


def largest_variances(xx: Array, xy: Array, yy: Array) -> Array:
    """Compute the larger eigenvalues of [xx xy; xy yy]: variances in worst directions.

    Examples
    --------
    >>> float(largest_variances(np.array(2.0), np.array(1.0), np.array(2.0)))
    3.0
    """
    return np.asarray(0.5 * (xx + yy) + np.hypot(0.5 * (xx - yy), xy))


def _offsets(beliefs: BatchMarginals) -> tuple[Array, Array, Array, Array]:
    """Give l - p, each coordinate (B, N), and cos θ, sin θ (B, 1)."""
    poses, landmarks = beliefs.poses, beliefs.landmarks
    dx, dy = landmarks[..., 0] - poses[:, :1], landmarks[..., 1] - poses[:, 1:2]
    return dx, dy, np.cos(poses[:, 2:]), np.sin(poses[:, 2:])


def _pose_spread(covariances: Array, cos: Array, sin: Array) -> tuple[Array, Array]:
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


def _scaled(points: Array, bounds: Bounds) -> Array:
    low, high = np.array(bounds[:2]), np.array(bounds[2:])
    scaled = (2 * points - low - high) / (high - low)
    return np.asarray(np.clip(scaled, -1.0, 1.0))


def _correlation(covariance: Array, product: Array) -> Array:
    """Divide where there is something to divide by; 0 elsewhere."""
    known = product > 0
    ratio = covariance / np.where(known, product, 1.0)
    return np.clip(np.where(known, ratio, 0.0), -1.0, 1.0)
