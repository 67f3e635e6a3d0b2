"""Cameras as sensors of a user: the column of the image and the range."""

import numpy as np

from slamgym.estimator import Sensor


def h(x, y):
    """Return column and range of a landmark ahead, and their derivatives."""
    r = np.sqrt(x * x + y * y)
    return (500 * y / x, r), (-500 * y / (x * x), 500 / x, x / r, y / r)


def inverse(column, r):
    """Return the position (x, y) of a landmark ahead."""
    ahead = r / np.sqrt(1 + (column / 500) ** 2)
    return ahead, ahead * column / 500


NAMES = ("column", "range"), ("px", "m")
AHEAD = Sensor("camera:AHEAD", *NAMES, h, inverse, field_of_view=1.5)


def sideways(x, y):
    """Return the range before the column."""
    (column, r), (a, b, c, d) = h(x, y)
    return (r, column), (c, d, a, b)


SECOND = Sensor("camera:SECOND", ("r", "column"), ("m", "px"), sideways)
