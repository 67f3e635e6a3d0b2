"""Beliefs as observations of an agent: egocentric, of fixed size, bounded.

Symbols
-------
p = (x, y, θ)   mean of the pose; R = R(θ) rotates from the robot's to the world frame
l               mean of a landmark; ρ = Rᵀ (l - p) in the robot's frame [m]
P               covariance of the additive error of the state

The error of ρ is, to first order::

    e_ρ = Rᵀ (e_l - e_p - e_θ J (l - p)),    J = [0 -1; 1 0]

If the errors of pose and landmark are correlated, the landmark is better known relative
to the robot than in the map.
"""

from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike

from ..arrays import AnyArray, Array
from ..envs.controllers import planned_path
from ..estimator.filters.batch import BatchStorage
from ..sim_configs import Scenario
from ..sim_configs.layouts import possible_positions
from .belief_kernels import write_features

Bounds = tuple[float, float, float, float]


def belief_space(rows: int) -> spaces.Dict:
    """Return the space of `belief_features` with N landmark rows.

    Examples
    --------
    >>> list(belief_space(6))[:3]
    ['belief_landmark_correlation', 'belief_landmark_map_std', 'belief_landmark_std']
    """
    boxes: dict[str, spaces.Space[Array]] = {
        key: spaces.Box(low, 1.0, shape, dtype=np.float64)
        for key, (low, shape) in _ranges_and_shapes(rows).items()
    }
    yes_or_no: Any = np.bool_
    boxes["belief_mask"] = spaces.Box(0, 1, (rows,), dtype=yes_or_no)
    return spaces.Dict(boxes)


def _ranges_and_shapes(rows: int) -> dict[str, tuple[float, tuple[int, ...]]]:
    """Return the lower bound and the shape of every feature, in alphabetical order."""
    return {
        "belief_landmark_correlation": (-1.0, (rows,)),
        "belief_landmark_map_std": (0.0, (rows,)),
        "belief_landmark_std": (0.0, (rows, 2)),
        "belief_landmarks": (-1.0, (rows, 2)),
        "belief_mask": (0.0, (rows,)),
        "belief_pose": (-1.0, (4,)),
        "belief_pose_correlation": (-1.0, (3,)),
        "belief_pose_std": (0.0, (3,)),
    }


def world_bounds(scenario: Scenario) -> Bounds:
    """Return the rectangle around the walls of a world.

    Without walls it contains the planned path and all possible landmark positions.

    Returns
    -------
    (xmin, ymin, xmax, ymax)
        Both sides are positive [m].

    Examples
    --------
    >>> from slamgym.sim_configs import load_scenario
    >>> world_bounds(load_scenario("corridor"))
    (-1.2, -1.2, 13.2, 13.2)
    """
    if scenario.walls:
        points = np.reshape(scenario.walls, (-1, 2))
    else:
        points = np.concatenate(
            [planned_path(scenario)[:, :2], possible_positions(scenario.landmarks)]
        )
    low, high = points.min(axis=0), points.max(axis=0)
    flat = high - low < 1.0
    left, bottom = np.where(flat, low - 1.0, low).tolist()
    right, top = np.where(flat, high + 1.0, high).tolist()
    return left, bottom, right, top


def belief_features(beliefs: BatchStorage, bounds: Bounds) -> dict[str, AnyArray]:
    """Convert beliefs to observations.

    The result for a world does not depend on the other worlds or on the order in which
    the landmarks are stored, to the bit.

    Parameters
    ----------
    beliefs : BatchStorage
        Of B worlds.
    bounds : (xmin, ymin, xmax, ymax)
        Rectangle that scales the coordinates [m]: its centre maps to 0, the centres of
        its sides to ±1. Values outside are clipped.

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

        Standard deviations are `on_log_scale`; rows that are not mapped are 0.
    """
    features = empty_features(*beliefs.slots.shape)
    rows: Any = tuple(features.values())
    write_features(*beliefs, bounds, rows)
    return features


def empty_features(worlds: int, rows: int) -> dict[str, AnyArray]:
    """Return arrays for the features of B beliefs over N landmarks, not yet filled."""
    return {
        key: np.empty((worlds, *shape), np.bool_ if key == "belief_mask" else float)
        for key, (_, shape) in _ranges_and_shapes(rows).items()
    }


def largest_variances(covariances: ArrayLike) -> Array:
    """Compute the larger eigenvalues of covariances, (…, 2, 2) to (…).

    Examples
    --------
    >>> float(largest_variances([[2.0, 1.0], [1.0, 2.0]]))
    3.0
    """
    P = np.asarray(covariances)
    xx, xy, yy = P[..., 0, 0], P[..., 0, 1], P[..., 1, 1]
    return np.asarray(0.5 * (xx + yy) + np.hypot(0.5 * (xx - yy), xy))
