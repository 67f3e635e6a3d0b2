"""Arithmetic on angles in radians."""

from typing import TypeVar

import numpy as np

from ...arrays import Array

Angle = TypeVar("Angle", float, Array)


def wrap_angle(angle: Angle) -> Angle:
    """Bring angles into the half-open interval [-π, π).

    Parameters
    ----------
    angle : float or ndarray, any shape
        Angles [rad].

    Returns
    -------
    float or ndarray, same shape
        The same directions, each in [-π, π) [rad].

    Examples
    --------
    >>> wrap_angle(np.array([0.0, 2 * np.pi, np.pi]))
    array([ 0.        ,  0.        , -3.14159265])
    """
    wrapped = (angle + np.pi) % (2 * np.pi) - np.pi
    # The remainder of a tiny negative number rounds up to 2π itself.
    return wrapped - 2 * np.pi * (wrapped >= np.pi)
