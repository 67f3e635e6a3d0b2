"""The input of the renderer, as plain arrays without matplotlib: `RenderState`.

The functions below it compute what is drawn: the limits of the axes, the area that the
sensor sees, and the ellipses of a belief.
"""

from __future__ import annotations

from typing import Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike

from ...arrays import Array, BoolArray
from ...sim_configs import Scenario
from ..controllers import planned_path
from ..robot import wrap_angle

RenderMode = Literal["human", "rgb_array"]
#: The values of ``render_mode``: a window, or arrays of pixels.
RENDER_MODES: tuple[RenderMode, ...] = ("human", "rgb_array")


class BeliefLike(Protocol):
    """A Gaussian belief of any estimator over (x, y, θ, l1x, l1y, …)."""

    @property
    def pose(self) -> Array:
        """Mean of the pose, shape (3,) [m, m, rad]."""

    @property
    def pose_covariance(self) -> Array:
        """Covariance of the pose, shape (3, 3)."""

    @property
    def landmarks(self) -> Array:
        """Means of the n mapped landmarks, shape (n, 2) [m]."""

    @property
    def covariance(self) -> Array:
        """Covariance of the additive error of the state, shape (3 + 2n, 3 + 2n)."""


class RenderState(NamedTuple):
    """The state of a world that one frame shows."""

    #: True (x, y, θ), shape (3,) [m, m, rad].
    pose: Array
    #: True positions up to the present one, shape (k, 2) [m].
    path: Array
    #: Readings of this step as `drawn_readings`, shape (m, 2) [rad, m].
    measurements: Array
    #: Whether a wall stopped the robot in this step.
    collision: bool
    #: Belief of an estimator, or None.
    belief: BeliefLike | None
    #: Since the start of the episode [s].
    time: float
    #: Steps since the start of the episode.
    step: int
    #: Which measurements show no landmark, shape (m,); None for none of them.
    clutter: BoolArray | None = None


# --------------------------------------------------------------------------------------
# The limits of the axes: the part of the plane that a frame shows.

_MARGIN = 0.06  # of the span, on every side
_EDGE = 0.02  # of the span; a robot this near to the border counts as outside
_GROWTH = 0.25  # of the span, beyond the robot
_NEAR = 3.0  # ranges of the sensor to every side of a robot that is followed
_LARGE = 3.0  # times what is near: a world that is too large to be shown as a whole
_AHEAD = 0.25  # of the span; a followed robot this near to the border is centred


class AxesLimits:
    """A rectangle that always contains the robot.

    The initial rectangle contains the landmarks, the walls, the start and the planned
    path. It grows in steps when the robot drives out of it. Every episode begins with
    the initial rectangle. In a world that is much larger than the range of the sensor,
    the rectangle shows the surroundings of the robot and moves with it, in steps.

    Parameters
    ----------
    scenario : Scenario
        Source of walls, start and planned path.
    landmarks : ndarray, shape (N, 2)
        True positions [m].
    aspect : float
        Width of the rectangle over its height.
    """

    def __init__(self, scenario: Scenario, landmarks: Array, aspect: float) -> None:
        self._aspect = aspect
        points = np.concatenate(
            [
                np.reshape(landmarks, (-1, 2)),
                np.reshape(scenario.walls, (-1, 2)),
                planned_path(scenario)[:, :2],
            ]
        )
        low, high = points.min(axis=0), points.max(axis=0)
        smallest = 8 * scenario.robot.radius
        room = np.maximum(_MARGIN * (high - low).max(), (smallest - (high - low)) / 2)
        self._initial = self._fit(low - room, high + room)
        self._near = _NEAR * scenario.sensor.max_range
        self._follows = bool((high - low).max() > 2 * _LARGE * self._near)
        if self._follows:
            self._initial = self._around(np.array(scenario.start.pose[:2]))
        self._box = self._initial

    @property
    def x(self) -> tuple[float, float]:
        """Left and right end [m]."""
        return float(self._box[0, 0]), float(self._box[1, 0])

    @property
    def y(self) -> tuple[float, float]:
        """Lower and upper end [m]."""
        return float(self._box[0, 1]), float(self._box[1, 1])

    def follow(self, state: RenderState) -> bool:
        """Extend or move the limits to the robot; return whether they changed."""
        before = self._box
        box = self._initial if state.step == 0 else before
        if self._follows:
            self._box = self._moved(box, state.pose[:2])
            return bool((self._box != before).any())
        track = np.concatenate([np.reshape(state.path, (-1, 2)), [state.pose[:2]]])
        low, high = track.min(axis=0), track.max(axis=0)
        span = (box[1] - box[0]).max()
        if (low < box[0] + _EDGE * span).any() or (high > box[1] - _EDGE * span).any():
            growth = _GROWTH * span
            box = self._fit(
                np.where(low < box[0] + _EDGE * span, low - growth, box[0]),
                np.where(high > box[1] - _EDGE * span, high + growth, box[1]),
            )
        self._box = box
        return bool((box != before).any())

    def _moved(self, box: Array, robot: Array) -> Array:
        """Centre a rectangle on a robot that is near its border."""
        edge = _AHEAD * (box[1] - box[0])
        inside = (robot > box[0] + edge).all() and (robot < box[1] - edge).all()
        return box if inside else self._around(robot)

    def _around(self, robot: Array) -> Array:
        return self._fit(robot - self._near, robot + self._near)

    def _fit(self, low: Array, high: Array) -> Array:
        """Widen a rectangle about its centre to the aspect ratio."""
        centre, (width, height) = (low + high) / 2, high - low
        width = max(width, height * self._aspect)
        half = np.array([width, width / self._aspect]) / 2
        return np.stack([centre - half, centre + half])


# --------------------------------------------------------------------------------------
# The area that a sensor sees from a pose, cut off where walls hide what is behind.

_RAYS, _MORE_RAYS = 65, 257  # the latter where walls cut some off
_BESIDE = 1e-6  # [rad] between the rays to both sides of the end of a wall


def visible_area(
    pose: Array, field_of_view: float, reach: float, walls: Array
) -> Array:
    """Return the outline of a sector or disc, shortened by walls.

    A ray p + t (cos φ, sin φ) meets the wall from a to b at ::

        t = (a - p) × (b - a) / d × (b - a),    s = (a - p) × d / d × (b - a)

    where 0 <= s <= 1 and t > 0.  There are rays to both sides of every end of a wall.

    Parameters
    ----------
    pose : ndarray, shape (3,)
        (x, y, θ) of the sensor [m, m, rad].
    field_of_view : float
        Opening angle [rad], about the heading.
    reach : float
        Length of a free ray [m].
    walls : ndarray, shape (W, 2, 2)
        Ends of the walls that hide what is behind them [m].

    Returns
    -------
    ndarray, shape (n, 2)
        Corners of the outline [m].

    Examples
    --------
    >>> wall = np.array([[[1.0, -9.0], [1.0, 9.0]]])
    >>> area = visible_area(np.zeros(3), 1.0, 5.0, wall)
    >>> round(float(area[:, 0].max()), 9)
    1.0
    """
    p, heading = pose[:2], pose[2]
    angles = field_of_view * np.linspace(-0.5, 0.5, _MORE_RAYS if len(walls) else _RAYS)
    offset = walls.reshape(-1, 2) - p
    ends = wrap_angle(np.arctan2(offset[:, 1], offset[:, 0]) - heading)
    ends = np.concatenate([ends - _BESIDE, ends + _BESIDE])
    angles = np.sort(np.append(angles, ends[np.abs(ends) < field_of_view / 2]))
    rays = np.stack([np.cos(heading + angles), np.sin(heading + angles)], axis=1)
    outline = p + _lengths(rays, p, walls, reach)[:, None] * rays
    return outline if field_of_view >= 2 * np.pi else np.append(outline, [p], axis=0)


def _lengths(rays: Array, p: Array, walls: Array, reach: float) -> Array:
    """Return the length of each ray up to the first wall or the reach, shape (R,)."""
    start, along = walls[:, 0] - p, walls[:, 1] - walls[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        slant = _cross(rays[:, None], along)
        t = _cross(start, along) / slant
        s = _cross(start, rays[:, None]) / slant
        hits = (t > 0) & (s >= 0) & (s <= 1)
    return np.asarray(np.where(hits, t, reach).min(axis=1, initial=reach))


def _cross(u: Array, v: Array) -> Array:
    return np.asarray(u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0])


# --------------------------------------------------------------------------------------
# The n-sigma ellipses of planar Gaussian beliefs.
#
# Symbols
# -------
# P = [[a, b], [b, c]]  covariance of a position [m²]
# n                     size of the ellipse in standard deviations

_RELATIVE_ROUNDING = 1e-9  # of the larger eigenvalue
_ABSOLUTE_ROUNDING = 1e-12  # [m²]: a micrometre, squared


class Ellipses(NamedTuple):
    """Full axes and directions of ellipses, in the shape of the input's batch."""

    widths: Array  # (…), along the direction of largest spread [m]
    heights: Array  # (…), across it [m]
    angles: Array  # (…), from the x-axis to the width, in (-π/2, π/2] [rad]


def covariance_ellipses(covariance: ArrayLike, sigmas: float = 3.0) -> Ellipses:
    """Compute the ellipses { l : (l - mean)ᵀ P⁻¹ (l - mean) = n² } of covariances P.

    ::

        λ = (a + c)/2 ± √( ((a - c)/2)² + b² )        eigenvalues of P
        width, height = 2 n √λ₊, 2 n √λ₋              full axes
        angle = atan2(2 b, a - c) / 2                 eigenvector of λ₊

    Parameters
    ----------
    covariance : array_like, shape (…, 2, 2)
        Covariances P [m²], symmetric, finite and without negative eigenvalues.
        Eigenvalues that are negative by rounding count as zero.
    sigmas : float, default 3
        n > 0.

    Returns
    -------
    Ellipses
        Widths, heights [m] and angles [rad], each of shape (…).

    Raises
    ------
    ValueError
        If a matrix is not a covariance, or sigmas is not positive.

    Examples
    --------
    >>> covariance_ellipses([[4.0, 0.0], [0.0, 1.0]], sigmas=1.0).widths
    array(4.)
    """
    P = np.asarray(covariance, dtype=float)
    _check(P, sigmas)
    a, b, c = P[..., 0, 0], P[..., 0, 1], P[..., 1, 1]
    mean, radius = (a + c) / 2, np.hypot((a - c) / 2, b)
    larger, smaller = mean + radius, mean - radius
    if np.any(smaller < -(_ABSOLUTE_ROUNDING + _RELATIVE_ROUNDING * np.abs(larger))):
        raise ValueError(
            "covariance must have no negative eigenvalue, "
            f"got {float(np.min(smaller)):.3g} m²"
        )
    return Ellipses(
        widths=np.asarray(2 * sigmas * np.sqrt(np.maximum(larger, 0.0))),
        heights=np.asarray(2 * sigmas * np.sqrt(np.maximum(smaller, 0.0))),
        angles=np.asarray(np.arctan2(2 * b, a - c) / 2),
    )


def _check(P: Array, sigmas: float) -> None:
    if P.shape[-2:] != (2, 2):
        raise ValueError(f"covariance must have shape (…, 2, 2), got {P.shape}")
    if not np.isfinite(P).all():
        raise ValueError("covariance must be finite, got nan or inf")
    skew = np.abs(P[..., 0, 1] - P[..., 1, 0])
    size = np.abs(P[..., 0, 0]) + np.abs(P[..., 1, 1])
    if np.any(skew > _ABSOLUTE_ROUNDING + _RELATIVE_ROUNDING * size):
        raise ValueError(
            f"covariance must be symmetric, got entries {float(np.max(skew)):.3g} apart"
        )
    if not sigmas > 0:
        raise ValueError(f"sigmas must be > 0, got {sigmas}")


_RAY = 2.0  # length of a reading without a range [m]


def drawn_readings(kind: str, readings: Array) -> Array:
    """Return readings as rays (bearing, length) from the robot, for pictures.

    Parameters
    ----------
    kind : str
        Of the sensor.  A bearing becomes a ray of 2 m.  A range, or a reading of a
        sensor of your own, has no direction and becomes a ray of length 0.
    readings : ndarray, shape (m, 2)
        Of the sensor.

    Returns
    -------
    ndarray, shape (m, 2)
        [rad, m].

    Examples
    --------
    >>> drawn_readings("position", np.array([[0.0, 3.0]])).round(3)
    array([[1.571, 3.   ]])
    """
    if kind == "bearing_range":
        return readings
    first, second = readings.T
    match kind:
        case "position":
            return np.column_stack([np.arctan2(second, first), np.hypot(first, second)])
        case "bearing":
            return np.column_stack([first, np.full(len(first), _RAY)])
    return np.zeros(readings.shape)
