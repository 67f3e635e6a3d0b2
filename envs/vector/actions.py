"""Actions for many worlds at once, checked at the door."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

_REAL_NUMBERS = "efd" + np.typecodes["AllInteger"]


def checked_actions(
    actions: ArrayLike, count: int, moving: NDArray[np.bool_] | None = None
) -> Array:
    """Take B actions (v, ω) as float64.

    Parameters
    ----------
    actions : array_like, shape (B, 2)
        Rows (v, ω) [m/s, rad/s].
    count : int
        B.
    moving : bool ndarray, shape (B,), optional
        Whose actions count (all); those of the others become zeros.

    Raises
    ------
    ValueError
        If they are not B rows of two real numbers, or not finite; then it names the
        first such world.

    Examples
    --------
    >>> checked_actions([[1, 0], [2, float("nan")]], count=2)
    Traceback (most recent call last):
        ...
    ValueError: every action must be 2 finite numbers (v [m/s], ω [rad/s]), got [2.0, nan] for world 1
    """  # noqa: E501 (an error of one line)
    try:
        array = np.asarray(actions)
    except ValueError:  # ragged
        raise _refusal(repr(actions), count) from None
    if array.shape != (count, 2):
        raise _refusal(f"shape {array.shape}", count)
    if array.dtype.char not in _REAL_NUMBERS:
        raise _refusal(f"{array.dtype}", count)
    array = array.astype(np.float64)
    if moving is not None:
        array[~moving] = 0.0
    finite = np.isfinite(array)
    if np.count_nonzero(finite) < finite.size:
        world = int(np.flatnonzero(~finite.all(axis=1))[0])
        raise ValueError(
            "every action must be 2 finite numbers (v [m/s], ω [rad/s]), "
            f"got {array[world].tolist()} for world {world}"
        )
    return array


def _refusal(got: str, count: int) -> ValueError:
    return ValueError(
        f"actions must be real numbers of shape ({count}, 2), one row "
        f"(v [m/s], ω [rad/s]) per world, got {got}"
    )
