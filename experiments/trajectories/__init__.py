"""Trajectories by the million: driven, written in shards, read back.

controllers → driven episodes → trajectory → formats → shard folder, manifest → dataset
"""

from .dataset import load_trajectories
from .driven_episodes import drive_episodes
from .generate import generate_trajectories
from .trajectory import Trajectory

__all__ = [
    "Trajectory",
    "drive_episodes",
    "generate_trajectories",
    "load_trajectories",
]
