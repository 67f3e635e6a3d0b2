"""Compute the path from odometry alone."""

import numpy as np

from ..trajectory import Array


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
    return np.column_stack(
        [
            np.cumsum([x, *(distances * np.cos(headings[:-1]))]),
            np.cumsum([y, *(distances * np.sin(headings[:-1]))]),
            headings,
        ]
    )
