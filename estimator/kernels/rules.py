"""Rules of an update: what distinguishes one filter of the family from another."""

from typing import NamedTuple

import numpy as np

from ...arrays import Array
from ...jit import njit_inlined

# Where Jacobians are taken.
AT_ESTIMATE = 0
AT_REFERENCE = 1  # at fixed points kept beside the estimate
PROJECTED = 2  # at the estimate, then made blind to a rotation of the whole map
AT_TRUTH = 3  # at the ground truth, for study

# Error frame: how a correction is composed with the state.
ADDITIVE = 0
INVARIANT = 1


class Rules(NamedTuple):
    """What distinguishes one filter's update from another's; plain numbers."""

    linearisation: int = AT_ESTIMATE
    frame: int = ADDITIVE
    iterations: int = 1
    sequential: bool = False  # one correction for each reading
    correlated: bool = True  # a new landmark with the pose it was seen from
    bearing_std: float = 0.0  # [rad]
    range_std: float = 0.0  # [m]
    range_std_per_metre: float = 0.0
    bearing_std_metres: float = 0.0  # [m]
    min_range: float = 1e-3  # [m]
    gate: float = np.inf  # largest NIS of one reading
    noise_as_read: bool = False  # take noise at the range as read, not as expected


FIRST_STD = Rules._fields.index("bearing_std")
"""Column of the first of the four standard deviations of a reading in the rules."""
AFTER_STDS = Rules._fields.index("min_range")


@njit_inlined
def as_rules(values: Array) -> Rules:
    """Read rules from the array ``numpy.array(rules)``.

    Python passes one array faster than a tuple of twelve numbers.
    """
    return Rules(
        int(values[0]),
        int(values[1]),
        int(values[2]),
        values[3] > 0,
        values[4] > 0,
        values[5],
        values[6],
        values[7],
        values[8],
        values[9],
        values[10],
        values[11] > 0,
    )
