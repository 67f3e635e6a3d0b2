"""Wrapping of angles to [-π, π).

Worlds have their own arithmetic: `envs` imports nothing of `estimator`. A simulator
that shared the filter's models could not reveal an error in them.
"""

import math
from typing import TypeVar

import numpy as np

from ..arrays import Array

Number = TypeVar("Number", float, Array)


def wrap_angle(angle: Number) -> Number:
    """Wrap an angle, or an array of angles, to [-π, π) up to rounding.

    Examples
    --------
    >>> wrap_angle(3 * math.pi / 2) == -math.pi / 2
    True
    """
    return (angle + math.pi) % (2 * math.pi) - math.pi


def wrap_bearings(bearings: Array) -> None:
    """Wrap angles to [-π, π) in place; angles inside the interval keep every bit.

    Examples
    --------
    >>> bearings = np.array([0.1, np.pi, 1.0 - 2 * np.pi])
    >>> wrap_bearings(bearings)
    >>> bearings.round(12)
    array([ 0.1       , -3.14159265,  1.        ])
    """
    outside = (bearings >= np.pi) | (bearings < -np.pi)
    wrapped = wrap_angle(bearings[outside])
    wrapped[wrapped >= np.pi] = -np.pi  # a tiny negative remainder rounds up to 2π
    bearings[outside] = wrapped
