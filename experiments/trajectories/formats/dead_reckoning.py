"""Compute the path from odometry alone."""

import numpy as np

from ....arrays import Array
from ....estimator.models.unicycle_motion import drive


def dead_reckoning(start: Array, odometry: Array) -> Array:
    """Integrate odometry.

    ::

        x' = x + d cos θ,    y' = y + d sin θ,    θ' = θ + α

    Parameters
    ----------
    start : ndarray, shape (3,)
        First pose [m, m, rad].
    odometry : ndarray, shape (T, 2)
        Rows (d, α) [m, rad].

    Returns
    -------
    ndarray, shape (T + 1, 3)
        Poses (x, y, θ) [m, m, rad], the start first, θ not wrapped.

    Examples
    --------
    >>> turns = np.array([[1.0, np.pi / 2], [2.0, 0.0]])
    >>> dead_reckoning(np.zeros(3), turns).round(2).tolist()
    [[0.0, 0.0, 0.0], [1.0, 0.0, 1.57], [1.0, 2.0, 1.57]]
    """
    x, y, heading = start.tolist()
    distances, turns = odometry.T
    headings = np.cumsum([heading, *turns])
    along_x, along_y, *_ = drive(0.0, 0.0, headings[:-1], distances, turns)
    return np.column_stack(
        [np.cumsum([x, *along_x]), np.cumsum([y, *along_y]), headings]
    )
