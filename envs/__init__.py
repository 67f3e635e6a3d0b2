"""Worlds that move and measure; they know nothing of estimators."""

from .landmark_world import LandmarkWorldEnv as LandmarkWorldEnv
from .vector.landmark_world_vector import (
    LandmarkWorldVectorEnv as LandmarkWorldVectorEnv,
)
