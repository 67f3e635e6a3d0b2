"""Landmark-SLAM worlds for Gymnasium, and EKF-SLAM estimators to run in them.

``import slamgym`` registers the environments and loads nothing else; the parts are
:mod:`slamgym.sim_configs`, :mod:`slamgym.envs`, :mod:`slamgym.estimator`,
:mod:`slamgym.agents` and :mod:`slamgym.experiments`.
"""

import gymnasium

__version__ = "0.1.0"

gymnasium.register(
    id="slamgym/LandmarkWorld-v0",
    entry_point="slamgym.envs.landmark_world:LandmarkWorldEnv",
    vector_entry_point="slamgym.envs.vector.landmark_world_vector:LandmarkWorldVectorEnv",
)
gymnasium.register(
    id="slamgym/ActiveSlam-v0",
    entry_point="slamgym.agents.active_slam:ActiveSlamEnv",
    vector_entry_point="slamgym.agents.active_slam_vector:ActiveSlamVectorEnv",
)
