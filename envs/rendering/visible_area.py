"""The area that a sensor sees from a pose, cut off where walls hide what is behind."""

import numpy as np

from ...arrays import Array
from ..angles import wrap_angle

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
