"""The arrays of one belief, as kernels work on them."""

from typing import NamedTuple

import numpy as np

from ...arrays import Array

CACHE_LINE = 64  # [bytes]


class BeliefArrays(NamedTuple):
    """One run's belief, which kernels change in place.

    The first ``size`` = 3 + 2n entries are in use, in the order (x, y, θ, l1x, l1y, …),
    and the others are zero.  ``capacity`` is a multiple of 4 above ``size``, so that
    loops may run over whole vector registers.
    """

    mean: Array  # (capacity,)
    covariance: Array  # (capacity, capacity)
    reference: Array  # (capacity,) fixed points for Jacobians, where the rules use them


def aligned_zeros(*shape: int) -> Array:
    """Return zeros that begin on a cache line, so that no vector spans two lines.

    Examples
    --------
    >>> aligned_zeros(3, 5).ctypes.data % CACHE_LINE
    0
    """
    size = int(np.prod(shape))
    room = np.zeros(size + CACHE_LINE // 8)
    skipped = -room.ctypes.data % CACHE_LINE // 8
    return room[skipped : skipped + size].reshape(shape)
