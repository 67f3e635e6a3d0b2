"""Worlds that move and measure; they know nothing of estimators."""

from .landmark_world import LandmarkWorldEnv as LandmarkWorldEnv
from .landmark_world_vector import LandmarkWorldVectorEnv as LandmarkWorldVectorEnv
