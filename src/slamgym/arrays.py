"""Names of array types, for annotations in every room."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
ComplexArray = NDArray[np.complex128]
ImageArray = NDArray[np.uint8]
IndexArray = NDArray[np.intp]
IntArray = NDArray[np.int64]
WordArray = NDArray[np.uint64]
AnyArray = NDArray[Any]


# --------------------------------------------------------------------------------------
# The range of numbers that every room accepts.

#: Largest length [m], angle [rad], duration [s or steps], standard deviation or count.
#:
#: In metres, it is six times the distance of the sun.  Squares, products of several
#: squares and sums over long runs stay far below 1e308, the largest float64: numbers
#: within this bound lead to no infinity, and so to no NaN.
LARGEST = 1e12
#: Smallest number where a number must be > 0; quotients then stay finite, too.
SMALLEST = 1e-12
#: Largest ``range_std_per_metre`` [m/m]: σr is then a thousand times the range.
#:
#: Such a reading contains no information; with larger values, roundings are as large as
#: the map.
LARGEST_RANGE_GROWTH = 1000.0
#: Largest number of a saved state.
#:
#: A turn with σ = LARGEST over dt = LARGEST has the variance LARGEST³, and a landmark
#: at the distance LARGEST then LARGEST⁵.  One factor more leaves room for long runs.
LARGEST_IN_STATE = LARGEST**6

#: Most landmarks of a world, and most false readings of a step: arrays of 160 MB.
LARGEST_MAP = 10_000_000
#: Most steps of an episode.
LARGEST_EPISODE = 1_000_000_000
