"""The presets as parameters of tests: the city, of 10,000 landmarks, is slow."""

import pytest

from slamgym.sim_configs import list_presets

PRESETS = [
    pytest.param(name, marks=pytest.mark.slow) if name == "city" else name
    for name in list_presets()
]
