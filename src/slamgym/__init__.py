"""Landmark-SLAM worlds for Gymnasium, and EKF-SLAM estimators to run in them.

``import slamgym`` registers the environments.  Every other name is loaded at its first
use; ``__init__.pyi`` lists them.  The parts are :mod:`slamgym.sim_configs`,
:mod:`slamgym.envs`, :mod:`slamgym.estimator`, :mod:`slamgym.evaluation`,
:mod:`slamgym.agents` and :mod:`slamgym.experiments`.
"""

import gymnasium
from lazy_loader import attach_stub

__version__ = "0.1.0"

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)

gymnasium.register(
    id="slamgym/LandmarkWorld-v0",
    entry_point="slamgym.envs.landmark_world:LandmarkWorldEnv",
    vector_entry_point="slamgym.envs.vector.landmark_world_vector:LandmarkWorldVectorEnv",
)
gymnasium.register(
    id="slamgym/ActiveSlam-v0",
    entry_point="slamgym.agents.active_slam:ActiveSlamEnv",
    vector_entry_point="slamgym.agents.active_slam:ActiveSlamVectorEnv",
)
