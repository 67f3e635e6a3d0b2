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

import math
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike

from ..arrays import AnyArray, Array, BoolArray, IntArray
from ..envs.controllers import planned_path
from ..estimator.filters.batch import BatchStorage
from ..estimator.filters.ekf import EkfSlam
from ..estimator.kernels.sizes_of_covariances import largest_variance
from ..estimator.models.bearing_range import wrap_angle_jit
from ..jit import jit_in_place, njit_internal
from ..sim_configs import Scenario
from ..sim_configs.landmarks_and_controls import possible_positions
from .estimator_choice import BeliefOfMap

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
        Width and height are positive [m].

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


# --------------------------------------------------------------------------------------
# Beliefs in the storage of a batch of filters, for one world or many.


def belief_storage(belief: BeliefOfMap, size: int, *, by_id: bool) -> BatchStorage:
    """Store the belief of one world as a batch of filters does; B = 1.

    Parameters
    ----------
    belief : Belief
        Of any estimator.
    size : int
        N, the number of landmark rows.
    by_id : bool
        If True, row i is the landmark with identity i. Else the rows are in the order
        of the map, for estimators that assign their own identities.

    Raises
    ------
    ValueError
        If the map holds more landmarks than there are rows.

    Examples
    --------
    >>> from slamgym.estimator import EkfSlam
    >>> slam = EkfSlam((0.1, 0.1, 0.1), (0.1, 0.1))
    >>> _ = slam.update([(0.0, 2.0)], landmark_ids=[1])
    >>> storage = belief_storage(slam.belief(), size=3, by_id=True)
    >>> storage.slots.tolist(), storage.means[0, 3:5].tolist()
    ([[-1, 0, -1]], [2.0, 0.0])
    """
    ids = belief.landmark_ids
    rows = list(ids) if by_id else list(range(len(ids)))
    if rows and not (min(rows) >= 0 and max(rows) < size):
        what = f"identity {max(rows)}" if by_id else f"{len(rows)} landmarks"
        raise ValueError(
            f"max_landmarks must leave room for the whole map, got {size} rows for a "
            f"map with {what}"
        )
    capacity, used = 3 + 2 * size, 3 + 2 * len(rows)
    means, covariances = np.zeros((1, capacity)), np.zeros((1, capacity, capacity))
    slots = np.full((1, size), -1, dtype=np.int64)
    means[0, :3] = belief.pose
    means[0, 3:used] = np.ravel(belief.landmarks)
    covariances[0, :used, :used] = belief.covariance
    slots[0, rows] = np.arange(len(rows))
    return BatchStorage.of(means, covariances, slots)


def live_storage(estimator: EkfSlam, size: int) -> BatchStorage:
    """Return the arrays of a filter that can run in batches, without a copy; B = 1."""
    gaussian = estimator.map
    slots = np.full((1, size), -1, dtype=np.int64)
    for landmark, slot in gaussian.slots.items():
        slots[0, landmark] = slot
    return BatchStorage.of(gaussian.mean[None], gaussian.covariance[None], slots)


# --------------------------------------------------------------------------------------
# The kernels: one pass over all worlds.

# In the alphabetical order of their keys, see `belief_features`.
FeatureArrays = tuple[Array, Array, Array, Array, BoolArray, Array, Array, Array]

# Standard deviations [m, rad] that `on_log_scale` maps to 0 and to 1.
SMALLEST_STD, LARGEST_STD = 1e-3, 10.0

_SCALE = 1.0 / math.log(LARGEST_STD / SMALLEST_STD)


def clip(value: float, low: float, high: float) -> float:
    """Clip a number to an interval."""
    return min(max(value, low), high)


def root(variance: float) -> float:
    """Compute a standard deviation; 0 for a variance negative by rounding."""
    return math.sqrt(max(variance, 0.0))


def on_log_scale(std: float) -> float:
    """Map a standard deviation to [0, 1] on a logarithmic scale of four decades.

    ::

        0 at 1 mm (or mrad) and below, 1 at 10 m and above

    Examples
    --------
    >>> [round(on_log_scale(std), 12) for std in (0.0, 0.01, 0.1, 50.0)]
    [0.0, 0.25, 0.5, 1.0]
    """
    bounded = min(max(std, SMALLEST_STD), LARGEST_STD)
    # clipped: a rounded logarithm can leave the interval
    return min(max(math.log(bounded / SMALLEST_STD) * _SCALE, 0.0), 1.0)


def correlation(covariance: float, product: float) -> float:
    """Divide a covariance by a product of standard deviations; 0 if that is 0."""
    return min(max(covariance / product, -1.0), 1.0) if product > 0.0 else 0.0


def turned(
    xx: float, xy: float, yy: float, cos: float, sin: float
) -> tuple[float, float, float]:
    """Compute Rᵀ [xx xy; xy yy] R: variance ahead, covariance, variance aside.

    Examples
    --------
    >>> turned(1.0, 0.5, 4.0, cos=0.0, sin=1.0)
    (4.0, -0.5, 1.0)
    """
    across = 2 * cos * sin * xy
    return (
        cos * cos * xx + across + sin * sin * yy,
        cos * sin * (yy - xx) + (cos * cos - sin * sin) * xy,
        sin * sin * xx - across + cos * cos * yy,
    )


clip_jit, root_jit = njit_internal(clip), njit_internal(root)
on_log_scale_jit = njit_internal(on_log_scale)
correlation_jit, turned_jit = njit_internal(correlation), njit_internal(turned)


@njit_internal
def write_pose_features(
    mean: Array, P: Array, bounds: Bounds, pose: Array, correlated: Array, std: Array
) -> None:
    """Write the features of one pose."""
    left, bottom, right, top = bounds
    heading = wrap_angle_jit(mean[2])
    cos, sin = math.cos(heading), math.sin(heading)
    pose[0] = clip_jit((2 * mean[0] - left - right) / (right - left), -1.0, 1.0)
    pose[1] = clip_jit((2 * mean[1] - bottom - top) / (top - bottom), -1.0, 1.0)
    pose[2], pose[3] = cos, sin
    aa, ab, bb = turned_jit(P[0, 0], P[0, 1], P[1, 1], cos, sin)
    x_h, y_h = P[0, 2], P[1, 2]
    ahead, aside, turn = root_jit(aa), root_jit(bb), root_jit(P[2, 2])
    std[0], std[1] = on_log_scale_jit(ahead), on_log_scale_jit(aside)
    std[2] = on_log_scale_jit(turn)
    correlated[0] = correlation_jit(ab, ahead * aside)
    correlated[1] = correlation_jit(cos * x_h + sin * y_h, ahead * turn)
    correlated[2] = correlation_jit(cos * y_h - sin * x_h, aside * turn)


@njit_internal
def relative_spread(
    covariance: Array, x: int, dx: float, dy: float
) -> tuple[float, float, float]:
    """Compute the covariance of e_l - e_p - e_θ J (l - p): its xx, xy and yy."""
    y = x + 1
    to_x = covariance[x, 2] - covariance[0, 2]  # of e_l - e_p with e_θ
    to_y = covariance[y, 2] - covariance[1, 2]
    turn = covariance[2, 2]
    xx = covariance[x, x] + covariance[0, 0] - 2 * covariance[x, 0]
    xy = covariance[x, y] + covariance[0, 1] - covariance[x, 1] - covariance[y, 0]
    yy = covariance[y, y] + covariance[1, 1] - 2 * covariance[y, 1]
    return (
        xx + 2 * to_x * dy + turn * dy * dy,
        xy - to_x * dx + to_y * dy - turn * dx * dy,
        yy - 2 * to_y * dx + turn * dx * dx,
    )


@njit_internal
def write_belief_features(
    mean: Array, P: Array, slots: IntArray, box: Bounds, into: FeatureArrays
) -> None:
    """Write the features of one belief, see `belief_features`, into flat arrays."""
    corr, map_std, std, landmarks, mask, pose, pose_corr, pose_std = into
    left, bottom, right, top = box
    diagonal = math.hypot(right - left, top - bottom)
    write_pose_features(mean, P, box, pose, pose_corr, pose_std)
    cos, sin = pose[2], pose[3]
    for i in range(len(slots)):
        j, k = 2 * i, 2 * i + 1
        mask[i] = slots[i] >= 0
        if not mask[i]:
            corr[i] = map_std[i] = 0.0
            std[j] = std[k] = landmarks[j] = landmarks[k] = 0.0
            continue
        x = 3 + 2 * slots[i]
        dx, dy = mean[x] - mean[0], mean[x + 1] - mean[1]
        landmarks[j] = clip_jit((cos * dx + sin * dy) / diagonal, -1.0, 1.0)
        landmarks[k] = clip_jit((cos * dy - sin * dx) / diagonal, -1.0, 1.0)
        xx, xy, yy = relative_spread(P, x, dx, dy)
        aa, ab, bb = turned_jit(xx, xy, yy, cos, sin)
        ahead, aside = root_jit(aa), root_jit(bb)
        std[j], std[k] = on_log_scale_jit(ahead), on_log_scale_jit(aside)
        corr[i] = correlation_jit(ab, ahead * aside)
        map_std[i] = on_log_scale_jit(root_jit(largest_variance(P, x)))


@jit_in_place
def write_features(
    means: Array,
    covariances: Array,
    slots: IntArray,
    bounds: Bounds,
    features: FeatureArrays,
) -> None:
    """Write the features of all beliefs, see `belief_features`."""
    corr, map_std, std, landmarks, mask, poses, pose_corr, pose_std = features
    shape = len(slots), 2 * slots.shape[1]
    std, landmarks = std.reshape(shape), landmarks.reshape(shape)
    for b in range(len(means)):
        landmark_rows = corr[b], map_std[b], std[b], landmarks[b], mask[b]
        rows = *landmark_rows, poses[b], pose_corr[b], pose_std[b]
        write_belief_features(means[b], covariances[b], slots[b], bounds, rows)
