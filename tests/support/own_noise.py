"""A sensor of a user that differs from the default in its function for the noise."""

from dataclasses import replace

import numpy as np

from slamgym.estimator.models.sensors import BEARING_RANGE


def grown_std(noise, distance):
    """Return the deviations as an array; that of the range grows with the range."""
    return np.array([noise[0] + 0.0 * distance, noise[1] + 0.05 * distance])


OWN_NOISE = replace(BEARING_RANGE, name="own_noise", std=grown_std)
#: The same noise from the default sensor.
SHIPPED_NOISE = BEARING_RANGE.with_noise(range_std_per_metre=0.05)
