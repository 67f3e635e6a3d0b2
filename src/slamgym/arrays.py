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
