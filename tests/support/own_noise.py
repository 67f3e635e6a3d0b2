"""A sensor of a user that differs from the default in its function for the noise."""

from dataclasses import replace

import numpy as np

from slamgym.estimator.models.sensors import BEARING_RANGE


def grown_std(noise, distance):
    """Return the deviations as an array; they change with the range."""
    return np.array([noise[0] + noise[3] / distance, noise[1] + noise[2] * distance])


SHIPPED_NOISE = BEARING_RANGE.with_noise(range_std_per_metre=0.05)
OWN_NOISE = replace(SHIPPED_NOISE, name="own_noise", std=grown_std)
