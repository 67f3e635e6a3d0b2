"""Compiled kernels of `belief_features`: one pass over all worlds.

Symbols are those of `belief_features`.
"""

import math

from ..arrays import Array, BoolArray, IntArray
from ..estimator.kernels.kalman_gain import largest_variance
from ..estimator.models.bearing_range import wrap_angle_jit
from ..jit import jit, njit_internal

Rectangle = tuple[float, float, float, float]

FeatureArrays = tuple[Array, Array, Array, Array, BoolArray, Array, Array, Array]
"""Of B worlds, in the alphabetical order of their keys, see `belief_features`."""

SMALLEST_STD, LARGEST_STD = 1e-3, 10.0
"""Standard deviations [m, rad] that `on_log_scale` maps to 0 and to 1."""

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
    mean: Array,
    covariance: Array,
    bounds: Rectangle,
    pose: Array,
    correlations: Array,
    std: Array,
) -> None:
    """Write the features of one pose."""
    left, bottom, right, top = bounds
    heading = wrap_angle_jit(mean[2])
    cos, sin = math.cos(heading), math.sin(heading)
    pose[0] = clip_jit((2 * mean[0] - left - right) / (right - left), -1.0, 1.0)
    pose[1] = clip_jit((2 * mean[1] - bottom - top) / (top - bottom), -1.0, 1.0)
    pose[2], pose[3] = cos, sin
    aa, ab, bb = turned_jit(
        covariance[0, 0], covariance[0, 1], covariance[1, 1], cos, sin
    )
    x_h, y_h = covariance[0, 2], covariance[1, 2]
    ahead, aside, turn = root_jit(aa), root_jit(bb), root_jit(covariance[2, 2])
    std[0], std[1] = on_log_scale_jit(ahead), on_log_scale_jit(aside)
    std[2] = on_log_scale_jit(turn)
    correlations[0] = correlation_jit(ab, ahead * aside)
    correlations[1] = correlation_jit(cos * x_h + sin * y_h, ahead * turn)
    correlations[2] = correlation_jit(cos * y_h - sin * x_h, aside * turn)


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
    b: int,
    mean: Array,
    covariance: Array,
    slots: IntArray,
    bounds: Rectangle,
    features: FeatureArrays,
) -> None:
    """Write the features of one belief into row b, see `belief_features`."""
    corr, map_std, std, landmarks, mask, poses, pose_corr, pose_std = features
    left, bottom, right, top = bounds
    diagonal = math.hypot(right - left, top - bottom)
    write_pose_features(mean, covariance, bounds, poses[b], pose_corr[b], pose_std[b])
    cos, sin = poses[b, 2], poses[b, 3]
    for i in range(len(slots)):
        mask[b, i] = slots[i] >= 0
        if not mask[b, i]:
            corr[b, i] = map_std[b, i] = 0.0
            std[b, i] = 0.0
            landmarks[b, i] = 0.0
            continue
        x = 3 + 2 * slots[i]
        dx, dy = mean[x] - mean[0], mean[x + 1] - mean[1]
        landmarks[b, i, 0] = clip_jit((cos * dx + sin * dy) / diagonal, -1.0, 1.0)
        landmarks[b, i, 1] = clip_jit((cos * dy - sin * dx) / diagonal, -1.0, 1.0)
        xx, xy, yy = relative_spread(covariance, x, dx, dy)
        aa, ab, bb = turned_jit(xx, xy, yy, cos, sin)
        ahead, aside = root_jit(aa), root_jit(bb)
        std[b, i, 0], std[b, i, 1] = on_log_scale_jit(ahead), on_log_scale_jit(aside)
        corr[b, i] = correlation_jit(ab, ahead * aside)
        map_std[b, i] = on_log_scale_jit(root_jit(largest_variance(covariance, x)))


@jit
def write_features(
    means: Array,
    covariances: Array,
    slots: IntArray,
    bounds: Rectangle,
    features: FeatureArrays,
) -> None:
    """Write the features of all beliefs, see `belief_features`."""
    for b in range(len(means)):
        write_belief_features(b, means[b], covariances[b], slots[b], bounds, features)
