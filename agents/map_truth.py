"""How far maps are from the truth: for `info`, never for an observation or a reward."""

import math

import numpy as np

from ..arrays import Array, ComplexArray, IntArray
from ..estimator.filters.batch_results import BatchStorage
from ..jit import jit


def map_rmse(beliefs: BatchStorage, landmarks: ComplexArray) -> Array:
    """Compute the root mean square error of maps, (B,) [m]; nan for an empty one.

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
        errors[b] = math.sqrt(squares / mapped) if mapped else math.nan
