"""Occlusion: which landmarks a wall hides from the robot."""

from collections.abc import Sequence

import numpy as np

from ...arrays import Array, BoolArray, ComplexArray

_MOUNTED = 1e-6  # a landmark this near to the line of a wall is mounted on it [m]


class LineOfSight:
    """Straight walls without thickness that hide the landmarks behind them.

    A landmark mounted on a wall (within 1 µm of its line) is not hidden by that wall.

    Parameters
    ----------
    walls : sequence of (x0, y0, x1, y1)
        Ends of the W walls [m].

    Examples
    --------
    >>> sight = LineOfSight([(1.0, -1.0, 1.0, 1.0)])
    >>> landmarks = np.array([2.0 + 0.0j, 0.5 + 0.0j, 2.0 + 5.0j])
    >>> sight.blocked(landmarks, position=np.array(0j))
    array([ True, False, False])
    """

    def __init__(self, walls: Sequence[tuple[float, float, float, float]]) -> None:
        ends = np.array(walls, dtype=np.float64).reshape(-1, 2, 2)
        a, b = np.moveaxis(ends[..., 0] + 1j * ends[..., 1], 1, 0)
        self._conjugate_ends = np.conj(np.concatenate([a, b]))
        self._count = len(a)
        self._along = b - a
        self._origin_side = _cross(a, b)
        self._mounted = _MOUNTED * np.abs(self._along)

    def blocked(self, landmarks: ComplexArray, position: ComplexArray) -> BoolArray:
        """Return which lines of sight cross a wall; its end points belong to it.

        With δ = l - p, and the ends a and b of a wall relative to p, the line from p
        to l passes between them if δ × a and δ × b differ in sign, and l lies behind
        the wall if δ × (b - a), which grows with δ, exceeds a × b::

            (δ × a)(δ × b) <= 0   and   δ × (b - a) sign(a × b) > |a × b|

        Parameters
        ----------
        landmarks : complex ndarray, shape (…, N)
            l as x + iy [m].
        position : complex ndarray, shape () or (…, 1)
            p as x + iy [m].

        Returns
        -------
        bool ndarray, shape (…, N)
        """
        p = position[..., None]
        ends = self._conjugate_ends - np.conj(p)
        sides = ((landmarks - position)[..., None] * ends).imag  # a × δ, then b × δ
        side_a, side_b = sides[..., : self._count], sides[..., self._count :]
        robot_side = self._origin_side - _cross(p, self._along)
        nearer = np.abs(robot_side) + self._mounted
        behind = (side_a - side_b) * np.sign(robot_side) > nearer
        behind &= side_a * side_b <= 0.0
        blocked: BoolArray = np.logical_or.reduce(behind, axis=-1)
        return blocked


def _cross(u: ComplexArray, v: ComplexArray) -> Array:
    product: Array = (np.conj(u) * v).imag
    return product
