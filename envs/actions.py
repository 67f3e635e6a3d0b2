"""Checks and clipping of actions, for one world or for many."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from ..arrays import AnyArray, Array, BoolArray

_REAL_NUMBERS = "efd" + np.typecodes["AllInteger"]


def clipped_action(action: ArrayLike, limits: Sequence[float]) -> tuple[float, float]:
    """Clip one action (v, ω) to ± limits [m/s, rad/s].

    Raises
    ------
    ValueError
        If the action is not two finite numbers.

    Examples
    --------
    >>> clipped_action([3, -0.5], limits=(1.0, 1.0))
    (1.0, -0.5)
    """
    numbers = _real_numbers(action, (2,), partial(_refusal, action))
    speed, turn_rate = numbers.tolist()
    fastest, quickest = limits
    if not (-fastest <= speed <= fastest and -quickest <= turn_rate <= quickest):
        if not (math.isfinite(speed) and math.isfinite(turn_rate)):
            raise _refusal(action)
        speed = min(max(speed, -fastest), fastest)
        turn_rate = min(max(turn_rate, -quickest), quickest)
    return speed, turn_rate


def clipped_actions(
    actions: ArrayLike, limits: Array, moving: BoolArray | None = None
) -> Array:
    """Clip B actions (v, ω) to ± limits [m/s, rad/s].

    Parameters
    ----------
    actions : array_like, shape (B, 2)
        Rows (v, ω) [m/s, rad/s].
    limits : ndarray, shape (B, 2)
        Largest |v| and |ω| of each robot.
    moving : bool ndarray, shape (B,), optional
        Worlds whose actions count (None: all); those of the others become zeros.

    Raises
    ------
    ValueError
        If `actions` is not B rows of two real numbers. If a number is not finite, the
        message names the first such world.

    Examples
    --------
    >>> clipped_actions([[1, 0], [2, float("nan")]], limits=np.ones((2, 2)))
    Traceback (most recent call last):
        ...
    ValueError: every action must be 2 finite numbers (v [m/s], ω [rad/s]), got [2.0, nan] for world 1
    """  # noqa: E501 (an error of one line)
    refusal = partial(_refusal_of_many, len(limits))
    array = _real_numbers(actions, limits.shape, refusal).astype(np.float64)
    if moving is not None:
        array[~moving] = 0.0
    finite = np.isfinite(array)
    if np.count_nonzero(finite) < finite.size:
        world = int(np.flatnonzero(~finite.all(axis=1))[0])
        raise ValueError(
            "every action must be 2 finite numbers (v [m/s], ω [rad/s]), "
            f"got {array[world].tolist()} for world {world}"
        )
    return np.minimum(np.maximum(array, -limits), limits)


def _real_numbers(
    value: ArrayLike, shape: tuple[int, ...], refusal: Callable[[str], ValueError]
) -> AnyArray:
    try:
        array = np.asarray(value)
    except ValueError:  # ragged
        raise refusal(repr(value)) from None
    if array.shape != shape:
        raise refusal(f"shape {array.shape}")
    if array.dtype.char not in _REAL_NUMBERS:
        raise refusal(f"{array.dtype}")
    return array


def _refusal(action: ArrayLike, got: str = "") -> ValueError:
    return ValueError(
        f"action must be 2 finite numbers (v [m/s], ω [rad/s]), got {action!r}"
    )


def _refusal_of_many(count: int, got: str) -> ValueError:
    return ValueError(
        f"actions must be real numbers of shape ({count}, 2), one row "
        f"(v [m/s], ω [rad/s]) per world, got {got}"
    )
