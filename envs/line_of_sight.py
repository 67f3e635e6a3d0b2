"""Which landmarks a robot sees, and which a wall hides."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
BoolArray = NDArray[np.bool_]

_MOUNTED = 1e-6  # a landmark so near to a wall's line hangs on the wall [m]


class LineOfSight:
    """Straight walls without thickness that hide what is behind them.

    A landmark mounted on a wall (within 1 µm of its line) is not hidden by that wall.

    Parameters
    ----------
    walls : sequence of (x0, y0, x1, y1)
        Ends of the W walls [m].

    Examples
    --------
    >>> sight = LineOfSight([(1.0, -1.0, 1.0, 1.0)])
    >>> landmarks = np.array([2.0 + 0.0j, 0.5 + 0.0j, 2.0 + 5.0j])
    >>> sight.blocked(landmarks, position=0j)
    array([ True, False, False])
    """

    def __init__(self, walls: Sequence[tuple[float, float, float, float]]) -> None:
        ends = np.array(walls, dtype=np.float64).reshape(-1, 4)
        self._ends = np.concatenate(
            [ends[:, 0] + 1j * ends[:, 1], ends[:, 2] + 1j * ends[:, 3]]
        )
        lengths = np.hypot(ends[:, 2] - ends[:, 0], ends[:, 3] - ends[:, 1])
        self._mounted = _MOUNTED * lengths

    def blocked(self, landmarks: ComplexArray, position: complex | ComplexArray) -> BoolArray:
        """Tell which lines of sight cross a wall; its end points belong to it.

        The segment p l crosses the wall a b where a and b lie on different sides of
        the line p l, and p and l on different sides of the line a b::

            (δ × a)(δ × b) <= 0   and   (a × b) (a × b + δ × a - δ × b) < 0

        with δ = l - p and a, b relative to p.

        Parameters
        ----------
        landmarks : complex ndarray, shape (…, N)
            l as x + iy [m].
        position : complex, or complex ndarray, shape (…, 1)
            p as x + iy [m].

        Returns
        -------
        bool ndarray, shape (…, N)
        """
        count = len(self._mounted)
        ends, delta = self._ends - position, (landmarks - position)[..., None]
        sides = _cross(delta, ends[..., None, :])
        side_a, side_b = sides[..., :count], sides[..., count:]
        robot_side = _cross(ends[..., :count], ends[..., count:])[..., None, :]
        landmark_side = robot_side + side_a - side_b
        behind = landmark_side * np.sign(robot_side) < -self._mounted
        crossed: BoolArray = (side_a * side_b <= 0) & behind
        return np.logical_or.reduce(crossed, axis=-1)


def _cross(u: ComplexArray, v: ComplexArray) -> Array:
    product: Array = u.real * v.imag - u.imag * v.real
    return product
