"""The interface of controllers, for one robot and for many, and its argument checks."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from ...arrays import Array


class Controller(Protocol):
    """Chooses the actions of one robot."""

    def act(self, pose: ArrayLike, step: int) -> Array:
        """Choose the next action.

        Parameters
        ----------
        pose : array_like, shape (3,)
            (x, y, θ) of the robot, true or estimated [m, m, rad].
        step : int
            Steps of the episode so far. Step 0 restarts the controller.

        Returns
        -------
        ndarray of float64, shape (2,)
            (v, ω) [m/s, rad/s], a new array.
        """
        ...


class VectorController(Protocol):
    """Chooses the actions of B robots."""

    def act(self, poses: ArrayLike, step: int) -> Array:
        """Choose the next action of every robot.

        Parameters
        ----------
        poses : array_like, shape (B, 3)
            (x, y, θ) of the robots, true or estimated [m, m, rad].
        step : int
            Steps of the episode so far, the same for all. Step 0 restarts them.

        Returns
        -------
        ndarray of float64, shape (B, 2)
            (v, ω) [m/s, rad/s], a new array.
        """
        ...


def each(function: Callable[..., float], *arguments: Array) -> Array:
    """Apply a function of `math` to every element.

    The sines and roots of numpy differ from those of `math` in the last bit.
    """
    numbers = [argument.tolist() for argument in arguments]
    return np.fromiter(map(function, *numbers), np.float64, len(numbers[0]))


def finite_pose(pose: ArrayLike) -> Array:
    """Return one pose as an array, or raise a `ValueError`."""
    array = np.asarray(pose, dtype=np.float64)
    if array.shape != (3,) or not np.isfinite(array).all():
        raise ValueError(f"pose must be 3 finite numbers (x, y, θ), got {pose!r}")
    return array


def finite_poses(poses: ArrayLike, count: int) -> Array:
    """Return the poses of some robots as an array, or raise a `ValueError`."""
    array = np.asarray(poses, dtype=np.float64)
    if array.shape != (count, 3) or not np.isfinite(array).all():
        raise ValueError(
            f"poses must be finite, one row (x, y, θ) for each of {count} robots, "
            f"got {poses!r}"
        )
    return array


def finite_rows(rows: ArrayLike, name: str) -> Array:
    """Return rows of two numbers as a new array, or raise a `ValueError`."""
    array = np.array(rows, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] != 2 or not len(array):
        raise ValueError(f"{name} must have shape (K, 2), K >= 1, got {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} must be finite, got {rows!r}")
    return array


def positive(value: float, name: str) -> float:
    """Return a number, or raise a `ValueError` if it is not finite and positive."""
    if not 0 < value < math.inf:
        raise ValueError(f"{name} must be finite and > 0, got {value}")
    return value
