"""How far maps are from the truth: for `info`, never for an observation or a reward."""

import math

import numpy as np
from scipy.optimize import linear_sum_assignment

from ..arrays import Array, ComplexArray, IntArray
from ..estimator.filters.batch import BatchStorage
from ..jit import jit


def map_rmse(beliefs: BatchStorage, landmarks: ComplexArray) -> Array:
    """Compute the root mean square error of maps, (B,) [m]; 0 of an empty one.

    The error of a landmark is its distance from the truth in the world's frame, with
    no alignment: an error of the first heading counts.

    Parameters
    ----------
    beliefs : BatchStorage
        Of B worlds.
    landmarks : complex ndarray, shape (B, N)
        True positions x + iy [m]; row i is landmark i.

    Examples
    --------
    >>> beliefs = BatchStorage(
    ...     np.array([[0.0, 0.0, 0.0, 3.0, 4.0, 0.0, 0.0]]),
    ...     np.zeros((1, 7, 7)),
    ...     np.array([[-1, 0]]),
    ... )
    >>> map_rmse(beliefs, np.array([[9.0 + 9.0j, 3.0 + 3.5j]]))
    array([0.5])
    """
    errors = np.empty(len(landmarks))
    _write_rmse(beliefs.means, beliefs.slots, landmarks, errors)
    return errors


def matched_rmse(beliefs: BatchStorage, landmarks: ComplexArray) -> Array:
    """Compute the same of maps that assign their own identities, (B,) [m].

    Landmarks of map and truth are matched one to one, so that the sum of the squared
    distances is smallest. A duplicate is therefore compared with another landmark.

    Examples
    --------
    >>> beliefs = BatchStorage(
    ...     np.array([[0.0, 0.0, 0.0, 3.0, 4.0, 3.0, 4.1]]),
    ...     np.zeros((1, 7, 7)),
    ...     np.array([[0, 1]]),
    ... )
    >>> matched_rmse(beliefs, np.array([[3.0 + 4.0j, 3.0 + 0.1j]])).round(3)
    array([2.759])
    """
    errors = np.zeros(len(landmarks))
    for b, slots in enumerate(beliefs.slots):
        places = beliefs.means[b, 3 : 3 + 2 * np.count_nonzero(slots >= 0)]
        if len(places):
            mapped = places[::2] + 1j * places[1::2]
            squares = np.abs(mapped[:, None] - landmarks[b]) ** 2
            errors[b] = math.sqrt(squares[linear_sum_assignment(squares)].mean())
    return errors


@jit
def _write_rmse(
    means: Array, slots: IntArray, landmarks: ComplexArray, errors: Array
) -> None:
    for b in range(len(means)):
        squares, mapped = 0.0, 0
        for i in range(slots.shape[1]):
            if slots[b, i] >= 0:
                x = 3 + 2 * slots[b, i]
                dx = means[b, x] - landmarks[b, i].real
                dy = means[b, x + 1] - landmarks[b, i].imag
                squares, mapped = squares + dx * dx + dy * dy, mapped + 1
        errors[b] = math.sqrt(squares / mapped) if mapped else 0.0
