"""The presets as parameters of tests: the city, of 10,000 landmarks, is slow."""

import pytest

from slamgym.sim_configs import list_presets


def slow_city(names):
    """Mark the city, where it is among some names."""
    slow = pytest.param("city", marks=pytest.mark.slow)
    return [slow if name == "city" else name for name in names]


PRESETS = slow_city(list_presets())
